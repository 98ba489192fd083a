"""Notes to the user that are no errors: one line each, shown once."""

import sys
import warnings

_PACKAGE = __name__.partition(".")[0]


class Note(UserWarning):
    """A warning that something was done, or found, that a user may not expect."""


def tell(message: str) -> None:
    """Tell the user in one line; the command line prints it, Python code gets a warning.

    The warning is of the first line outside of this package that led here.
    """
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, Note, stacklevel=level)
