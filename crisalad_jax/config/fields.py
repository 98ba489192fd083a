"""Mark the fields of a configuration that a trained model's outputs do not depend on."""

import dataclasses
from typing import Any, TypeVar

from crisalad_jax.config.io import NAME
from crisalad_jax.config.parts import Part

_T = TypeVar("_T")
_FREE = "free"


def free_field(default: _T) -> _T:
    """Return a dataclass field that the outputs of given parameters do not depend on.

    Examples are the initialisation, dropout and remat. Files of weights that differ in such fields
    hold the same model.
    """
    return dataclasses.field(default=default, metadata={_FREE: True})


def is_free(field: dataclasses.Field[Any]) -> bool:
    """Return whether a field was made by `free_field`."""
    return bool(field.metadata.get(_FREE))


def with_free_fields_of(other: Any, config: _T) -> _T:
    """Return `config` with the free fields of `other`, also in parts that both have."""
    if type(config) is not type(other) or not dataclasses.is_dataclass(config):
        return config
    changes = {
        field.name: getattr(other, field.name)
        if is_free(field)
        else with_free_fields_of(getattr(other, field.name), getattr(config, field.name))
        for field in dataclasses.fields(config)
    }
    return dataclasses.replace(config, **changes)  # pyright: ignore


def essence(config: Any) -> Any:
    """Return the fields that the outputs depend on, as JSON values, without those at defaults.

    A field that a later version adds therefore changes nothing while it has its default.
    """
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        return to_plain_value(config)
    plain = {NAME: config.part_name} if isinstance(config, Part) else {}
    for field in dataclasses.fields(config):
        value = essence(getattr(config, field.name))
        # Not the configurations themselves, which may differ in what is free inside them alone.
        if not is_free(field) and value != essence(_default(field)):
            plain[field.name] = value
    return plain


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def to_plain_value(value: Any) -> Any:
    """Return a tuple as a list, and other values as they are."""
    return [to_plain_value(item) for item in value] if isinstance(value, tuple) else value
