"""The error that means "your input is wrong": one line from the command line, exit code 2."""


class InputError(ValueError):
    """Bad input from outside: a file, a folder, an argument, a configuration field.

    The message is one line that names the file or argument, what was found and what was expected.
    """
