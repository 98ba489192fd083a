"""A command's types, written so that tyro can check its defaults without importing typeguard."""

import pathlib
import types
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec


def quicken(kind: type) -> type:
    """Write the types of a command's class in forms that tyro knows by itself; return the class.

    For others, `X | Y` and `tuple[X, ...]` among them, it imports typeguard to check the defaults,
    which takes longer than the rest of its work. It still does for tuples of numbers or literals.
    """
    hints = get_type_hints(kind, include_extras=True)
    kind.__annotations__ = {name: _quick(hint) for name, hint in hints.items()}
    return kind


def _quick(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        inner, *more = get_args(hint)
        if tyro.conf.UseAppendAction in more:  # a flag that may be repeated
            return hint
        quick = _quick(inner)
        if get_origin(quick) is Annotated:  # Annotated takes no other as its type
            inner, *own = get_args(quick)
            return Annotated[(inner, *own, *more)]  # pyright: ignore
        return Annotated[(quick, *more)]  # pyright: ignore
    if isinstance(hint, types.UnionType):
        return Union[get_args(hint)]  # noqa: UP007
    if hint in (tuple[str, ...], tuple[pathlib.Path, ...]):
        return _any_number(get_args(hint)[0])
    return hint


def _any_number(kind: type) -> Any:
    """Return the plain type `tuple`, with how words become one of `kind`."""
    word = "STR" if kind is str else "PATH"
    spec: Any = PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"[{word} [{word} ...]]",
        instance_from_str=lambda words: tuple(map(kind, words)),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: list(map(str, value)),
    )
    return Annotated[(tuple, spec)]  # pyright: ignore
