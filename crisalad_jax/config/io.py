"""Convert configurations to and from plain JSON values."""

import dataclasses
import pathlib
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from crisalad_jax.config.checks import kind_of
from crisalad_jax.config.part import NAME, Part
from crisalad_jax.config.plugins import home_of
from crisalad_jax.config.short_repr import default_of, fields_in_use
from crisalad_jax.utils.checksums import CHECKSUM, ChangedFileError
from crisalad_jax.utils.errors import InputError, locate_errors
from crisalad_jax.utils.files import read_json

_T = TypeVar("_T")
PLUGIN = "plugin"
"""Key, next to a part's name, for the plug-in that registered the part."""


def to_plain(config: Any) -> Any:
    """Convert a configuration to nested dictionaries of JSON values, with the names of its parts.

    Plug-ins' parts also have the plug-in's name, so that messages can name a missing plug-in.

    Raises:
        InputError: a value is not None, a boolean, a number, text or a list of these.
    """
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        fields = {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
        if not isinstance(config, Part):
            return fields
        home = home_of(type(config).__module__)
        return {NAME: config.part_name, **({PLUGIN: home} if home else {}), **fields}
    if isinstance(config, list | tuple):
        return [to_plain(item) for item in config]
    value = config.item() if isinstance(config, np.generic) else config
    if value is not None and not isinstance(value, bool | int | float | str):
        raise InputError(f"configuration: found {value!r}, expected numbers, text or lists of them")
    return value


def from_plain(kind: type[_T], value: Any, *, source: str) -> _T:
    """Make a configuration of class `kind` from values like those that `to_plain` returns.

    Missing fields take their defaults.

    Args:
        kind: the class.
        value: JSON values.
        source: text with which error messages begin, such as a file's name.

    Raises:
        InputError: a field is unknown or missing, a part is not registered, or a value does not
            fit; the message names it.
    """
    with locate_errors(f"{source}: "):
        return _config(kind, value, "config")


def _config(kind: Any, value: Any, path: str) -> Any:
    """Make a dataclass; messages end with the path of the field."""
    with locate_errors(after=f" @ {path}"):
        kind, value = _class_and_fields(kind, value)
    hints = typing.get_type_hints(kind)
    given = {
        # A map's description has a field `config`, which is also the name of the root.
        name: _value(hints[name], each, path if path == name else f"{path}.{name}")
        for name, each in value.items()
    }
    with locate_errors(after=f" @ {path}"):
        return kind(**given)


def _class_and_fields(kind: Any, value: Any) -> tuple[Any, Mapping[str, Any]]:
    """Return the class of a JSON value (for a part, the one with its name) and its fields."""
    if isinstance(value, str) and issubclass(kind, Part):
        value = {NAME: value}
    if not isinstance(value, Mapping):
        raise InputError(f"found {value!r}, expected an object of fields")
    if issubclass(kind, Part):
        kind = kind.registry.find(value.get(NAME), value.get(PLUGIN))
        value = {key: each for key, each in value.items() if key not in (NAME, PLUGIN)}
    fields = {field.name: default_of(field) for field in dataclasses.fields(kind)}
    unknown = ", ".join(sorted(value.keys() - fields.keys()))
    needed = {name for name, default in fields.items() if default is dataclasses.MISSING}
    missing = ", ".join(sorted(needed - value.keys()))
    if unknown or missing:
        raise InputError(f"found {unknown or f'no {missing}'}, expected {', '.join(fields)}")
    return kind, value


def _value(hint: Any, value: Any, path: str) -> Any:
    """Convert a value to exactly its field's type: 3.7 is not a number of epochs."""
    origin, (kind, *_) = typing.get_origin(hint), typing.get_args(hint) or (None,)
    if origin in (typing.Union, types.UnionType):
        # Every union here is of one type and None, or of a part and its name.
        return None if value is None and kind_of(hint).fits(None) else _value(kind, value, path)
    if dataclasses.is_dataclass(hint):
        return _config(hint, value, path)
    if origin is tuple and isinstance(value, list | tuple):  # none here mixes types
        value = tuple(_value(kind, each, f"{path}[{i}]") for i, each in enumerate(value))
    if not kind_of(hint).fits(value):
        raise InputError(f"found {value!r}, expected {kind_of(hint).words} @ {path}")
    made: Any = value
    return float(made) if hint is float else made


def read_config(kind: type[_T], path: pathlib.Path) -> _T:
    """Read a configuration that a run wrote, or that a user wrote without a checksum.

    Args:
        kind: class of the configuration.
        path: the JSON file.

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
    """List the fields in which two configurations differ, as "NAME: found A, expected B".

    Fields that one of the two does not use are ignored. Names begin with `prefix` and a dot.
    """
    if dataclasses.is_dataclass(found) and type(found) is type(expected):
        fields = min(fields_in_use(found), fields_in_use(expected), key=len)
        pairs = [(f.name, getattr(found, f.name), getattr(expected, f.name)) for f in fields]
    elif found == expected:
        return []
    elif (names := _names(found)) and names == _names(expected):
        both: Any = found, expected
        pairs = zip(names, *both, strict=True)
    else:
        return [f"{prefix.removeprefix('.')}: found {_word(found)}, expected {_word(expected)}"]
    return [line for name, a, b in pairs for line in differences(a, b, f"{prefix}.{name}")]


def _names(value: Any) -> list[str]:
    """Return the names of the configurations in a tuple, if all have one."""
    names = [getattr(each, NAME, "") for each in value] if isinstance(value, tuple) else []
    return names if all(names) else []


def _word(value: Any) -> Any:
    return value.part_name if isinstance(value, Part) else value
