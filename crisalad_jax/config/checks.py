"""Checks of the fields of configurations, and of the arguments of functions."""

import dataclasses
import functools
import inspect
import math
import os
import types
from collections.abc import Callable, Mapping
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from crisalad_jax.config.short_repr import in_one_line
from crisalad_jax.utils.errors import InputError

_T = TypeVar("_T")
REGISTRY = "registry"
"""Key of the registry in the metadata of a dataclass field that holds a part."""
_PLAIN: Mapping[type, tuple[str, tuple[type, ...]]] = {
    bool: ("True or False", (bool, np.bool_)),
    int: ("a whole number", (int, np.integer)),
    float: ("a number", (int, float, np.integer, np.floating)),
    str: ("text", (str,)),
}
"""Description of a plain type, and the types whose values are accepted for it."""


def choose(what: str, name: str, choices: Mapping[str, _T]) -> _T:
    """Return the value of `name` in `choices`.

    Raises:
        InputError: there is no such name; the message begins with `what` and lists the valid names.
    """
    if name not in choices:
        raise InputError(f"{what}: found {name!r}, expected one of {', '.join(sorted(choices))}")
    return choices[name]


def require(condition: bool, message: str) -> None:
    """Raise InputError with `message` unless the condition holds."""
    if not condition:
        raise InputError(message)


def check_seed(what: str, seed: int) -> None:
    """Check that a seed is a whole number from 0 that fits 32 bits, as in fields of type `Seed`.

    Raises:
        InputError: the seed is anything else; the message begins with `what`.
    """
    allowed = kind_of(Seed)
    require(allowed.fits(seed), f"{what}: found {seed!r}, expected {allowed.words}")


def check_count(what: str, count: Any) -> None:
    """Check that an argument is a whole number of at least 1.

    Raises:
        InputError: it is less, or not a whole number; the message begins with `what`.
    """
    is_whole = kind_of(int).fits(count)
    expected = "at least 1" if is_whole else "a whole number of at least 1"
    require(is_whole and count >= 1, f"{what}: found {in_one_line(count)}, expected {expected}")


PATH = (str, os.PathLike)
"""Classes of an argument that is the path of a file or folder, for `takes`."""
_F = TypeVar("_F", bound=Callable[..., Any])


def takes(**kinds: type | tuple[type, ...]) -> Callable[[_F], _F]:
    """Return a decorator that checks the classes of a function's arguments at each call.

    Swapped arguments then raise a one-line InputError, not an AttributeError deep inside the call.

    Args:
        **kinds: for each argument to check, by name, the class or classes that it may have.

    Returns:
        The decorator.

    Example:
        >>> @takes(path=PATH, k=int)
        ... def look(path, k=5):
        ...     return k
        >>> look(5, "picture.jpg")
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: path: found 5, expected a path
    """

    def decorate(function: _F) -> _F:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            for name, value in signature.bind_partial(*args, **options).arguments.items():
                kind = kinds.get(name, object)
                if not isinstance(value, kind):
                    plain = value is None or isinstance(value, str | int | float)
                    found = repr(value) if plain else type(value).__name__
                    is_path = isinstance(kind, tuple) and os.PathLike in kind and int not in kind
                    words = "a path" if is_path else kind_of(cast(Any, Union)[kind]).words
                    raise InputError(f"{name}: found {found}, expected {words}")
            return function(*args, **options)

        return cast(_F, call)

    return decorate


def check_types(config: Any) -> None:
    """Check that every field of a configuration holds a value of its annotated type.

    NumPy's numbers are accepted for Python's, and whole numbers for floats. Fields for parts are
    left to `resolve_names`. Type hints of a kind that no configuration uses accept any value.

    Args:
        config: the configuration, a dataclass, which calls this in its `__post_init__`.

    Raises:
        InputError: a field holds a value of another type; the message names its class and field.

    Example:
        >>> from crisalad_jax import CrossImageConfig
        >>> CrossImageConfig(layers=1.5)
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: CrossImageConfig.layers: found 1.5, expected a ...
    """
    for name, kind in _checked_kinds(type(config)).items():
        value = getattr(config, name)
        if not kind.fits(value):
            where = f"{type(config).__name__}.{name}"
            raise InputError(f"{where}: found {in_one_line(value)}, expected {kind.words}")


