"""Checks of a configuration's fields."""

import math
from collections.abc import Mapping
from typing import TypeVar, get_args, get_type_hints

from crisalad_jax.utils.errors import InputError

_T = TypeVar("_T")


def choose(what: str, name: str, choices: Mapping[str, _T]) -> _T:
    """Look `name` up in `choices`.

    Raises:
        InputError: no such name; the message lists the valid ones.
    """
    if name not in choices:
        raise InputError(f"{what}: found {name!r}, expected one of {', '.join(sorted(choices))}")
    return choices[name]


def require(condition: bool, message: str) -> None:
    """Raise InputError with the message unless the condition holds."""
    if not condition:
        raise InputError(message)


def require_positive(config: object, *names: str) -> None:
    """Check that fields are positive and finite, and whole numbers where annotated `int`."""
    hints = get_type_hints(type(config))
    for name in names:
        value = getattr(config, name)
        require(
            hints[name] is not int or isinstance(value, int),
            f"{type(config).__name__}.{name}: found {value}, expected a whole number",
        )
        require(
            0 < value < math.inf,
            f"{type(config).__name__}.{name}: found {value}, expected more than 0, and finite",
        )


def require_choice(config: object, *names: str) -> None:
    """Check that fields annotated `Literal` hold one of its values."""
    hints = get_type_hints(type(config))
    for name in names:
        choices = dict.fromkeys(get_args(hints[name]))
        choose(f"{type(config).__name__}.{name}", getattr(config, name), choices)


def require_fraction(config: object, *names: str) -> None:
    """Check that fields are at least 0 and less than 1."""
    for name in names:
        value = getattr(config, name)
        require(
            0 <= value < 1,
            f"{type(config).__name__}.{name}: found {value}, expected at least 0 and less than 1",
        )
