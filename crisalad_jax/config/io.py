"""Convert configurations to and from plain JSON values."""

import dataclasses
import json
import pathlib
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import numpy as np

from crisalad_jax.config.concise import fields_in_use
from crisalad_jax.config.parts import Part
from crisalad_jax.config.plugins import home_of
from crisalad_jax.utils.checksums import CHECKSUM, ChangedFileError
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json

_T = TypeVar("_T")
NAME = "name"
"""Key of a part's name beside its fields."""
_PLUGIN = "plugin"
"""Key of the plug-in that registered a part, next to its name."""


def to_plain(config: Any) -> dict[str, Any]:
    """Convert a configuration to nested dictionaries of JSON values, with its parts' names.

    A part of a plug-in also has the plug-in's, so that who lacks it is told which it was.
    """
    return json.loads(json.dumps(_plain(config)))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if not isinstance(value, Part):
            return fields
        home = home_of(type(value).__module__)
        return {NAME: value.part_name, **({_PLUGIN: home} if home else {}), **fields}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    if value is not None and not isinstance(value, bool | int | float | str):
        raise InputError(f"configuration: found {value!r}, expected numbers, text or lists of them")
    return value


def from_plain(kind: type[_T], value: Any, *, source: str) -> _T:
    """Make the configuration of class `kind` from the values that `to_plain` returned.

    Missing fields take their defaults.

    Args:
        kind: the class.
        value: JSON values.
        source: what messages begin with, such as a file's name.

    Raises:
        InputError: naming `source`, every unknown field, part that is not registered, and value
            that does not fit.
    """
    if not isinstance(value, Mapping):
        raise InputError(f"{source}: found {type(value).__name__}, expected an object of fields")
    problems: list[str] = []
    config = _config(kind, value, "config", problems)
    if problems:
        raise InputError(f"{source}: {'; '.join(problems)}")
    return config


def _config(kind: Any, value: Any, path: str, problems: list[str]) -> Any:
    """Make a dataclass; errors go to `problems`, and then the result must not be used."""
    if isinstance(value, str) and issubclass(kind, Part):
        value = {NAME: value}
    if not isinstance(value, Mapping):
        problems.append(f"found {value!r}, expected an object of fields @ {path}")
        return None
    before = len(problems)
    if issubclass(kind, Part):
        value = dict(value)
        name, plugin = value.pop(NAME, None), value.pop(_PLUGIN, None)
        try:
            kind = kind.registry.find(name, plugin)
        except InputError as error:
            problems.append(f"{error} @ {path}")
            return None
    hints = typing.get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    unknown = sorted(value.keys() - fields.keys())
    if unknown:
        problems.append(f"found {', '.join(unknown)}, expected {', '.join(fields)} @ {path}")
    given = {
        # A map's description has a field `config`, as the whole is called.
        name: _value(hints[name], value[name], path if path == name else f"{path}.{name}", problems)
        for name in fields
        if name in value
    }
    missing = [
        name
        for name, field in fields.items()
        if name not in value
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    problems += [f"{name} missing @ {path}" for name in missing]
    if len(problems) > before:
        return None
    try:
        return kind(**given)
    except InputError as error:
        problems.append(f"{error} @ {path}")
        return None


def _value(hint: Any, value: Any, path: str, problems: list[str]) -> Any:
    """Convert a field's value to exactly its type: 3.7 is no number of epochs."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        # Every union here is of None and one type, or of a part and its name.
        hint = next(each for each in arguments if each is not type(None))
        return _value(hint, value, path, problems)
    if dataclasses.is_dataclass(hint):
        return _config(hint, value, path, problems)
    if origin is Literal:
        if value in arguments and type(value) in map(type, arguments):
            return value
        expected = f"one of {', '.join(map(str, sorted(arguments)))}"
    elif origin is tuple:
        return _sequence(arguments, value, path, problems)
    elif type(value) is hint:
        return value
    elif hint is float and type(value) is int:
        return float(value)
    else:
        expected = getattr(hint, "__name__", str(hint))
    problems.append(f"found {value!r}, expected {expected} @ {path}")
    return None


def _sequence(
    kinds: tuple[Any, ...], value: Any, path: str, problems: list[str]
) -> tuple[Any, ...]:
    endless = kinds[-1:] == (Ellipsis,)
    # Refuse a string, which Python would iterate over letter by letter.
    if not isinstance(value, list | tuple) or not (endless or len(value) == len(kinds)):
        of = "names" if kinds[0] is str else f"{kinds[0].__name__}s"
        count = "" if endless else f"{len(kinds)} "
        problems.append(f"found {value!r}, expected a list of {count}{of} @ {path}")
        return ()
    each = [kinds[0]] * len(value) if endless else kinds
    return tuple(
        _value(kind, item, f"{path}[{number}]", problems)
        for number, (kind, item) in enumerate(zip(each, value, strict=True))
    )


def read_config(kind: type[_T], path: pathlib.Path) -> _T:
    """Read a configuration that a run wrote, or, without a checksum, that a user wrote.

    Args:
        kind: its class.
        path: the file.

    Raises:
        InputError: the file is missing, is not JSON, was changed since it was written, or holds
            another configuration.
    """
    try:
        value = read_json(path, "a configuration as JSON", sealed=False)
    except ChangedFileError as error:
        raise InputError(f"{error}; to use it as it is, remove the line {CHECKSUM!r}") from error
    return from_plain(kind, value, source=str(path))


def differences(found: Any, expected: Any, prefix: str = "") -> list[str]:
    """Return the fields in which two configurations differ, as `name: found, expected`.

    Fields that one of them does not use do not count.
    """
    if dataclasses.is_dataclass(found) and type(found) is type(expected):
        fields = min(fields_in_use(found), fields_in_use(expected), key=len)
        return [
            line
            for field in fields
            for line in differences(
                getattr(found, field.name), getattr(expected, field.name), f"{prefix}.{field.name}"
            )
        ]
    if found == expected:
        return []
    return [f"{prefix.removeprefix('.')}: found {_word(found)}, expected {_word(expected)}"]


def _word(value: Any) -> Any:
    return value.part_name if isinstance(value, Part) else value