@functools.cache
def _checked_kinds(config: Any) -> Mapping[str, "Kind"]:
    """Return the kinds of a configuration class's fields, except those for parts."""
    fields = [f.name for f in dataclasses.fields(config) if REGISTRY not in f.metadata]
    hints = get_type_hints(config, include_extras=True)
    return {name: kind_of(hints[name]) for name in fields}


class Kind(NamedTuple):
    """The values that a type hint allows."""

    fits: Callable[[Any], bool]
    """Function that returns whether a value is allowed."""
    words: str
    """Description of the allowed values, for messages."""


def limited(least: float, most: float = math.inf) -> Kind:
    """Return the kind of numbers in a range, both ends included, for use in `Annotated`."""
    words = f"at least {least:g}" if most == math.inf else f"{least:g} to {most:g}"
    return Kind(lambda value: least <= value <= most, words)


# Types of numeric fields with a range. To all but `check_types` they are int and float.
PositiveInt = Annotated[int, Kind(lambda value: value >= 1, "a whole number of at least 1")]
NonNegativeInt = Annotated[int, Kind(lambda value: value >= 0, "a whole number of at least 0")]
# JAX drops higher bits, so a larger seed would draw the same values as a smaller one.
Seed = Annotated[int, Kind(lambda value: 0 <= value < 2**32, "at least 0, and less than 2**32")]
NonNegativeFloat = Annotated[float, limited(0)]
Share = Annotated[float, limited(0, 1)]
PositiveFloat = Annotated[
    float, Kind(lambda value: 0 < value < math.inf, "a finite number above 0")
]
Fraction = Annotated[
    float, Kind(lambda value: 0 <= value < 1, "a number of at least 0 and less than 1")
]


@functools.cache
def kind_of(hint: Any) -> Kind:
    """Return the `Kind` of values that a type hint allows."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        plain, limited = kind_of(arguments[0]), arguments[1]
        return Kind(lambda value: plain.fits(value) and limited.fits(value), limited.words)
    if origin in (Union, types.UnionType):
        kinds = [kind_of(each) for each in arguments]
        words = ", or ".join(kind.words for kind in kinds)
        return Kind(lambda value: any(kind.fits(value) for kind in kinds), words)
    if origin is Literal:
        names = ", ".join(sorted(map(str, arguments)))
        of_types = set(map(type, arguments))
        return Kind(lambda x: type(x) in of_types and x in arguments, f"one of {names}")
    if origin is tuple:
        each = kind_of(arguments[0])  # no tuple here mixes types
        count = None if arguments[-1] is ... else len(arguments)
        return Kind(
            lambda x: isinstance(x, tuple) and count in (None, len(x)) and all(map(each.fits, x)),
            f"a tuple{'' if count is None else f' of {count}'}, each {each.words}",
        )
    if hint in _PLAIN:
        words, classes = _PLAIN[hint]
        # A bool is an int to Python, but it is not a number of anything.
        return Kind(lambda x: isinstance(x, classes) and (type(x) is bool) <= (hint is bool), words)
    # jaxlib's Array has its module in its name.
    words = (
        "None" if hint is type(None) else getattr(hint, "__name__", str(hint)).rpartition(".")[2]
    )
    kind = origin or hint
    # Any is a class, but `isinstance` rejects it.
    is_class = isinstance(kind, type) and hint is not Any
    return Kind((lambda x: isinstance(x, kind)) if is_class else lambda x: True, words)


def require_field(config: object, name: str, holds: bool, expected: str) -> None:
    """Raise InputError unless `holds`, with the field `name`, its value and what is `expected`."""
    found = getattr(config, name)
    require(holds, f"{type(config).__name__}.{name}: found {found!r}, expected {expected}")


def require_range(config: object, least: float, most: float, name: str) -> None:
    """Raise InputError unless the field `name` is in a range, both ends included."""
    allowed = limited(least, most)
    require_field(config, name, allowed.fits(getattr(config, name)), allowed.words)
