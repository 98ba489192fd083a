"""Several training sets in one batch: what is drawn from each, their losses, and a whole run."""

import dataclasses
import functools
import itertools
import math
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pyproj
import pytest

from crisalad_jax.cli.train import parse
from crisalad_jax.config.flags import refusals
from crisalad_jax.config.io import differences, from_plain, read_config, to_plain
from crisalad_jax.config.plugins import sources_of
from crisalad_jax.config.registry import make_part
from crisalad_jax.data.loader import training_batches
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.samplers.base import epoch_batches
from crisalad_jax.experiments.comparison.methods import is_method, method_of
from crisalad_jax.experiments.train import train
from crisalad_jax.nn.model import Crisalad, describe, init_crisalad, parameter_shapes
from crisalad_jax.training.batches import PlaceBatches
from crisalad_jax.training.config import MixtureSet, TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.losses import LossConfig, metric_loss
from crisalad_jax.training.losses.base import LOSSES, Loss, LossValue
from crisalad_jax.training.mixture import with_sets
from crisalad_jax.training.recipes import from_scratch, recipe
from crisalad_jax.training.step import init_train_state, loss_and_gradient, step_config
from crisalad_jax.training.trainer import run_keys
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import MODEL, RECIPE, random_params, write_picture
from tests.training.test_loop import assert_same_params, interrupt, metrics_of

SMALL = dataclasses.replace(
    MODEL,
    backbone=dataclasses.replace(MODEL.backbone, depth=1),
    cross_image=dataclasses.replace(MODEL.cross_image, layers=1),
)
TRIPLETS = LossConfig(kind=make_part("loss", "triplet", margin=1.0), miner="none")
MIXED = dataclasses.replace(
    RECIPE,
    model=SMALL,
    loss=LossConfig(),
    mixture=(
        MixtureSet("near", loss=RECIPE.loss, share=2),
        MixtureSet("far", sampler="hard-negatives", loss=TRIPLETS, weight=0.25),
    ),
    places_per_batch=6,
    epochs=2,
    patience=None,
)


@pytest.fixture(scope="module")
def sets(shared: pathlib.Path) -> dict[str, Places]:
    """Both cities, and one of them."""
    whole = read_places(shared / "city", min_images=2)
    return {"near": whole, "far": read_places(shared / "city", cities=("Brill",), min_images=2)}


@pytest.fixture(scope="module")
def start() -> Crisalad:
    return random_params(SMALL)


def without_descriptions(config: TrainConfig) -> TrainConfig:
    near, far = config.mixture
    return dataclasses.replace(config, mixture=(near, dataclasses.replace(far, sampler="shuffled")))


def paths_of(batch: Any, sets: dict[str, Places]) -> list[pathlib.Path]:
    """Image files, by the numbers that go on from the first set to the second."""
    count = len(sets["near"].files)
    return [
        sets["near"].path(image) if image < count else sets["far"].path(image - count)
        for image in batch.indices
    ]


def test_a_batch_has_the_sub_batch_that_each_set_draws(sets: dict[str, Places]):
    config = without_descriptions(MIXED)
    data = PlaceBatches(config, sets, threads=0)
    # Eight places in sub-batches of four; the other set goes on with new draws after two.
    assert data.steps_per_epoch == 2
    near, far = config.alone
    assert (near.places_per_batch, far.places_per_batch) == (4, 2)
    for epoch in (0, 1):
        expected = [
            epoch_batches(
                sets[name],
                sampler=run.sampler,
                places_per_batch=run.places_per_batch,
                images_per_place=2,
                seed=run.seed,
                epoch=epoch,
                steps=2,
            )
            for name, run in zip(("near", "far"), (near, far), strict=True)
        ]
        for step, batch in enumerate(data.batches(2 * epoch)):
            parts = {name: each[step].ravel() for name, each in zip(sets, expected, strict=True)}
            files = [sets[name].path(image) for name, images in parts.items() for image in images]
            assert paths_of(batch, sets) == files
            assert batch.images.shape == (12, 42, 56, 3)
            places = [sets[name].image_place[images] for name, images in parts.items()]
            assert batch.labels.tolist() == np.concatenate(places).tolist()
    # A process's part, as the loader gives it: all of them in order are the batch.
    halves = [next(PlaceBatches(config, sets, part=(i, 2), threads=0).batches(1)) for i in (0, 1)]
    whole = next(iter(PlaceBatches(config, sets, threads=0).batches(1)))
    np.testing.assert_array_equal(np.concatenate([half.images for half in halves]), whole.images)


def test_sets_of_the_same_places_draw_other_batches(sets: dict[str, Places]):
    config = with_sets(RECIPE, ["a", "b"])
    data = PlaceBatches(config, {"a": sets["near"], "b": sets["near"]}, threads=0)
    first, second = np.split(next(data.batches(0)).indices, 2)
    assert set(first.tolist()) != {each - len(sets["near"].files) for each in second.tolist()}


