"""Read the files of results in the folder of a comparison."""

import contextlib
import math
import pathlib
from collections.abc import Iterator
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json


def read_result(path: pathlib.Path, **kinds: type) -> dict[str, Any]:
    """Read a file of results.

    Args:
        path: the file.
        kinds: the type of each value that the caller needs, by key; numbers are finite, from 0.

    Raises:
        InputError: it cannot be read, was changed, or lacks one of these values.
    """
    with advised():
        value = read_json(path, "a result of a comparison")
        for key, kind in kinds.items():
            if not isinstance(value.get(key), kind):
                raise InputError(f"{path}: found no {key!r} of {kind.__name__}, expected it")
            if kind in (int, float) and not is_number(value[key]):
                raise InputError(
                    f"{path}: {key}: found {value[key]}, expected a finite number from 0"
                )
    return value


def is_number(value: Any) -> bool:
    """Return whether a value of JSON is a finite number from 0."""
    right = isinstance(value, int | float) and not isinstance(value, bool)
    return right and 0 <= value < math.inf


@contextlib.contextmanager
def advised() -> Iterator[None]:
    """Add to an error of reading a result what to do.

    Raises:
        InputError: in place of one of the block.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{error}; delete it, and the same command makes it anew") from error
