"""Notes to the user that are no errors: one line each, shown once."""

import warnings


class Note(UserWarning):
    """A warning that something was done, or found, that a user may not expect."""


def tell(message: str) -> None:
    """Tell the user in one line; the command line prints it, Python code gets a warning."""
    warnings.warn(message, Note, stacklevel=3)
