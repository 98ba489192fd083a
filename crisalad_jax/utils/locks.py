"""Locks of folders: one process at a time writes into a run, a map, a comparison or a report."""

import contextlib
import os
import pathlib
import socket
import time
from collections.abc import Iterator

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import wrap_os_errors
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.signals import block_signals
from crisalad_jax.utils.temporaries import (
    LOCK,
    in_use,
    made_folder,
    remove_temporaries,
    temporary_beside,
)


class BusyFolderError(InputError):
    """Another process writes into a folder."""


@contextlib.contextmanager
def lock(
    folder: str | os.PathLike[str], *, wait: bool = False, quiet: bool = False
) -> Iterator[None]:
    """Hold the lock of a folder, which is made if needed, while the block writes into it.

    The kernel releases the lock at the end of the process at the latest, so a killed process never
    blocks the next one.

    Args:
        folder: the folder.
        wait: whether to wait for another process that holds it, with a note.
        quiet: whether to wait without a note.

    Raises:
        BusyFolderError: another process holds it; the message says which, on which host.
        InputError: the folder cannot be made or written to.
    """
    folder = pathlib.Path(folder)
    with contextlib.ExitStack() as held:
        while True:
            try:
                with block_signals(), contextlib.ExitStack() as attempt:
                    attempt.enter_context(made_folder(folder))
                    descriptor = _locked(folder, attempt)
                    attempt.enter_context(in_use(_lock_of(folder)))
                    held.enter_context(attempt.pop_all())
                break
            except BusyFolderError:
                if not wait:
                    raise
                if not quiet:
                    warn(f"{folder}: waiting for another process{_holder(_lock_of(folder))}")
                    quiet = True
                time.sleep(POLL)
        with contextlib.suppress(OSError):  # a full disk has no room for that
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"{_signature()}\n".encode())
        yield


POLL = 0.2
"""Seconds between two looks at a lock that another process holds."""


def holder_of(folder: str | os.PathLike[str]) -> str | None:
    """Return "process P on HOST" of the process that writes into a folder; None without one."""
    import fcntl

    path = _lock_of(folder)
    try:
        with path.open(encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _words(path)
    except OSError:
        pass
    return None


def is_here(holder: str) -> bool:
    """Return whether what `holder_of` returned is another process of this host."""
    return holder != _signature() and holder.endswith(f" on {socket.gethostname()}")


def _signature() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}"


def _lock_of(folder: str | os.PathLike[str]) -> pathlib.Path:
    return pathlib.Path(folder) / LOCK


def _locked(folder: pathlib.Path, stack: contextlib.ExitStack) -> int:
    """Lock a folder until the stack is closed; return the descriptor of its lock."""
    import fcntl

    path = _lock_of(folder)
    try:
        while True:
            file = stack.enter_context(path.open("a+", encoding="utf-8"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise BusyFolderError(
                    f"{folder}: found another process that writes here{_holder(path)}, "
                    "expected to be the only one"
                ) from error
            # The last holder may have removed the file between the two calls.
            if _is_still(path, file.fileno()):
                return file.fileno()
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to: {error.strerror}") from error


@contextlib.contextmanager
def staged_folder(out: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Yield a temporary folder; on success move its files into `out`, pages last, else remove it.

    Raises:
        InputError: as `lock`; or the disk is full.
    """
    out = pathlib.Path(out)
    with lock(out), wrap_os_errors(out):
        remove_temporaries(out)
        temporary = temporary_beside(out / "files")
        with in_use(temporary):
            temporary.mkdir()
            yield temporary
            for path in sorted(temporary.iterdir(), key=lambda path: path.suffix == ".html"):
                os.replace(path, out / path.name)


def _holder(path: pathlib.Path) -> str:
    """Return the words of a lock's holder in brackets; nothing while it is still writing them."""
    words = _words(path)
    return f" ({words})" if words else ""


def _words(path: pathlib.Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _is_still(path: pathlib.Path, descriptor: int) -> bool:
    """Return whether the open file is the one with this name."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False
