"""Configurations to and from plain JSON values."""

import dataclasses
import json
import pathlib
from typing import Any, TypeVar

import cattrs
import cattrs.errors
import cattrs.v

from crisalad_jax.errors import InputError

_T = TypeVar("_T")


def to_plain(config: Any) -> dict[str, Any]:
    """A configuration as nested dictionaries of JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_plain(kind: type[_T], value: Any, *, source: str) -> _T:
    """The configuration of class `kind` that `to_plain` gave.

    Fields left out take their defaults.

    Raises:
        InputError: naming `source`, an unknown field, or a value that does not fit.
    """
    if not isinstance(value, dict):
        raise InputError(f"{source}: found {type(value).__name__}, expected an object of fields")
    try:
        return _CONVERTER.structure(value, kind)
    except cattrs.BaseValidationError as error:
        reasons = "; ".join(cattrs.transform_error(error, "config", _reason))
        raise InputError(f"{source}: {reasons}") from error


def _exactly(value: Any, kind: type) -> Any:
    """A plain value of just this type, where cattrs would convert: 3.7 is no number of epochs."""
    if type(value) is kind:
        return value
    if kind is float and type(value) is int:
        return float(value)
    raise InputError(f"found {value!r}, expected {kind.__name__}")


def _names(value: Any, _: type) -> tuple[str, ...]:
    """A list of names; a string is no list of its letters."""
    if not isinstance(value, list):
        raise InputError(f"found {value!r}, expected a list of names")
    return tuple(_exactly(name, str) for name in value)


def _reason(error: BaseException, kind: type | None) -> str:
    # A configuration's own check, and what cattrs has no category for, say more than the category.
    if isinstance(error, ValueError) or type(error) is cattrs.errors.CattrsError:
        return str(error)
    return cattrs.v.format_exception(error, kind)


_CONVERTER = cattrs.Converter(forbid_extra_keys=True)
for _kind in (bool, int, float, str):
    _CONVERTER.register_structure_hook(_kind, _exactly)
_CONVERTER.register_structure_hook_func(lambda kind: kind == tuple[str, ...], _names)


def read_config(kind: type[_T], path: pathlib.Path) -> _T:
    """Read a configuration that a run wrote.

    Raises:
        InputError: the file is missing, is not JSON, or holds another configuration.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read this configuration: {error}") from error
    return from_plain(kind, value, source=str(path))


def differences(found: Any, expected: Any, prefix: str = "") -> list[str]:
    """The fields in which two configurations of one class differ, as `name: found, expected`."""
    if dataclasses.is_dataclass(found) and type(found) is type(expected):
        return [
            line
            for field in dataclasses.fields(found)
            for line in differences(
                getattr(found, field.name), getattr(expected, field.name), f"{prefix}.{field.name}"
            )
        ]
    if found == expected:
        return []
    return [f"{prefix.removeprefix('.')}: found {found}, expected {expected}"]
