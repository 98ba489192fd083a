"""The errors that a command ends with in one line: bad input, and a signal."""

import signal


class InputError(ValueError):
    """Bad input from outside: a file, a folder, an argument, a configuration field.

    The command line ends with code 2. The message is one line that names the file or argument, what
    was found and what was expected.
    """


def how_ended(number: int) -> str:
    """Say by which signal a program ends, in the words of every command."""
    return "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"


class Stopped(Exception):
    """A signal asked the program to end, and its work is saved."""

    def __init__(self, number: int, where: str = "") -> None:
        """Take the signal's number, and `where`: in a few words how far the work is."""
        super().__init__(f"{how_ended(number)} {where}".rstrip())
        self.number = number
