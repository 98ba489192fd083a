"""Registries: what they take, and what they refuse."""

import abc
import dataclasses
import functools
import re
from typing import Any

import pytest

from crisalad_jax.config.part import Part
from crisalad_jax.config.plugins import load_plugin
from crisalad_jax.config.registry import (
    REGISTRIES,
    Registry,
    count_arguments,
    part_field,
    resolve_names,
)
from crisalad_jax.utils.errors import InputError


@dataclasses.dataclass(frozen=True)
class Bird(Part, abc.ABC):
    @abc.abstractmethod
    def call(self) -> str: ...


@dataclasses.dataclass(frozen=True)
class Duck(Bird):
    volume: int = 1

    def call(self) -> str:
        return "quack" * self.volume


@dataclasses.dataclass(frozen=True)
class Goose(Bird):
    def call(self) -> str:
        return "honk"


class Swan(Duck):
    """No dataclass before it is registered."""

    neck: float = 0.5


@dataclasses.dataclass(frozen=True)
class Named(Duck):
    name: str = "Donald"


@dataclasses.dataclass(frozen=True)
class Mute(Bird):
    pass


@dataclasses.dataclass(frozen=True)
class Needy(Duck):
    weight: int = dataclasses.field(kw_only=True)


@dataclasses.dataclass(frozen=True)
class Listed(Duck):
    notes: list[str] = dataclasses.field(default_factory=list)


def chirp() -> str:
    """A small bird's."""
    return "chirp"


@pytest.fixture
def birds(monkeypatch: pytest.MonkeyPatch) -> Registry[Bird]:
    monkeypatch.setitem(REGISTRIES, "bird", None)  # taken away again
    registry = Registry("bird", Bird)
    registry.register("duck", loud={"volume": 3})(Duck)
    return registry


def test_a_part_is_found_and_made_by_its_name(birds):
    assert birds.register("goose")(Goose) is Goose
    assert list(birds) == ["duck", "goose"]
    assert "goose" in birds
    assert birds.find("goose") is Goose
    assert Goose.part_name == "goose"
    assert Goose.registry is REGISTRIES["bird"] is birds
    assert birds.make("duck") == Duck()
    assert birds.make("duck", "loud") == Duck(volume=3)
    assert birds.make("duck", "low") == Duck()
    assert birds.make("duck", "loud", volume=2) == Duck(volume=2)


def test_the_registration_makes_a_frozen_dataclass(birds):
    birds.register("swan")(Swan)
    assert birds.make("swan", neck=0.7) == Swan(volume=1, neck=0.7)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Swan().neck = 1.0  # type: ignore[misc]
    with pytest.raises(InputError, match=r"^Swan\.neck: found 'long', expected a number$"):
        Swan(neck="long")  # type: ignore[arg-type]


def test_a_name_that_is_taken_is_refused(birds):
    words = rf"^register_bird 'duck': found the name taken by {__name__}.Duck, .* for Goose$"
    with pytest.raises(InputError, match=words):
        birds.register("duck")(Goose)
    assert birds.make("duck", "loud") == Duck(volume=3)


def test_a_class_has_one_name(birds):
    """Files would name the other one."""
    words = "^register_bird 'drake': found Duck registered as 'duck'"
    with pytest.raises(InputError, match=words):
        birds.register("drake")(Duck)
    assert list(birds) == ["duck"]


def test_a_cell_that_runs_again_brings_the_same_part(birds):
    names = {"call": lambda self: "", "__module__": __name__}
    fields = [("volume", int, 5)]
    again = dataclasses.make_dataclass("Duck", fields, bases=(Bird,), frozen=True, namespace=names)
    assert birds.register("duck")(again) is again
    assert birds.make("duck").volume == 5