def test_one_set_alone_is_drawn_as_by_the_loader(sets: dict[str, Places]):
    """Whose own batches do not know of mixtures; a mixture of one set draws the same."""
    expected = training_batches(
        sets["near"],
        image_size=MODEL.input_size,
        places_per_batch=3,
        images_per_place=2,
        sampler="within-city",
        augmentation="light",
        seed=5,
        epoch=1,
        preprocessing=MODEL.preprocessing,
        steps=2,
        threads=0,
    )
    one = with_sets(RECIPE, ["near"])
    assert one.alone == RECIPE.alone == (RECIPE,)
    found = [
        PlaceBatches(config, places, threads=0).batches(2)
        for config, places in ((RECIPE, sets["near"]), (one, {"near": sets["near"]}))
    ]
    for batch, *others in zip(expected, *found, strict=True):
        for other in others:
            for name, values in batch._asdict().items():
                np.testing.assert_array_equal(getattr(other, name), values, err_msg=name)


def test_a_step_adds_the_weighted_losses_of_sub_batches_by_themselves(start):
    """By the model's own description of each sub-batch, which no image of the other is in."""
    static = step_config(MIXED, steps=1, optimiser=optax.identity())
    state, frozen = init_train_state(start, "head,-adapters", static)
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (12, 42, 56, 3), np.uint8))
    # Places of the two sets have the same numbers.
    labels = jnp.array([0, 0, 1, 1, 2, 2, 3, 3, 0, 0, 1, 1])
    valid = jnp.ones(12, bool).at[jnp.array([3, 11])].set(False)

    step = jax.jit(functools.partial(loss_and_gradient, key=None, config=static))
    batch, _ = step(state, frozen, images, labels, valid)
    losses = []
    for each, where in zip(MIXED.mixture, (slice(8), slice(8, 12)), strict=True):
        mask = valid[where] & valid[where][:, None]
        rows = describe(start, images[where], SMALL, mask=mask)
        losses.append(metric_loss(rows, labels[where], each.loss, valid=valid[where]))
        # In float32, of products in another order.
        np.testing.assert_allclose(batch.result.numbers[each.name], losses[-1].loss, rtol=1e-5)
    near, far = losses
    assert near.loss > 0.01 < far.loss
    np.testing.assert_allclose(batch.result.loss, near.loss + far.loss / 4, rtol=1e-5)
    easy = (7 * near.easy_anchor_fraction + 3 * far.easy_anchor_fraction) / 10
    np.testing.assert_allclose(batch.result.easy_anchor_fraction, easy, rtol=1e-6)


@pytest.mark.usefixtures("own_parts")
def test_a_loss_with_parameters_is_of_one_set_alone(start: Crisalad):
    @LOSSES.register("scaled")
    @dataclasses.dataclass(frozen=True)
    class Scaled(Loss):
        def init(self, key, classes, dim):
            return jnp.ones(())

        def apply(self, params, batch):
            return LossValue(params * batch.similarities.mean())

    config = with_sets(dataclasses.replace(RECIPE, model=SMALL), ["near", "far"])
    config = config.with_each(loss=lambda loss: dataclasses.replace(loss, kind=Scaled()))
    static = step_config(config, steps=1)
    with pytest.raises(InputError, match=r"mixture\.near\.loss: found scaled, which has"):
        init_train_state(start, "all", static, key=jax.random.key(0))


@pytest.mark.slow  # the recipe of SAGE below does the same in a quick test, without weights
def test_a_killed_run_of_a_mixture_resumes_to_the_same_bits(
    sets: dict[str, Places], start: Crisalad, tmp_path: pathlib.Path, monkeypatch
):
    """One of the sets draws by descriptors, which its state has to keep."""
    options: Any = {"initial": start, "quiet": True}
    whole = fit(MIXED, sets, tmp_path / "whole", **options)
    assert whole.steps == 4
    assert read_config(TrainConfig, tmp_path / "whole" / "config.json") == MIXED
    lines = [line for line in read_metrics(tmp_path / "whole" / "metrics.jsonl") if "loss" in line]
    for line in lines:  # the logged sum, in float32
        assert line["loss"] == pytest.approx(line["loss.near"] + line["loss.far"] / 4, rel=1e-6)
    assert any(line["loss.far"] > 0 for line in lines)
    interrupt(monkeypatch, "train_step", 4, MIXED, sets, tmp_path / "killed", **options)
    resumed = fit(MIXED, sets, tmp_path / "killed", **options)
    assert metrics_of(tmp_path / "killed") == metrics_of(tmp_path / "whole")
    assert_same_params(resumed.params, whole.params)
    other = {"near": sets["near"], "far": sets["near"]}
    with pytest.raises(InputError, match="the run started from other places"):
        fit(MIXED, other, tmp_path / "whole", **options)


