"""The base class of swappable parts: frozen dataclasses that are registered by name.

A part's fields are its settings, and its methods are its behaviour. Each kind of part has a base
class, which defines the methods, and a registry, which maps names to classes (`config.registry`).
"""

import dataclasses
import functools
import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, dataclass_transform

from crisalad_jax.config.checks import check_types
from crisalad_jax.config.short_repr import concise_repr, default_of

_T = TypeVar("_T")
NAME = "name"
"""Key of a part's name among its fields."""
_NON_SEMANTIC = "non-semantic"


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
@dataclasses.dataclass(frozen=True)
class Part:
    """Base class of parts, which can be replaced without changing this package.

    Registering a subclass makes it a frozen dataclass.
    """

    registry: ClassVar[Any]
    """The `Registry` of this kind of part."""
    part_name: ClassVar[str]

    def __post_init__(self) -> None:
        """Check that the fields hold values of their types."""
        check_types(self)

    def __init_subclass__(cls, **options: Any) -> None:
        """Add the concise `repr`, and check fields before the class's own `__post_init__`."""
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = concise_repr  # pyright: ignore[reportAttributeAccessIssue]
        own = vars(cls).get("__post_init__")
        if own is None:
            return

        @functools.wraps(own)
        def check_first(self: Part) -> None:
            check_types(self)
            own(self)

        cls.__post_init__ = check_first

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by name, because the class made from a plain function cannot be imported."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _restore, (self.registry.base, self.part_name, fields, type(self).__module__)


def _restore(base: type[Part], name: str, fields: Mapping[str, Any], module: str) -> Part:
    importlib.import_module(module)  # registers the part in a new process
    return base.registry.find(name)(**fields)


P = TypeVar("P", bound=Part)

if TYPE_CHECKING:

    class OrName(Generic[P]):
        """A field that accepts a part or its name, and holds the part."""

        def __get__(self, instance: object, owner: Any = None) -> P:
            """Return the part."""
            ...

        def __set__(self, instance: object, value: P | str) -> None:
            """Accept a part or its name."""
            ...

else:

    class OrName:
        """The type of a field for a part; a name given for it is replaced by the part."""

        def __class_getitem__(cls, kind: type[Part]) -> Any:
            """Return the type of the values that the field accepts."""
            return kind | str


def parts_of(config: Any, prefix: str = "") -> dict[str, Part]:
    """Return all parts in a configuration by the dotted names of their fields."""
    parts: dict[str, Part] = {prefix: config} if isinstance(config, Part) else {}
    inner: Mapping[Any, Any] = {}
    if dataclasses.is_dataclass(config):
        inner = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    elif isinstance(config, tuple):
        inner = dict(enumerate(config))
    for name, each in inner.items():
        parts |= parts_of(each, f"{prefix}.{name}".removeprefix("."))
    return parts


def non_semantic_field(default: _T) -> _T:
    """Return a dataclass field that, for given parameters and inputs, affects rounding at most.

    Examples are the initialisation, dropout, remat and image size. Weight files that differ only in
    such non-semantic fields hold the same model.
    """
    return dataclasses.field(default=default, metadata={_NON_SEMANTIC: True})


def with_non_semantic_fields_of(other: Any, config: _T) -> _T:
    """Return `config` with the non-semantic fields of `other`, also in parts of the same class."""
    if type(config) is not type(other) or not dataclasses.is_dataclass(config):
        return config
    changes = {
        field.name: getattr(other, field.name)
        if field.metadata.get(_NON_SEMANTIC)
        else with_non_semantic_fields_of(getattr(other, field.name), getattr(config, field.name))
        for field in dataclasses.fields(config)
    }
    return dataclasses.replace(config, **changes)  # pyright: ignore


def fingerprint_fields(config: Any) -> Any:
    """Return the fields that outputs depend on and that differ from their defaults, as JSON values.

    A field that a later version adds therefore changes nothing while it has its default value.
    """
    if isinstance(config, tuple):
        return [fingerprint_fields(item) for item in config]
    if not dataclasses.is_dataclass(config):
        return config
    plain = {NAME: config.part_name} if isinstance(config, Part) else {}
    for field in dataclasses.fields(config):
        value = fingerprint_fields(getattr(config, field.name))
        # Not the configurations themselves, which may differ only in non-semantic fields.
        is_semantic = not field.metadata.get(_NON_SEMANTIC)
        if is_semantic and value != fingerprint_fields(default_of(field)):
            plain[field.name] = value
    return plain
