"""Output of a program: notes to its user, and text without control characters."""

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

_PACKAGE = __name__.partition(".")[0]


_LONGEST = 8192
"""Maximum characters of a message, which may quote a path or a value of any length."""


class Note(UserWarning):
    """A warning that something was done, or found, that a user may not expect."""


def warn(message: str) -> None:
    """Warn the user in one line, which commands print; Python code gets a warning (`Note`).

    The warning points to the nearest calling line outside of this package.
    """
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, Note, stacklevel=level)


_SAID: set[str] = set()
"""Messages that `warn_once` has shown."""


def warn_once(about: str, message: str) -> None:
    """Warn with `about: message`, unless this process has already shown the message."""
    if message not in _SAID:
        _SAID.add(message)
        warn(f"{about}: {message}")


@contextlib.contextmanager
def print_notes() -> Iterator[None]:
    """Print each `Note` as a line on standard error; other warnings stay as Python shows them."""
    show_warning = warnings.showwarning

    def show(message: Any, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, Note):
            print(f"crisalad: note: {one_line(message)}", file=sys.stderr)
        else:
            show_warning(message, category, *rest, **more)

    with warnings.catch_warnings():
        warnings.showwarning = show
        warnings.simplefilter("default", Note)  # the same message once
        yield


def printable(text: str) -> str:
    """Return a text with its control characters escaped: file names may contain any.

    A terminal would obey them. Line breaks stay.

    Example:
        >>> printable("a\\x1b[2Jb")
        'a\\\\x1b[2Jb'
    """
    return "".join(
        each if each.isprintable() or each == "\n" else ascii(each)[1:-1] for each in text
    )


def one_line(error: object) -> str:
    """Return an error's message in one printable line, without the middle of a very long one."""
    words = " ".join(str(error).split())
    return printable(words if len(words) <= _LONGEST else f"{words[:1000]} ... {words[-1000:]}")


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, which has an s for any number other than one.

    Example:
        >>> counted(1, "image"), counted(2, "image")
        ('1 image', '2 images')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
