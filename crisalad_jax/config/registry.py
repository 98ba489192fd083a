"""Registries of parts (swappable classes, see `Part`), built in or from plug-ins, by name."""

import dataclasses
import functools
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeVar, cast

from crisalad_jax.config.checks import REGISTRY, check_types, choose, require
from crisalad_jax.config.io import PLUGIN, from_plain, to_plain
from crisalad_jax.config.part import NAME, P, Part
from crisalad_jax.config.plugins import load_entry_points, loaded_plugins
from crisalad_jax.config.short_repr import in_one_line, with_field_docs
from crisalad_jax.utils.errors import InputError, locate_errors

_C = TypeVar("_C", bound=Callable[..., Any])
REGISTRIES: dict[str, "Registry[Any]"] = {}
"""All registries by kind of part, such as "aggregator"."""


class Registry(Generic[P]):
    """The registered parts of one kind, such as aggregators or losses, by name."""

    def __init__(
        self,
        kind: str,
        base: type[P],
        *,
        of_function: Callable[[Callable[..., Any]], Mapping[str, Any]] | None = None,
        find_other: Callable[[str], type[P] | None] = lambda name: None,
        others: str = "",
    ) -> None:
        """Create the registry of one kind of part, and set `base.registry` to it.

        Args:
            kind: name of this kind of part in `REGISTRIES` and messages, such as "aggregator".
            base: the class that all parts of this kind inherit from.
            of_function: function that returns the methods, by name, of the part that wraps a given
                plain function; None if parts of this kind cannot be plain functions.
            find_other: function that returns the class for a name that is not registered, or None.
            others: what messages and help call the names that `find_other` accepts ("optax.NAME").
        """
        self.kind, self.base, self._of_function = kind, base, of_function
        self._find_other, self.others = find_other, others
        self._parts: dict[str, type[P]] = {}
        self._presets: dict[str, Mapping[str, Mapping[str, Any]]] = {}
        base.registry = self
        REGISTRIES[kind] = self

    def register(self, name: str, **presets: Mapping[str, Any]) -> Callable[[_C], _C]:
        """Return a decorator that registers a class, or a plain function, under `name`.

        A class that is not a dataclass yet becomes a frozen dataclass.

        Args:
            name: name of the part in configurations, files and flags.
            **presets: fields that differ from the part's defaults, for each preset of model sizes,
                as in `tiny={"depth": 4}`.

        Raises:
            InputError: `name` is empty or contains ':' or ','; or, when decorating, the name is
                taken or the part does not fit this kind.
        """
        where = f"register_{self.kind}"
        require(
            isinstance(name, str) and re.fullmatch(r"(?!\s)[^:,]+(?<!\s)", name) is not None,
            f"{where}: found {name!r}, expected a name without ':' and ',': @{where}('...')",
        )

        def decorate(part: _C) -> _C:
            with locate_errors(f"{where} {name!r}: "):
                self._add(name, self._class_of(part), presets)
            return part

        return decorate

    def _class_of(self, part: Callable[..., Any]) -> type[P]:
        """Return the class of a part, and make one for a plain function."""
        if self._of_function is not None and callable(part) and not inspect.isclass(part):
            members = {
                "__doc__": part.__doc__ or f"The {self.kind} {part.__name__}.",
                "__module__": part.__module__,
                "__qualname__": part.__qualname__,
                **self._of_function(part),
            }
            made = type(part.__name__, (self.base,), members)
            return cast(type[P], dataclasses.dataclass(frozen=True)(made))
        is_part = isinstance(part, type) and issubclass(part, self.base)
        name = getattr(part, "__qualname__", type(part).__name__)
        require(is_part, f"found {name}, expected a subclass of {self.base.__name__}")
        if "__dataclass_params__" not in vars(part):
            part = dataclasses.dataclass(frozen=True)(cast(Any, part))
        methods = {each for each in dir(self.base) if callable(getattr(self.base, each))}
        for field in dataclasses.fields(cast(Any, part)):
            # Files store a part's own name and plug-in among its fields.
            is_free = field.name not in {NAME, PLUGIN, *methods}
            require(is_free, f"found a field {field.name!r}, which has another meaning here")
        return cast(type[P], part)

    def _add(self, name: str, part: type[P], presets: Mapping[str, Mapping[str, Any]]) -> None:
        taken = _home(self._parts.get(name, part))
        # A notebook's cell or a plug-in's file that runs again registers the same part.
        require(
            taken == _home(part),
            f"found the name taken by {taken}, expected another name for {part.__qualname__}",
        )
        earlier = vars(part).get("part_name", name)
        require(
            earlier == name,
            f"found {part.__qualname__} registered as {earlier!r}, expected one name for a class",
        )
        try:
            for fields in ({}, *presets.values()):
                hash(part(**fields))
        except TypeError as error:
            raise InputError(
                f"{error}; expected all methods, a default for every field, values that can be "
                "hashed, such as tuples instead of lists, and presets of these fields"
            ) from error
        part.part_name = name
        self._parts[name], self._presets[name] = with_field_docs(part), presets
        try:
            from_plain(self.base, to_plain(part()), source="settings")  # files can store them
        except InputError:
            del self._parts[name], self._presets[name]
            raise

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of all registered parts, in alphabetical order."""
        return iter(sorted(self._parts))

    def __contains__(self, name: object) -> bool:
        """Return whether there is a part with this name."""
        if not isinstance(name, str):
            return False
        return name in self._parts or self._find_other(name) is not None

    def find(self, name: str, plugin: str | None = None, *, where: str | None = None) -> type[P]:
        """Return the class of the part with this name; if needed, load installed plug-ins first.

        Args:
            name: the part's name.
            plugin: the plug-in that registered the part, if known, for the message.
            where: what the message calls the name; None calls it by this registry's kind.

        Raises:
            InputError: no part has this name; the message lists all parts.
        """
        if name not in self:
            load_entry_points()
        if name not in self:
            hint = "is a plug-in missing? --plugin FILE.py or MODULE, or load_plugin"
            if loaded := loaded_plugins():
                hint += f"; {', '.join(loaded)} did not register it"
            if plugin is not None:
                hint = f"the plug-in {plugin} had it: --plugin {plugin}, or load_plugin"
            names = ", ".join([*self, *([self.others] if self.others else [])])
            raise InputError(
                f"{where or self.kind}: found {name!r}, expected one of {names} ({hint})"
            )
        return self._parts.get(name) or cast(type[P], self._find_other(name))

    def make(self, name: str, preset: str | None = None, **fields: Any) -> P:
        """Make a part by name: its defaults, changed by a preset of model sizes, then by `fields`.

        Raises:
            InputError: no part has this name, or a field is out of range.
        """
        part = self.find(name)
        return part(**{**self._presets.get(name, {}).get(preset or "", {}), **fields})

    def resolve(self, value: Any, where: str) -> P:
        """Return a part as it is or, given a name, make that part with its default settings.

        Args:
            value: a part of this kind, or its name.
            where: what messages call the value, such as "ModelConfig.aggregator".

        Raises:
            InputError: `value` is a name that is not registered, or is not a part of this kind.
        """
        if isinstance(value, str):
            return self.find(value, where=where)()
        is_part = isinstance(value, self.base)
        if not is_part or "part_name" not in vars(type(value)):
            found = f"{in_one_line(value)}{', which is not registered' if is_part else ''}"
            article = "an" if self.kind[0] in "aeiou" else "a"
            raise InputError(f"{where}: found {found}, expected {article} {self.kind} or its name")
        return value


def make_part(kind: str, name: str, **settings: Any) -> Any:
    """Make a registered part by its kind and name, with settings.

    Args:
        kind: kind of part, such as "aggregator", "loss" or "optimiser".
        name: name of the part in configurations and flags.
        **settings: fields of the part that differ from their defaults.

    Returns:
        The part, to pass as the configuration's field for that kind.

    Raises:
        InputError: there is no such kind, part or setting, or a value does not fit.

    Example:
        >>> from crisalad_jax import OptimiserConfig
        >>> muon = make_part("optimiser", "optax.contrib.muon", ns_steps=3)
        >>> OptimiserConfig(kind=muon, schedule=make_part("schedule", "cosine", end_fraction=0.1))
        OptimiserConfig(
            kind=optax.contrib.muon(ns_steps=3),
            schedule=CosineSchedule(end_fraction=0.1),
        )
    """
    registry = choose("kind", kind, REGISTRIES)
    part = registry.find(name)
    names = [field.name for field in dataclasses.fields(part)]
    unknown = ", ".join(sorted(settings.keys() - set(names)))
    expected = f"one of {', '.join(names)}" if names else "none: it has no settings"
    require(not unknown, f"{kind} {name}: found a setting {unknown}, expected {expected}")
    return registry.make(name, **settings)


def add_named(kind: str, table: dict[str, Any], name: str, value: Any) -> None:
    """Add `value`, a class or function, to `table` under `name`; `kind` is for messages.

    Raises:
        InputError: the name is taken by a class or function of another module.
    """
    taken = table.get(name, value).__module__
    require(
        taken == value.__module__,
        f"register_{kind} {name!r}: found the name taken by {taken}, expected another",
    )
    table[name] = value


def _home(part: type[Part]) -> str:
    return f"{part.__module__}.{part.__qualname__}"


def part_field(registry: Registry[P], default: str | type[P]) -> Any:
    """Return a dataclass field for a part; `default` is the name or class of its default part."""
    make: Any = functools.partial(registry.make, default) if isinstance(default, str) else default
    return dataclasses.field(default_factory=make, metadata={REGISTRY: registry})


def resolve_names(config: Any) -> None:
    """Check the field types of a new configuration, and replace names of parts with the parts.

    Raises:
        InputError: a name is not registered, a part is not of its field's kind, or another value is
            not of its field's type.
    """
    check_types(config)
    for field in dataclasses.fields(config):
        registry = field.metadata.get(REGISTRY)
        if registry is not None:
            where = f"{type(config).__name__}.{field.name}"
            part = registry.resolve(getattr(config, field.name), where)
            object.__setattr__(config, field.name, part)


def with_arguments(*offered: str) -> Callable[[Callable[..., Any]], Mapping[str, Any]]:
    """Return a `Registry`'s `of_function` for parts whose `apply` takes the `offered` arguments."""

    def methods(function: Callable[..., Any]) -> Mapping[str, Any]:
        count = count_arguments(function, *offered)
        return {"apply": lambda self, *given, **_: function(*given[:count])}

    return methods


def count_arguments(function: Callable[..., Any], *offered: str) -> int:
    """Return how many of the offered arguments, in their order, a plain function takes.

    A function takes the arguments that it requires, and those whose names match the offered ones.
    Any other parameter, such as `temperature=0.1`, keeps its default.

    Raises:
        InputError: the function requires more arguments than are offered.
    """
    signature = inspect.signature(function)
    parameters = signature.parameters.values()
    if any(each.kind is each.VAR_POSITIONAL for each in parameters):
        return len(offered)
    by_place = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    taken = [
        number
        for number, (each, name) in enumerate(zip(by_place, offered, strict=False), 1)
        if each.default is each.empty or each.name == name
    ]
    count = max(taken, default=0)
    try:
        signature.bind(*offered[:count])
    except TypeError as error:
        name = getattr(function, "__name__", function)
        raise InputError(f"{name}: {error}, expected at most {', '.join(offered)}") from error
    return count
