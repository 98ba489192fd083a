"""What a program prints: in any encoding, without escape sequences, also if nobody reads on."""

import io
import os
import sys
import warnings
from typing import Any, TextIO

from crisalad_jax.utils.errors import InputError

_PACKAGE = __name__.partition(".")[0]


class Note(UserWarning):
    """A warning that something was done, or found, that a user may not expect."""


def warn(message: str) -> None:
    """Warn the user in one line; the command line prints it, Python code gets a `Note`.

    The warning is of the first line outside of this package that led here.
    """
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, Note, stacklevel=level)


def printable(text: str) -> str:
    """Return a text with its control characters escaped: names of files may hold any.

    A terminal would obey them. Line breaks stay.

    Example:
        >>> printable("a\\x1b[2Jb")
        'a\\\\x1b[2Jb'
    """
    return "".join(
        each if each.isprintable() or each == "\n" else ascii(each)[1:-1] for each in text
    )


def one_line(error: object) -> str:
    """Return an error's message in one printable line."""
    return printable(" ".join(str(error).split()))


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, which has an s for any other number than one.

    Example:
        >>> counted(1, "image"), counted(2, "image")
        ('1 image', '2 images')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def keep_on_without_reader() -> None:
    """Let the program go on where the reader of its output is gone, as after `| head`.

    A full disk raises an `InputError` once, at the write or flush that meets it. Letters that the
    encoding lacks are escaped. Standard error stays as it is: who reads that knows that the program
    goes on.
    """
    if sys.stdout is None:  # it was closed, as by `>&-`
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    else:
        sys.stdout = _going_on(sys.stdout)


def _going_on(stream: TextIO) -> TextIO:
    raw = _UntilClosed(stream.fileno())
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.isatty(),
    )


class _UntilClosed(io.RawIOBase):
    """A file that drops what is written after its reader is gone, or after an error was raised.

    Python flushes once more at its end, and would end with a traceback of its own.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._failed = False

    def write(self, data: Any) -> int:
        if not self._failed:
            try:
                return os.write(self._descriptor, data)
            except BrokenPipeError:
                pass
            except OSError as error:
                self._failed = True
                raise InputError(f"standard output: {error.strerror}") from error
        return memoryview(data).nbytes

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def writable(self) -> bool:
        return True
