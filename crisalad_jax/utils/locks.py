"""Locks of folders: one process at a time writes into a run, a map, a comparison or a report."""

import contextlib
import errno
import fcntl
import os
import pathlib
import socket
import stat
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

_POLL = 0.2
"""Seconds between two attempts at a lock that another process holds."""


@contextlib.contextmanager
def lock(folder: str | os.PathLike[str], *, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of a folder, which is made if needed, while the block writes into it.

    The kernel releases the lock at the end of the process at the latest, so a killed process never
    blocks the next one.

    Args:
        folder: the folder.
        wait: seconds to wait for another process that holds it, with a warning.

    Raises:
        InputError: another process holds it (the message names it and its host); or the
            folder cannot be made or written to.
    """
    folder = pathlib.Path(folder)
    end, told = time.monotonic() + wait, False
    while (held := _acquire(folder)) is None:
        if time.monotonic() >= end:
            raise InputError(
                f"{folder}: found another process that writes here{_holder(folder)}, expected to "
                "be the only one"
            )
        if not told:
            warn(f"{folder}: waiting for another process{_holder(folder)}")
            told = True
        time.sleep(_POLL)
    with held:
        yield


def _acquire(folder: pathlib.Path) -> contextlib.ExitStack | None:
    """Lock a folder until the returned stack is closed; None if another process holds it."""
    path = folder / LOCK
    with block_signals(), contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder))
        is_held = False
        while not is_held:
            with wrap_os_errors(path):
                file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
                stack.callback(os.close, file)
                kind = os.fstat(file)
                # The text written below would overwrite the file behind a link.
                if not stat.S_ISREG(kind.st_mode) or kind.st_nlink > 1:
                    raise OSError(errno.EMLINK, "found a hard link or no file, expected a lock")
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    return None
                except OSError:  # a disk without locks: nobody holds an empty file
                    if kind.st_size == 0:
                        path.unlink(missing_ok=True)
                    raise
            # The last holder may have removed the file between the two calls.
            is_held = os.fstat(file).st_nlink > 0
        stack.enter_context(in_use(path))
        with contextlib.suppress(OSError):  # a full disk has no room for that
            os.ftruncate(file, 0)
            os.write(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        return stack.pop_all()


@contextlib.contextmanager
def staged_folder(out: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Yield a temporary folder; on success move its files into `out`, HTML last, else remove it.

    Raises:
        InputError: another process holds the lock of `out`, or files cannot be written there.
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


def _holder(folder: pathlib.Path) -> str:
    """Name the holder of a folder's lock in brackets; empty while that is still being written."""
    try:
        words = (folder / LOCK).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
    return f" ({words})" if words else ""
