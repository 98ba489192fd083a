"""Swappable parts: frozen dataclasses registered by name, both built-in and of plug-ins.

A part's fields are its settings, and its methods are its behaviour. Each kind of part has a base
class, which defines the methods, and a registry, which maps names to classes.
"""

import dataclasses
import functools
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

from crisalad_jax.config.checks import REGISTRY, check_types
from crisalad_jax.config.concise import concise_repr, in_one_line
from crisalad_jax.config.field_docs import with_field_docs
from crisalad_jax.config.plugins import load_entry_points, load_plugin, plugin_of
from crisalad_jax.utils.errors import InputError


@dataclasses.dataclass(frozen=True)
class Part:
    """Base class of everything that can be swapped without changing this package."""

    registry: ClassVar["Registry[Any]"]
    part_name: ClassVar[str]

    def __post_init__(self) -> None:
        """Check that the fields hold values of their types."""
        check_types(self)

    def __init_subclass__(cls, **options: Any) -> None:
        """Print what differs, and check fields before the class's own `__post_init__`."""
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
        """Pickle by name, so that another process finds a part of a plug-in file."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        module = type(self).__module__
        return _restore, (self.registry.base, self.part_name, fields, module, plugin_of(module))


P = TypeVar("P", bound=Part)

if TYPE_CHECKING:

    class OrName(Generic[P]):
        """A field that takes a part or its name, and has the part."""

        def __get__(self, instance: object, owner: Any = None) -> P:
            """Return the part."""
            ...

        def __set__(self, instance: object, value: P | str) -> None:
            """Take a part or its name."""
            ...

else:

    class OrName:
        """The type of a field for a part; a name given for it is replaced by the part."""

        def __class_getitem__(cls, kind: type[Part]) -> Any:
            """Return the type of the values that the field accepts."""
            return kind | str


_C = TypeVar("_C", bound=Callable[..., Any])
REGISTRIES: dict[str, "Registry[Any]"] = {}
"""All registries by kind."""


def _restore(
    base: type[Part], name: str, fields: Mapping[str, Any], module: str, plugin: str | None
) -> Part:
    registry = base.registry
    if name not in registry.names():  # a new process: what registers the part was not imported yet
        if plugin is None:
            importlib.import_module(module)
        else:
            load_plugin(plugin)
    return registry.find(name)(**fields)


class Registry(Generic[P]):
    """The parts of one kind by name."""

    def __init__(
        self,
        kind: str,
        base: type[P],
        *,
        of_function: Callable[[Callable[..., Any]], Mapping[str, Any]] | None = None,
    ) -> None:
        """Make the registry of a kind, and set `base.registry` to it.

        Args:
            kind: what messages call a part of this kind, such as "aggregator".
            base: the class that all parts of this kind inherit from.
            of_function: for kinds whose parts may be plain functions, returns the methods of the
                part that wraps a function.
        """
        self.kind, self.base, self._of_function = kind, base, of_function
        self._parts: dict[str, type[P]] = {}
        self._presets: dict[str, Mapping[str, Mapping[str, Any]]] = {}
        base.registry = self
        REGISTRIES[kind] = self

    def register(self, name: str, **presets: Mapping[str, Any]) -> Callable[[_C], _C]:
        """Return a decorator that registers a class, or a plain function, under `name`.

        Args:
            name: what configurations, files and flags call the part.
            presets: by the name of a preset of model sizes, the fields that differ there from the
                part's defaults.

        Raises:
            InputError: when it decorates: the name is taken, or the part is no frozen dataclass of
                this kind.
        """

        def decorate(part: _C) -> _C:
            made = self._class_of(name, part)
            self._add(name, made, presets)
            try:
                self._check_settings(name, made, presets)
            except InputError:
                del self._parts[name], self._presets[name]
                raise
            return part

        where = f"register_{self.kind}"
        if not isinstance(name, str):
            raise InputError(f"{where}: found {name!r}, expected a name: @{where}('...')")
        if not name or set(name) & set(":,") or name != name.strip():
            raise InputError(f"{where}: found the name {name!r}, expected one without ':' and ','")
        return decorate

    def _check_settings(self, name: str, part: type[P], presets: Mapping[str, Any]) -> None:
        """Check that files can keep the settings, and that the presets' fields are there."""
        from crisalad_jax.config.io import from_plain, to_plain

        where = f"register_{self.kind} {name!r}"
        fields = [field.name for field in dataclasses.fields(part)]
        unknown = [each for preset in presets.values() for each in preset if each not in fields]
        if unknown:
            raise InputError(
                f"{where}: found {', '.join(unknown)} in a preset, expected {', '.join(fields)}"
            )
        from_plain(self.base, to_plain(part()), source=where)

    def _class_of(self, name: str, part: Callable[..., Any]) -> type[P]:
        where = f"register_{self.kind} {name!r}"
        if not inspect.isclass(part):
            if self._of_function is None or not callable(part):
                raise InputError(
                    f"{where}: found {type(part).__name__}, expected a frozen dataclass that "
                    f"inherits from {self.base.__name__}"
                )
            return self._made_of(part)
        parameters = part.__dict__.get("__dataclass_params__")
        if parameters is None or not parameters.frozen:
            raise InputError(
                f"{where}: found {part.__qualname__}, which is no frozen dataclass, expected "
                "@dataclasses.dataclass(frozen=True) below the registration"
            )
        if not issubclass(part, self.base):
            raise InputError(
                f"{where}: found {part.__qualname__}, expected a subclass of {self.base.__name__}"
            )
        fields = [field.name for field in dataclasses.fields(part)]
        for reserved in {"name", "plugin"} & set(fields):
            raise InputError(
                f"{where}: found a field {reserved!r}, which files keep the part's own in"
            )
        hidden = [name for name in fields if callable(getattr(self.base, name, None))]
        if hidden:
            raise InputError(f"{where}: found a field {hidden[0]!r}, which is the name of a method")
        missing = sorted(getattr(part, "__abstractmethods__", ()))
        if missing:
            raise InputError(f"{where}: found no method {', '.join(missing)}, expected it")
        try:
            hash(part())
        except TypeError as error:
            raise InputError(
                f"{where}: {error}; expected a default for every field, and values that can be "
                "hashed, such as tuples for lists"
            ) from error
        return part

    def _made_of(self, function: Callable[..., Any]) -> type[P]:
        """Wrap a plain function in a part without settings."""
        assert self._of_function is not None
        members = {
            "__doc__": function.__doc__ or f"The {self.kind} {function.__name__}.",
            "__module__": function.__module__,
            "__qualname__": function.__qualname__,
            **self._of_function(function),
        }
        made = type(function.__name__, (self.base,), members)
        return cast(type[P], dataclasses.dataclass(frozen=True)(made))

    def _add(self, name: str, part: type[P], presets: Mapping[str, Mapping[str, Any]]) -> None:
        there = self._parts.get(name)
        # A notebook's cell or a plug-in's file that runs again registers the same part.
        if there is not None and _home(there) != _home(part):
            raise InputError(
                f"register_{self.kind}: found the name {name!r} taken by {there.__module__}."
                f"{there.__qualname__}, expected another name for {part.__qualname__}"
            )
        earlier = vars(part).get("part_name", name)
        if earlier != name:
            raise InputError(
                f"register_{self.kind} {name!r}: found {part.__qualname__} registered as "
                f"{earlier!r}, expected one name for a class"
            )
        part.part_name = name
        self._parts[name] = with_field_docs(part)
        self._presets[name] = presets

    def names(self) -> list[str]:
        """Return the names of all parts, in order."""
        return sorted(self._parts)

    def __iter__(self) -> Iterator[str]:
        """Iterate over `names`."""
        return iter(self.names())

    def __contains__(self, name: object) -> bool:
        """Return whether a part has this name."""
        return name in self._parts

    def find(self, name: str, plugin: str | None = None) -> type[P]:
        """Return the class of the part with this name; if needed, load installed plug-ins first.

        Args:
            name: of the part.
            plugin: the plug-in that registered it, where that is known.

        Raises:
            InputError: there is none; the message lists those there are.
        """
        # A file may have any value in the place of a name, even an unhashable one.
        if name not in self.names():
            load_entry_points()
        if name not in self.names():
            hint = "is a plug-in missing? --plugin FILE.py or MODULE, or load_plugin"
            if plugin is not None:
                hint = f"the plug-in {plugin} had it: --plugin {plugin}, or load_plugin"
            raise InputError(
                f"{self.kind}: found {name!r}, expected one of {', '.join(self.names())} ({hint})"
            )
        return self._parts[name]

    def make(self, name: str, preset: str | None = None, **fields: Any) -> P:
        """Make the part with this name, with the settings of the preset of model sizes.

        Raises:
            InputError: what `find` raises, or a field is out of range.
        """
        part = self.find(name)
        return part(**{**self._presets[name].get(preset or "", {}), **fields})

    def resolve(self, value: Any, where: str) -> P:
        """Return a part as it is, and make one that is given by its name.

        Args:
            value: a part or its name.
            where: what messages call the value.

        Raises:
            InputError: a name that is not registered, or a value that is no part of this kind.
        """
        if isinstance(value, str):
            try:
                return self.make(value)
            except InputError as error:
                # `where` says what kind of part it is for.
                words = str(error).removeprefix(f"{self.kind}: ")
                raise InputError(f"{where}: {words}") from error
        if not isinstance(value, self.base):
            raise InputError(
                f"{where}: found {in_one_line(value)}, expected a {self.kind} or its name"
            )
        if "part_name" not in vars(type(value)):
            raise InputError(
                f"{where}: found {type(value).__qualname__}, which is not registered, expected "
                f"@register_{self.kind}(NAME) above it: files keep parts by name"
            )
        return value


