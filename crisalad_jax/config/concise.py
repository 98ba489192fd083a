"""Print a configuration by what differs from the defaults, as Python that makes it again."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar

_T = TypeVar("_T")
_WIDTH = 88
"""Characters of a line, at most: as a notebook shows without a scroll bar."""
_SWITCH = "__concise_switch__"
_ALWAYS = "__concise_always__"


def concise(*always: str, switch: tuple[Any, ...] = ()) -> Callable[[type[_T]], type[_T]]:
    """Return a decorator that gives a dataclass the `repr` of `concise_repr`.

    Args:
        *always: fields that are printed at their defaults too.
        switch: a field, its value with which others are not in use, and the names of these; by
            default of all others. They are left out, and not compared (`config.io.differences`).
    """

    def decorate(cls: type[_T]) -> type[_T]:
        setattr(cls, _ALWAYS, always)
        setattr(cls, _SWITCH, switch)
        cls.__repr__ = concise_repr  # pyright: ignore[reportAttributeAccessIssue]
        return cls

    return decorate


def concise_repr(config: Any) -> str:
    """Write a configuration as the call that makes it, without fields that change nothing.

    Those are fields at their defaults, and fields that are not in use. A part at its defaults is
    its name. Long calls take a line for each field.

    Args:
        config: a dataclass.

    Returns:
        Python, where the classes that it names are imported.

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> print(ModelConfig(aggregator="gem", cross_image=CrossImageConfig(layers=0, heads=4)))
        ModelConfig(backbone='vit', aggregator='gem', cross_image=CrossImageConfig(layers=0))
    """
    return _write(config, "", 0, _WIDTH)


def in_one_line(value: Any) -> str:
    """Write any value for a message: a configuration in one line, of other values the first."""
    first, *more = _write(value, "", 0, math.inf).splitlines() or [""]
    return f"{first} ..." if more else first


def _write(value: Any, before: str, indent: int, width: float) -> str:
    """Write `before` and a value; the line has `indent` characters already."""
    if type(value).__repr__ is not concise_repr:
        return f"{before}{value!r}"
    shown = _shown(value)
    name = getattr(value, "part_name", None)
    if before and name and not shown:
        return f"{before}{name!r}"
    opening = f"{before}{type(value).__qualname__}("
    line = f"{opening}{', '.join(_write(*field, 0, math.inf) for field in shown)})"
    if indent + len(line) <= width:
        return line
    inner = indent + 4
    fields = [f"{' ' * inner}{_write(*field, inner, width)},\n" for field in shown]
    return f"{opening}\n{''.join(fields)}{' ' * indent})"


def _shown(config: Any) -> list[tuple[Any, str]]:
    """Return the values of the fields that are printed, each with `name=`."""
    always = getattr(config, _ALWAYS, ())
    values = [(field, getattr(config, field.name)) for field in fields_in_use(config)]
    return [
        (value, f"{field.name}=")
        for field, value in values
        if field.name in always or not _is_default(field, value)
    ]


def fields_in_use(config: Any) -> list[dataclasses.Field[Any]]:
    """List a configuration's fields without those that its switch puts out of use.

    Example:
        >>> from crisalad_jax import CrossImageConfig
        >>> [field.name for field in fields_in_use(CrossImageConfig(layers=0))]
        ['layers']
    """
    fields, switch = list(dataclasses.fields(config)), getattr(config, _SWITCH, ())
    if not switch or getattr(config, switch[0]) != switch[1]:
        return fields
    name, _, *unused = switch
    return [f for f in fields if f.name not in unused and (unused or f.name == name)]


def _is_default(field: dataclasses.Field[Any], value: Any) -> bool:
    if field.default_factory is not dataclasses.MISSING:
        return value == field.default_factory()
    return field.default is not dataclasses.MISSING and value == field.default
