"""Registries: what they take, and what they refuse."""

import abc
import dataclasses
import functools
from typing import Any

import pytest

from crisalad_jax.config.part import Part
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


@dataclasses.dataclass
class Thawed:
    def call(self) -> str:
        return "drip"


class Plain(Duck):
    """Inherits what makes a dataclass, and is none itself."""


@dataclasses.dataclass(frozen=True)
class Stone:
    def call(self) -> str:
        return ""


@dataclasses.dataclass(frozen=True)
class Named(Duck):
    name: str = "Donald"


@dataclasses.dataclass(frozen=True)
class Plugged(Duck):
    plugin: str = "ducks.py"


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


def test_a_name_that_is_taken_is_refused(birds):
    words = (
        f"^register_bird 'duck': found the name taken by {__name__}.Duck, expected another name "
        "for Goose$"
    )
    with pytest.raises(InputError, match=words):
        birds.register("duck")(Goose)
    assert birds.find("duck") is Duck
    assert birds.make("duck", "loud") == Duck(volume=3)


def test_a_class_has_one_name(birds):
    """Files would name the other one."""
    with pytest.raises(
        InputError, match=r"^register_bird 'drake': found Duck registered as 'duck'"
    ):
        birds.register("drake")(Duck)
    assert list(birds) == ["duck"]
    assert birds.make("duck").part_name == "duck"


def test_a_cell_that_runs_again_brings_the_same_part(birds):
    again = dataclasses.make_dataclass(
        "Duck",
        [("volume", int, 5)],
        bases=(Bird,),
        frozen=True,
        namespace={"call": lambda self: "", "__module__": __name__},
    )
    assert birds.register("duck")(again) is again
    assert birds.make("duck").volume == 5


@pytest.mark.parametrize(
    ("part", "words"),
    [
        *(
            (part, f"found {name}, expected a subclass of Bird with @dataclasses.dataclass\\(froz")
            for part, name in (
                *((each, each.__name__) for each in (Thawed, Plain, int, Stone, chirp)),
                *((3, "int"), (Duck(), "Duck")),
            )
        ),
        (Named, "found a field 'name', which has another meaning here$"),
        (Plugged, "found a field 'plugin', which has another meaning here$"),
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


@pytest.mark.parametrize("name", ["swan", "", None, ["duck"], {}])
def test_an_unknown_name_lists_the_known_and_tells_of_plug_ins(birds, name):
    with pytest.raises(InputError) as caught:
        birds.find(name)
    assert str(caught.value) == (
        f"bird: found {name!r}, expected one of duck (is a plug-in missing? --plugin FILE.py or "
        "MODULE, or load_plugin)"
    )
    with pytest.raises(InputError, match=r"^bird: found "):
        birds.make(name)


def test_a_field_takes_a_part_or_its_name(birds):
    @dataclasses.dataclass(frozen=True)
    class Pond:
        bird: Any = part_field(birds, "duck")

        def __post_init__(self) -> None:
            resolve_names(self)

    assert Pond().bird == Pond(bird="duck").bird == Duck()
    assert Pond(bird=Duck(volume=2)).bird == Duck(volume=2)
    with pytest.raises(InputError, match=r"^Pond.bird: found 'swan', expected one of duck "):
        Pond(bird="swan")
    for other in (3, None, Stone(), Duck):
        with pytest.raises(InputError, match=r"^Pond.bird: found .*, expected a bird or its name$"):
            Pond(bird=other)


def test_an_unregistered_subclass_is_refused_where_a_part_is_expected(birds):
    """A file would keep it under its parent's name, and load the parent."""
    birds.register("duck")(Duck)

    @dataclasses.dataclass(frozen=True)
    class Pond:
        bird: Bird = part_field(birds, "duck")

        def __post_init__(self) -> None:
            resolve_names(self)

    @dataclasses.dataclass(frozen=True)
    class Loud(Duck):
        pass

    with pytest.raises(
        InputError, match=r"^Pond.bird: found .*Loud.*, which is not registered, exp"
    ):
        Pond(Loud())


@pytest.mark.parametrize(
    ("function", "count"),
    [
        (lambda a, b: 0, 2),
        (lambda a, b, valid: 0, 3),
        (lambda a, b, valid=None: 0, 3),
        (lambda a, b, temperature=0.1: 0, 2),
        (lambda a, b, c, temperature=0.1: 0, 3),
        (lambda a, *, temperature=0.1: 0, 1),
        (lambda *arguments: 0, 3),
        (lambda a, **settings: 0, 1),
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
    @birds.register("goose")
    @dataclasses.dataclass(frozen=True)
    class Goose(Bird):
        eggs: int = 3

        def __post_init__(self) -> None:
            assert self.eggs > 0

        def call(self) -> str:
            return "honk"

    assert Goose(eggs=4).eggs == 4
    with pytest.raises(InputError, match=r"^Goose\.eggs: found 'four', expected a whole number$"):
        birds.make("goose", eggs="four")