def part_field(registry: Registry[P], default: str | type[P]) -> Any:
    """Return a dataclass field for a part, by default the one with this name, or of this class."""
    make: Any = functools.partial(registry.make, default) if isinstance(default, str) else default
    return dataclasses.field(default_factory=make, metadata={REGISTRY: registry})


def resolve_names(config: Any) -> None:
    """Check a new configuration's types, and replace names by parts.

    Raises:
        InputError: a name that is not registered, a value that is no part of the kind, or what
            `check_types` raises.
    """
    check_types(config)
    for field in dataclasses.fields(config):
        registry = field.metadata.get(REGISTRY)
        if registry is not None:
            where = f"{type(config).__name__}.{field.name}"
            part = registry.resolve(getattr(config, field.name), where)
            object.__setattr__(config, field.name, part)


def count_arguments(function: Callable[..., Any], *offered: str) -> int:
    """Return how many of the offered arguments, in their order, a plain function takes.

    It takes those that it requires, and those that have the name of the one that is offered. A
    setting with a default, such as `temperature=0.1`, keeps it.

    Raises:
        InputError: it requires more arguments.
    """
    parameters = list(inspect.signature(function).parameters.values())
    if any(each.kind is each.VAR_POSITIONAL for each in parameters):
        return len(offered)
    by_place = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    taken = [
        number
        for number, each in enumerate(by_place, 1)
        if each.default is each.empty or each.name in offered[number - 1 : number]
    ]
    count = max(taken, default=0)
    more = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.default is p.empty]
    more += [each.name for each in by_place[len(offered) : count]]
    if more:
        raise InputError(
            f"{getattr(function, '__name__', function)}: found the arguments {', '.join(more)}, "
            f"expected at most {', '.join(offered)}"
        )
    return count


def _home(part: type[Part]) -> tuple[str, str]:
    return part.__module__, part.__qualname__


def parts_of(config: Any, prefix: str = "") -> dict[str, Part]:
    """Return all parts in a configuration by the dotted names of their fields."""
    parts: dict[str, Part] = {}
    if isinstance(config, Part):
        parts[prefix] = config
    if dataclasses.is_dataclass(config):
        for field in dataclasses.fields(config):
            name = f"{prefix}.{field.name}" if prefix else field.name
            parts |= parts_of(getattr(config, field.name), name)
    return parts
