"""Configurations as they print."""

import dataclasses
import inspect
import pathlib
import pydoc
import subprocess
import sys

import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.config.short_repr import field_docs
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.nn.adapters.bottleneck import DepthwiseConfig
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.map import Answer
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.training.recipes import RECIPES
from crisalad_jax.utils.pytree import summary

NAMES = {
    kind.__name__: kind
    for kind in (
        *(cj.ModelConfig, cj.TrainConfig, cj.OptimiserConfig, cj.MiningConfig, cj.LossConfig),
        cj.MixtureSet,
        *(cj.CrossImageConfig, cj.ProjectionConfig, cj.PreprocessingConfig),
        *(cj.SinkhornConfig, ClassesConfig),
        *(type(registry.make(name)) for registry in REGISTRIES.values() for name in registry),
    )
}


def test_a_preset_is_printed_by_what_differs():
    assert repr(cj.PRESETS["b14"]) == "ModelConfig(backbone='vit', aggregator='salad')"
    # ViT-S is 384 wide with 6 heads (DINOv2's table of sizes).
    assert repr(cj.PRESETS["s14"]) == (
        "ModelConfig(backbone=ViTConfig(dim=384, heads=6), aggregator='salad')"
    )


@pytest.mark.parametrize("name", RECIPES)
def test_what_is_printed_makes_the_configuration_again(name):
    config = cj.recipe("l14" if name == "selavpr" else "b14", name)
    made = eval(repr(config), NAMES)
    # Fields that are not in use are left out, so the two print alike.
    assert repr(made) == repr(config)
    assert dataclasses.replace(config, model=made.model, mining=made.mining) == made
    assert max(map(len, repr(config).splitlines())) <= 89  # a comma may follow


def test_what_is_not_in_use_is_left_out():
    assert repr(cj.ProjectionConfig(dim=0, renormalise=False)) == "ProjectionConfig()"
    assert repr(DepthwiseConfig(alpha=0.5)) == "DepthwiseConfig(alpha=0.5)"


def test_a_message_with_a_configuration_is_one_line():
    with pytest.raises(cj.InputError) as caught:
        cj.PreprocessingConfig(antialias=cj.PRESETS["tiny"])
    assert "\n" not in str(caught.value)
    assert "found ModelConfig(image_size=(98, 98), " in str(caught.value)


def fields_of(kind):
    """Annotations of a dataclass's or NamedTuple's fields, as they are written."""
    names = getattr(kind, "_fields", ())
    if dataclasses.is_dataclass(kind):
        names = [field.name for field in dataclasses.fields(kind)]
    texts = {k: v for each in kind.__mro__ for k, v in inspect.get_annotations(each).items()}
    return {name: str(texts.get(name, "")) for name in names}


def test_a_result_takes_a_line_for_each_field_whatever_its_size():
    """A result of 3,000 queries, which printed 120,000 numbers; by hand."""
    indices, similarities = np.zeros((3000, 20), np.int64), np.ones((3000, 20), np.float32)
    neighbours = Neighbours(indices, similarities)
    result = GroupingResult("single", {1: 1 / 3, 5: 0.5}, neighbours, rerank="selavpr:20")
    assert repr(result).splitlines() == [
        "GroupingResult(",
        "    grouping='single',",
        "    recalls={1: 0.3333, 5: 0.5},",
        "    neighbours=Neighbours(indices=int64[3000, 20], similarities=float32[3000, 20]),",
        "    rerank='selavpr:20',",
        ")",
    ]
    paths = tuple(pathlib.Path("set", f"{i}.jpg") for i in range(10_000))
    given = ("n" * 200, pathlib.Path("set"), paths, paths[:2], None, "25 m <> 0")
    benchmark = cj.Benchmark(*given, np.zeros((10_000, 2)), radius=54321.5)
    assert repr(benchmark).splitlines()[3:5] == [
        "    database=('set/0.jpg', ... 9,999 more),",
        "    queries=('set/0.jpg', 'set/1.jpg'),",
    ]
    lines = repr(benchmark).splitlines()
    assert lines[-3:] == ["    database_positions=float64[10000, 2],", "    radius=54321.5,", ")"]


def test_an_answer_of_a_map_prints_in_short_lines():
    image = MapImage("a.jpg", 7176, (500000.0, 5000200.25), "/photographs/of/a/corridor")
    assert repr(Answer(1, 0.7421999573707581, image)).splitlines() == [
        "Answer(",
        "    rank=1,",
        "    similarity=0.7422,",
        "    image=MapImage(name='a.jpg', bytes=7176, position=(500000.0, 5000200.25), root=' ...,",
        ")",
    ]


ABSTRACT = {cj.Adapter, cj.Aggregator, cj.Augmentation, cj.Backbone, cj.CrossImage, cj.Loss}
PUBLIC = [value for name in cj.__all__ if inspect.isclass(value := getattr(cj, name))]
TEXTS = [kind for kind in (*NAMES.values(), *PUBLIC) if fields_of(kind) and kind not in ABSTRACT]


@pytest.mark.parametrize("kind", [kind for kind in TEXTS if kind.__repr__ is not summary])
def test_help_shows_the_texts_below_the_fields(kind):
    shown = " ".join(pydoc.plain(pydoc.render_doc(kind)).replace("\n |", "\n").split())
    for name in fields_of(kind).keys() & field_docs(kind).keys():
        assert f" {name}: {' '.join(field_docs(kind)[name].split())}" in shown


@dataclasses.dataclass
class Base:
    a: int = 1
    """Of the base."""
    b: int = 2
    """Of the base too."""


@dataclasses.dataclass
class Derived(Base):
    a: int = 3
    """Of its own."""


def test_a_class_says_more_than_its_base():
    assert field_docs(Derived) == {"a": "Of its own.", "b": "Of the base too."}


def test_an_import_reads_no_sources():
    program = (
        "import crisalad_jax as cj; cj.TrainConfig; cj.evaluate; cj.Map\n"
        "from crisalad_jax.config.short_repr import field_docs\n"
        "assert field_docs.cache_info().currsize == 0\n"
        "import inspect; assert 'patience: ' in inspect.getdoc(cj.TrainConfig)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
