"""Configurations to and from plain JSON values."""

import dataclasses
import json
import pathlib
from typing import Any, TypeVar

import cattrs

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
    converter = cattrs.Converter(forbid_extra_keys=True)
    try:
        return converter.structure(value, kind)
    except cattrs.BaseValidationError as error:
        reasons = "; ".join(cattrs.transform_error(error, path="config"))
        raise InputError(f"{source}: {reasons}") from error


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
