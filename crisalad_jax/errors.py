"""The one error that means "your input is wrong"; the command line prints it as one line and exits with 2."""


class InputError(ValueError):
    """Bad input from outside: a file, a folder, an argument, a configuration field.

    The message is one line that names the file or argument, what was found and what was expected.
    """
