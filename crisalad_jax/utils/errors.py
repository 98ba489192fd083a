"""Errors that end a command with one line: bad input, and a signal."""

import contextlib
import signal
from collections.abc import Iterator, Sequence

_MOST = 3
"""Number of problems that one message lists."""


class InputError(ValueError):
    """Bad input from outside: a file, a folder, an argument, a configuration field.

    The command line exits with code 2. The message is one line that names the file or argument,
    what was found and what was expected.
    """


@contextlib.contextmanager
def locate_errors(before: str = "", after: str = "") -> Iterator[None]:
    """Add `before` and `after` to the message of an InputError that the block raises."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{before}{error}{after}") from error


def how_ended(number: int) -> str:
    """Describe how a signal, given by its number, ended a program; all commands use these words."""
    return "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"


def few(problems: Sequence[str]) -> str:
    """Join problems into one line: the first three, and how many more there are.

    Example:
        >>> few([f"{letter} missing" for letter in "abcde"])
        'a missing; b missing; c missing; and 2 more'
    """
    more = [f"and {len(problems) - _MOST} more"] if len(problems) > _MOST else []
    return "; ".join([*problems[:_MOST], *more])


class Interrupted(Exception):
    """The end of a program by a signal, after which its saved work can be resumed."""

    def __init__(self, number: int, where: str = "") -> None:
        """Take the signal's number; `where` says in a few words how far the work has got."""
        super().__init__(f"{how_ended(number)} {where}".rstrip())
        self.number = number