def test_flags_of_each_set_are_flags_of_the_command(tmp_path: pathlib.Path):
    arguments = (
        "--data gsv=G msls=M --out O --preset tiny --recipe salad --mixture.msls.sampler cliques "
        "--mixture.msls.sampler.radius 30 --mixture.gsv.loss.kind triplet --mixture.msls.share 2"
    )
    found = parse("crisalad train", arguments.split()).settings
    gsv, msls = found.mixture
    assert (gsv.name, gsv.loss.kind.part_name, gsv.sampler.part_name) == (
        *("gsv", "triplet"),
        "within-city",
    )
    assert (msls.name, msls.sampler.radius, msls.share, msls.weight) == ("msls", 30.0, 2, 1.0)
    assert found.places_per_batch == 60
    assert [run.places_per_batch for run in found.alone] == [20, 40]
    assert from_plain(TrainConfig, to_plain(found), source="here") == found
    assert sources_of(found)["mixture.1.sampler"][0] == "cliques"
    other = dataclasses.replace(found, mixture=(gsv, dataclasses.replace(msls, weight=0.5)))
    assert differences(other, found) == ["mixture.msls.weight: found 0.5, expected 1.0"]
    # Of a recipe's mixture the sets that there are, in sub-batches of the same size.
    words = "--data megascenes=A gsv=B --out O --preset tiny --recipe megaloc"
    found = parse("crisalad train", words.split()).settings
    assert [each.name for each in found.mixture] == ["gsv", "megascenes"]
    assert found.places_per_batch == 64


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--data a b", "--data: found a b, expected one set, or NAME=DIR of each, each name once"),
        ("--data a=b a=c", "--data: found a=b a=c, expected one set, or NAME=DIR of each"),
        ("--data", "--data: found none, expected one set"),
        ("--data a=b --data c=d", "--data: found twice, expected all sets after one"),
        ("--data a=b c=d --sampler shuffled", r"TrainConfig.sampler: found Shuffled\(\), expected"),
        ("--data a=b c=d --loss.kind triplet", r"TrainConfig.loss: found .*mixture.a.loss"),
        ("--data a=b c=d --recipe netvlad", "MiningConfig.kind: found 'whole', expected 'none'"),
        ("--data a=b c=d --recipe cosplace-vit", "mixture.a: .* a loss of pairs of descriptors"),
        ("--data a=b c=d --mixture.c.share 4", "places_per_batch: found 48, expected a multiple"),
        (
            "--data a=b c=d --mixture.c.weight 0",
            "MixtureSet.weight: found 0.0, expected a finite number above 0",
        ),
        ("--data a=b c=d --mixture.e.weight 1", "--mixture.e.weight: found no such flag"),
    ],
)
def test_what_does_not_fit_a_mixture_is_refused(arguments: str, message: str):
    given = [*arguments.split(), "--out", "O", "--preset", "tiny"]
    with pytest.raises(InputError, match=message), refusals(given):
        parse("crisalad train", given)


def test_sets_are_given_by_their_names(shared: pathlib.Path, tmp_path: pathlib.Path):
    with pytest.raises(InputError, match="--data: found one set without a name, expected all of"):
        train(MIXED, shared / "city", tmp_path / "run")
    with pytest.raises(InputError, match="--data: found near, expected all of near, far"):
        train(MIXED, {"near": shared / "city"}, tmp_path / "run")
    with pytest.raises(InputError, match="--data: found near, expected one set without a name"):
        train(RECIPE, {"near": shared / "city"}, tmp_path / "run")
    both = dict.fromkeys(("near", "far"), shared / "city")
    with pytest.raises(InputError, match="--place-radius: found for a recipe that mixes"):
        train(MIXED, both, tmp_path / "run", place_radius=5.0)
    assert not (tmp_path / "run").exists()


def test_a_set_without_a_batch_is_refused_before_the_run(
    sets: dict[str, Places], start: Crisalad, tmp_path: pathlib.Path
):
    mixture = tuple(MixtureSet(name, sampler="shuffled") for name in ("near", "far"))
    config = dataclasses.replace(MIXED, mixture=mixture, places_per_batch=12)
    with pytest.raises(InputError, match="found 4 places of which sampler shuffled makes no batch"):
        fit(config, {"near": sets["near"], "far": sets["far"]}, tmp_path / "run", initial=start)
    assert not (tmp_path / "run").exists()


