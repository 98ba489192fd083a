"""Methods and rows that are no line of a table: any recipe, and any registered part."""

import dataclasses
import json

import pytest

from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.data.augmentations import AUGMENTATIONS
from crisalad_jax.experiments.comparison import METHODS, ComparisonConfig, compare, ledger, prepare
from crisalad_jax.experiments.comparison.ablation import row_training
from crisalad_jax.experiments.comparison.methods import method_of, method_training, training_with
from crisalad_jax.experiments.comparison.plan import file_name
from crisalad_jax.training.recipes import from_scratch, recipe
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import fails


def test_what_names_stand_for():
    for name in METHODS:
        assert method_of(name, "tiny") is METHODS[name]
    for part in ("netvlad", "patch-netvlad"):
        assert method_of(part, "tiny") is METHODS[f"crisalad+{part}"]
    for name, whole in (
        ("crisalad-1e-4", "crisalad-1e-4"),
        ("step:newton", "crisalad+step:newton"),
        ("triplet", "crisalad+triplet"),
        ("salad+newton", "salad+newton"),
    ):
        method = method_of(name, "tiny")
        assert (method.title, method.recipe, method.rerank) == (whole, whole, None)
    assert file_name("step:newton") == "step-newton"
    assert file_name("a/b c:d") == "a-b-c-d"
    assert {file_name(name) for name in METHODS} == set(METHODS)


def test_a_method_is_trained_as_its_recipe_says():
    for name in ("crisalad-1e-4", "crisalad+step:newton", "crisalad+gem", "salad+newton"):
        expected = recipe("tiny", name)
        assert method_training(name, "tiny", from_nothing=False) == expected
        assert method_training(name, "tiny", from_nothing=True) == from_scratch(expected)


def test_a_row_swaps_one_part():
    base = row_training("crisalad", "tiny", from_nothing=True)
    newton = row_training("newton", "tiny", from_nothing=True)
    assert newton.model.aggregator.sinkhorn.step.part_name == "newton"
    sinkhorn = base.model.aggregator.sinkhorn
    aggregator = dataclasses.replace(newton.model.aggregator, sinkhorn=sinkhorn)
    model = dataclasses.replace(newton.model, aggregator=aggregator)
    assert dataclasses.replace(newton, model=model) == base
    stop = row_training("gradient:stop", "tiny", from_nothing=True)
    assert stop.model.aggregator.sinkhorn.gradient.part_name == "stop"


@pytest.mark.parametrize("name", ["light", "rand-augment", "none"])
def test_an_augmentation_that_is_compared_stays(name):
    """From nothing there is another one than the recipe's, except where it is what is compared."""
    part = AUGMENTATIONS.make(name)
    found = training_with(part, "tiny", from_nothing=True)
    assert found.augmentation == part
    base = row_training("crisalad", "tiny", from_nothing=True)
    assert dataclasses.replace(found, augmentation=base.augmentation) == base


def test_variants_of_parts(settings):
    names = ("crisalad", "step:newton", "anyloc")
    prepared = prepare(ComparisonConfig(**settings | {"names": names}))
    assert [variant.labels[0] for variant in prepared.variants] == [
        *("CriSALAD", "crisalad+step:newton", "AnyLoc")
    ]
    assert [variant.learns for variant in prepared.variants] == [True, True, False]
    ablation = prepare(ComparisonConfig(**settings | {"kind": "ablate", "names": names[:2]}))
    assert ablation.variants[1].labels == ("step:newton", "depthwise", "yes", "0.001", "linear")


def test_two_names_of_one_folder(settings):
    with pytest.raises(InputError, match=r"--methods: found .* expected at least one, each once"):
        ComparisonConfig(**settings | {"names": ("step:newton", "step:newton")})


def test_unknown_names_are_refused(flags, capfd, tmp_path):
    rest = flags[flags.index("--preset") :]
    for command, name, words in (
        (("compare", "--methods"), "step:newtons", "--methods: found 'step:newtons', expected one"),
        (("compare", "--methods"), "kind:newton", "kind of aggregator, step, dustbin, loss"),
        (("ablate", "--rows"), "crisalad-1e-4", "--rows: found 'crisalad-1e-4', expected one of"),
    ):
        fails(capfd, *command, name, *rest, "--out", tmp_path / "out", words=(words,))
    assert not list(tmp_path.iterdir())


PLUGIN = '''
from crisalad_jax import register_aggregator

@register_aggregator("average")
def average(features):
    """The mean of all patches."""
    return features.patches.mean(axis=0)
'''


@pytest.mark.usefixtures("quick")
def test_a_plug_ins_part_from_training_to_the_table(settings, tmp_path, monkeypatch):
    """In a folder of a safe name; another source behind its name is refused."""
    registry = REGISTRIES["aggregator"]
    for name in ("_parts", "_presets"):
        monkeypatch.setattr(registry, name, dict(getattr(registry, name)))
    exec(compile(PLUGIN, "plugin.py", "exec"), {"__name__": "plugin"})
    name, out, lines = "aggregator:average", tmp_path / "out", []
    monkeypatch.setattr(ledger, "source_digest", lambda part: "first")
    config = ComparisonConfig(**settings | {"names": (name,), "seeds": 1, "epochs": 1})
    summary = compare(config, out, say=lines.append, quiet=True)
    assert lines[0] == "1 to compare, tiny, what is trained starts from nothing"
    (row,) = summary.rows
    assert (row.name, row.labels, row.dimension) == (name, (f"crisalad+{name}",), 32)
    assert (out / "crisalad+aggregator-average" / "seed-0" / "run" / "last.safetensors").is_file()
    assert json.loads((out / "results.json").read_text())["rows"][0]["name"] == name
    assert (out / "index.html").is_file()
    monkeypatch.setattr(ledger, "source_digest", lambda part: "second")
    with pytest.raises(InputError, match="aggregator average: found changed since this compar"):
        compare(config, out, quiet=True)