@pytest.mark.parametrize(
    ("part", "words"),
    [
        *(
            (part, f"found {name}, expected a subclass of Bird$")
            for part, name in ((Registry, "Registry"), (chirp, "chirp"))
        ),
        (Named, "found a field 'name', which has another meaning here$"),
        (Needy, ".* missing 1 required keyword-only argument: 'weight'; expected all methods, a"),
        (Listed, "unhashable type: 'list'; expected all methods, a default for every field"),
        (Mute, ".* abstract class Mute with.* abstract method '?call'?; expected all methods"),
    ],
)
def test_what_is_no_part_is_refused_in_one_line(birds, part, words):
    with pytest.raises(InputError, match=f"^register_bird 'new': {words}") as caught:
        birds.register("new")(part)
    assert "\n" not in str(caught.value)
    assert list(birds) == ["duck"]
    assert not hasattr(part, "part_name") or part.part_name == "duck"


def test_a_function_is_a_part_where_the_kind_says_so(monkeypatch):
    monkeypatch.setitem(REGISTRIES, "bird", None)
    birds = Registry("bird", Bird, of_function=lambda f: {"call": lambda self: f()})
    assert birds.register("chirp")(chirp) is chirp
    assert birds.make("chirp").call() == "chirp"
    assert birds.make("chirp") == birds.make("chirp")
    with pytest.raises(InputError, match=r"^register_bird 'three': found int, expected a subclass"):
        birds.register("three")(3)  # type: ignore[type-var]


@pytest.mark.parametrize("name", ["swan", "", None, ["duck"]])
def test_an_unknown_name_lists_the_known_and_tells_of_plug_ins(birds, name):
    words = rf"^bird: found {re.escape(repr(name))}, expected one of duck .*--plugin FILE\.py"
    with pytest.raises(InputError, match=words):
        birds.find(name)


def test_a_field_takes_a_registered_part_or_its_name(birds):
    @dataclasses.dataclass(frozen=True)
    class Pond:
        bird: Any = part_field(birds, "duck")

        def __post_init__(self) -> None:
            resolve_names(self)

    @dataclasses.dataclass(frozen=True)
    class Loud(Duck):
        """A file would keep it under its parent's name, and load the parent."""

    assert Pond().bird == Pond(bird="duck").bird == Duck()
    assert Pond(bird=Duck(volume=2)).bird == Duck(volume=2)
    for value, words in (
        ("swan", "found 'swan', expected one of duck "),
        (3, "found 3, expected a bird or its name$"),
        (Duck, "found .*, expected a bird or its name$"),
        (Loud(), "found .*Loud.*, which is not registered, exp"),
    ):
        with pytest.raises(InputError, match=f"^Pond.bird: {words}"):
            Pond(bird=value)


@pytest.mark.parametrize(
    ("function", "count"),
    [
        (lambda a, b: 0, 2),
        (lambda a, b, valid=None: 0, 3),
        (lambda a, b, temperature=0.1: 0, 2),
        (lambda a, *, temperature=0.1: 0, 1),
        (lambda *arguments: 0, 3),
        (functools.partial(lambda a, b, c, scale: 0, scale=2), 3),
    ],
)
def test_a_function_is_given_what_it_requires_and_keeps_its_defaults(function, count):
    assert count_arguments(function, "descriptors", "labels", "valid") == count


@pytest.mark.parametrize(
    "function", [lambda a, b, c, scale: 0, lambda a, *, scale: 0], ids=["fourth", "by name"]
)
def test_a_function_that_requires_more_is_refused(function):
    words = r"missing a required .*'scale', expected at most descriptors, labels, valid$"
    with pytest.raises(InputError, match=words):
        count_arguments(function, "descriptors", "labels", "valid")


def test_fields_of_a_plug_ins_part_are_checked_before_its_own_check(birds):
    @birds.register("swan")
    @dataclasses.dataclass(frozen=True)
    class Swan(Duck):
        eggs: int = 3

        def __post_init__(self) -> None:
            assert self.eggs > 0

    with pytest.raises(InputError, match=r"^Swan\.eggs: found 'four', expected a whole number$"):
        birds.make("swan", eggs="four")


@pytest.mark.usefixtures("own_parts")
def test_a_plugin_that_registered_nothing_is_named(tmp_path):
    (tmp_path / "forgot.py").write_text("import crisalad_jax as cj\n")
    load_plugin(str(tmp_path / "forgot.py"))
    with pytest.raises(InputError, match=r"\(is a plug-in missing\?.*; \S*forgot\.py did not"):
        REGISTRIES["loss"].find("margin")