def write_streets(root: pathlib.Path) -> pathlib.Path:
    """Six places 45 m apart, in squares of 15 m: four images look across the street, four along."""
    degrees = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326")
    lines = ["name,place,lat,lon,heading"]
    for place, image in itertools.product(range(6), range(8)):
        file = f"{place}_{image}.jpg"
        write_picture(root / file, 900 + place, noise=5.0 * (1 + image))
        east, north = 450_007.5 + 45 * place + image - 3.5, 5_000_007.5
        latitude, longitude = degrees.transform(east, north)
        lines.append(f"{file},{place},{latitude:.8f},{longitude:.8f},{90 * (image % 2)}")
    (root / "places.csv").write_text("\n".join(lines))
    return root


@pytest.mark.parametrize(
    ("name", "places", "size", "moved"),
    [
        pytest.param(
            *("sage", 4, (28, 42), {"aggregator", "backbone.blocks.adapter"}),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("salad-cm", 4, (70, 70), {"aggregator", "backbone.norm"}), marks=pytest.mark.slow
        ),
        pytest.param(
            *("megaloc", 12, (70, 70), {"aggregator", "projection"}), marks=pytest.mark.slow
        ),
    ],
)
def test_a_published_mixture_trains_and_resumes(
    name: str,
    places: int,
    size: tuple[int, int],
    moved: set[str],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """By the command's own function, on one set in the place of all; two steps of `tiny`."""
    published = recipe("tiny", name)
    config = dataclasses.replace(
        published,
        model=dataclasses.replace(published.model, image_size=size),
        optimiser=dataclasses.replace(published.optimiser, learning_rate=1e-3),
        places_per_batch=places,
        images_per_place=2,
        min_images=2,
        epochs=1,
    )
    names = [each.name for each in config.mixture]
    data = dict.fromkeys(names, write_streets(tmp_path / "streets"))
    result = train(config, data, tmp_path / "run", quiet=True)
    # Sub-batches of two places, of which the first set has six.
    assert result.steps == 3
    line = read_metrics(tmp_path / "run" / "metrics.jsonl")[0]
    assert line["loss"] == pytest.approx(sum(line[f"loss.{each}"] for each in names), rel=1e-6)
    before = named_leaves(init_crisalad(run_keys(config.seed)[0], config.model))
    after = named_leaves(result.params)
    changed = {leaf for leaf in after if not np.array_equal(before[leaf], after[leaf])}
    for part in moved:
        assert any(leaf.startswith(part) for leaf in changed), part
    if name == "sage":  # whose backbone is frozen
        assert not any("backbone" in leaf and "adapter" not in leaf for leaf in changed)
    about = read_json(tmp_path / "run" / "data.json", "what it was trained on")["training"]
    assert (about["places"], about["images"]) == (6 * len(names), 48 * len(names))
    sets = {each: read_places(root, min_images=1) for each, root in data.items()}
    interrupt(monkeypatch, "train_step", 3, config, sets, tmp_path / "killed", quiet=True)
    resumed = fit(config, sets, tmp_path / "killed", quiet=True)
    assert metrics_of(tmp_path / "killed") == metrics_of(tmp_path / "run")
    assert_same_params(resumed.params, result.params)


def test_recipes_have_their_papers_numbers():
    """SALAD-CM's of its authors' code; MegaLoc's sub-batches and both models of their papers."""
    for name in ("salad-cm", "sage"):
        config = recipe("b14", name)
        assert [run.places_per_batch for run in config.alone] == [30, 30]
        assert (config.images_per_place, config.epochs) == (4, 4)
        assert config.optimiser.learning_rate == 6e-5
        assert config.optimiser.weight_decay == 9.5e-9
        assert config.optimiser.schedule == make_part(
            "schedule", "linear", end_fraction=0.2, decay_steps=4000
        )
        assert (config.model.image_size, config.model.descriptor_dim) == ((224, 224), 8448)
    backbone: Any = recipe("b14", "sage").model.backbone
    assert backbone.adapter.part_name == "dynamic-power"
    config = recipe("b14", "megaloc")
    assert [run.places_per_batch for run in config.alone] == [32] * 6
    # Of the published file: 64 clusters of 256 numbers and a token of 256, through a linear layer.
    assert config.model.unprojected_dim == 16640
    assert config.model.descriptor_dim == 8448
    shapes = named_leaves(parameter_shapes(config.model))
    assert sum(math.prod(leaf.shape) for leaf in shapes.values()) == 228_639_553


def test_a_recipe_of_several_sets_is_no_method_of_a_comparison():
    assert not is_method("megaloc")
    with pytest.raises(InputError, match="--methods: found salad-cm, which trains on several sets"):
        method_of("salad-cm", "tiny")
    shuffled = recipe("tiny", "salad-cm+shuffled")
    assert {each.sampler.part_name for each in shuffled.mixture} == {"shuffled"}
    scratch = from_scratch(recipe("tiny", "salad-cm+triplet"))
    assert [each.loss.kind.part_name for each in scratch.mixture] == ["triplet", "triplet"]
    assert [each.sampler.part_name for each in scratch.mixture] == ["within-city", "cliques"]
