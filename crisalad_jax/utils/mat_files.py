"""Read MATLAB's `.mat` files by scipy, which runs nothing of them."""

import os
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source


def load_mat(
    path: str | os.PathLike[str], expected: str, *, damaged: str, **options: Any
) -> dict[str, Any]:
    """Return the variables of a file of at most `LARGEST` bytes.

    Args:
        path: the file.
        expected: what kind of file, for messages.
        damaged: what the message calls a file that scipy cannot read.
        **options: of `scipy.io.loadmat`.

    Raises:
        InputError: the file is missing, too large, damaged, or of MATLAB's format 7.3.
    """
    # Import here: scipy takes half a second.
    import scipy.io

    check_source(path, expected, largest=LARGEST)
    try:
        return scipy.io.loadmat(path, **options)
    except NotImplementedError as error:
        raise InputError(
            f"{path}: found MATLAB's format 7.3, expected 7 or older (save it with '-v7')"
        ) from error
    except Exception as error:  # a damaged file can raise anything at all
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: {damaged}: {reason}") from error
