"""What a comparison is made of, and what is refused before any work."""

import dataclasses

import pytest

from crisalad_jax.experiments.comparison import ComparisonConfig, prepare
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes import RECIPES, recipe
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import fails


def test_batches_fit_the_training_set(config):
    """Eight places of three images: all in one batch, a quarter of three steps to warm up."""
    (variant,) = prepare(config).variants
    training = variant.training
    assert (training.places_per_batch, training.images_per_place) == (8, 3)
    assert (training.min_images, training.epochs, training.patience) == (3, 3, None)
    assert training.optimiser.warmup_steps == 0
    assert (training.trainable, training.augmentation.part_name) == ("all", "light")
    assert training.optimiser.learning_rate == recipe("tiny").optimiser.learning_rate


def test_the_same_images_a_batch_for_all(settings):
    names = ("crisalad", "salad", "cricavpr")
    prepared = prepare(ComparisonConfig(**settings | {"names": names}))
    assert {v.training.places_per_batch for v in prepared.variants} == {8}


def test_from_a_backbone_recipes_are_as_they_are(settings, shared):
    backbone = str(shared / "weights.safetensors")
    (variant,) = prepare(ComparisonConfig(**settings | {"backbone": backbone})).variants
    fitted = {"epochs": 3, "patience": None, "places_per_batch": 8}
    fitted |= {"images_per_place": 3, "min_images": 3}
    assert variant.training == dataclasses.replace(recipe("tiny", "crisalad"), **fitted)


def test_a_recipe_from_a_backbone_warms_up_for_a_quarter_too(settings, shared, monkeypatch):
    def slow(model, preset):
        return TrainConfig(model=model, optimiser=OptimiserConfig(warmup_steps=30))

    monkeypatch.setitem(RECIPES, "slow", slow)
    changes = {"backbone": str(shared / "weights.safetensors"), "names": ("slow",)}
    for epochs, warmup in ((10, 2), (150, 30)):
        config = ComparisonConfig(**settings | changes | {"epochs": epochs})
        (variant,) = prepare(config).variants
        assert variant.training.optimiser.warmup_steps == warmup


REFUSED = [
    (("--methods", "crisalad,vlads"), ("--methods: found 'vlads', expected one of", "cricavpr")),
    (("--methods", "salad,salad"), ("--methods: found salad, salad", "each once")),
    (("--seeds", 0), ("seeds: found 0, expected a whole number of at least 1",)),
    (("--jobs", 0), ("--jobs: found 0, expected at least 1",)),
    (("--epochs", 0), ("epochs: found 0, expected a whole number of at least 1",)),
    (("--methods", "crisalad+transvpr"), ("found transvpr:20 over a database of 7 images",)),
    (
        ("--methods", "crisalad+patch-netvlad", "--rerank", 7, "--image-size", 28, 28),
        ("patch-netvlad: found images of 28 x 28, expected at least 42 x 42",),
    ),
    (("--grouping", "alone"), ("grouping: found 'alone', expected one of",)),
    (("--weights", "ours="), ("--weights: found 'ours=', expected NAME=FILE or the NAME of a",)),
    (("--weights", "megalok"), ("megalok: found no such file", "nearest: megaloc")),
    (
        ("--weights", "salad=w"),
        ("--weights: found 'salad=w', expected", "one of those compared, crisalad"),
    ),
    (("--image-size", 50, 50), ("found 50 x 50, expected sides that are multiples of 14",)),
    (("--train", "None"), ("--train: found none, expected a training set for crisalad, or --wei",)),
    (("--train", "none"), ("none: found no such folder",)),
    (("--test", "none"), ("none: found",)),
    (("--backbone", "none"), ("none: found no such file",)),
]


@pytest.mark.parametrize(("changed", "words"), REFUSED, ids=[str(case[0]) for case in REFUSED])
def test_refused_before_any_work(flags, capfd, tmp_path, changed, words):
    fails(capfd, *flags, "--out", tmp_path / "out", *changed, words=words)
    assert not list(tmp_path.iterdir())


def test_a_row_that_leaves_its_adapters_untrained(settings):
    given = settings | {"kind": "ablate", "rows": ("frozen: trainable=head",)}
    words = r"^--row frozen: trainable: found 'head', which leaves backbone\.blocks"
    with pytest.raises(InputError, match=words):
        prepare(ComparisonConfig(**given))


def test_weights_of_another_method(flags, shared, capfd, tmp_path):
    weights = shared / "weights.safetensors"
    fails(
        capfd,
        *flags,
        *("--out", tmp_path / "out", "--methods", "salad", "--weights", f"salad={weights}"),
        words=(weights, "of another method than salad", "adapter depthwise", "adapter none"),
    )
    assert not list(tmp_path.iterdir())


def test_an_occupied_place(flags, capfd, tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    fails(capfd, *flags, "--out", tmp_path, words=(tmp_path, "found files but no comparison"))
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_another_size_for_parameters_of_one(settings):
    """MixVPR's parameters are for the patches of the size that is asked for, not the preset's."""
    given = settings | {"names": ("crisalad+mixvpr",), "image_size": (56, 70)}
    (variant,) = prepare(ComparisonConfig(**given)).variants
    assert variant.model.image_size == (56, 70)


def test_weights_with_a_second_stage(settings, shared):
    """A line of its own: the first stage alone stands above it."""
    file = shared / "weights.safetensors"
    name = "town+sinkhorn-divergence"
    given = {"names": ("town", name), "weights": (f"town={file}", f"{name}={file}"), "rerank": 5}
    variants = prepare(ComparisonConfig(**settings | given)).variants
    assert [each.rerank for each in variants] == [None, "sinkhorn-divergence:5"]
    assert variants[0].weights == variants[1].weights == file
    given = {"names": ("x+fol",), "weights": (f"x+fol={file}",)}
    with pytest.raises(InputError, match=r"a model with aggregator salad .* expected fol and"):
        prepare(ComparisonConfig(**settings | given))
