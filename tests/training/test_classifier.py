"""Training by classification: the classifiers' steps, what a step trains, and whole runs."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.checkpoints.safetensors_io import read_header
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.places import Places
from crisalad_jax.nn.config import with_aggregator
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.training.classifier import init_classifiers, load_loss, update_classifiers
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.losses import LOSSES, Loss, LossConfig, LossValue, metric_loss
from crisalad_jax.training.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.training.trainable import merge_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import MODEL, RECIPE, assert_equal, random_params
from tests.nn.test_model import pictures
from tests.training.programs import run_on_devices
from tests.training.test_loop import assert_same_run, interrupt
from tests.training.test_step import LABELS

# Eight places make two groups of four classes; two steps of three classes each pass over a group
# more than once. Four epochs train the groups in turn.
CONFIG = dataclasses.replace(
    RECIPE,
    model=dataclasses.replace(
        MODEL,
        aggregator="class-token",
        cross_image="none",
    ),
    loss=LossConfig(kind=LargeMarginCosineConfig(classes=ClassesConfig(groups=2, steps=2))),
    epochs=4,
    validate_every=2,
    patience=None,
)
STEPS = 8
CLASSES = (4, 3)
STEP = StepConfig(CONFIG.model, CONFIG.loss, CONFIG.optimiser, STEPS, 2, classes=CLASSES)
VALID = np.array([True] * 5 + [False])


@pytest.fixture(scope="module")
def finished(shared: pathlib.Path, places: Places, benchmark: Benchmark) -> pathlib.Path:
    out = shared / "classified"
    fit(CONFIG, places, out, validation=benchmark, quiet=True)
    return out


def test_each_classifier_steps_as_an_adam_of_its_own():
    """Torch's Adams, one a group, of which one rests while the other steps."""
    generator = np.random.default_rng(0)
    loss = LargeMarginCosineConfig(learning_rate=0.01)
    ours = init_classifiers(jax.random.key(0), loss, CLASSES, 6)
    theirs = [torch.nn.Parameter(torch.tensor(np.array(w))) for w in ours.weights]
    optimisers = [torch.optim.Adam([weights], lr=0.01) for weights in theirs]
    step = jax.jit(update_classifiers, static_argnames="learning_rate")
    for group in (0, 0, 1, 0, 1):
        gradient = generator.standard_normal((4, 6)).astype(np.float32)
        ours = step(ours, jnp.asarray(group), jnp.asarray(gradient), learning_rate=0.01)
        theirs[group].grad = torch.tensor(gradient)
        optimisers[group].step()
    # 1 - 0.999 in float32 has a relative error of 6e-5, half of which is in each of five steps.
    for found, expected in zip(ours.weights, theirs, strict=True):
        np.testing.assert_allclose(found, expected.detach(), rtol=0, atol=1e-6)


def test_classifiers_start_as_glorots():
    loss, counts = LargeMarginCosineConfig(), (300, 40)
    weights = np.asarray(init_classifiers(jax.random.key(3), loss, counts, 64).weights)
    assert weights.shape == (2, 300, 64)
    bounds = [np.sqrt(6 / (classes + 64)) for classes in counts]
    for group, (classes, bound) in enumerate(zip(counts, bounds, strict=True)):
        drawn = weights[group, :classes]
        assert 0.99 * bound < np.abs(drawn).max() <= bound
        # Of a uniform law; 2,560 numbers tell its deviation to a percent.
        assert drawn.std() == pytest.approx(bound / np.sqrt(3), rel=0.02)
        np.testing.assert_array_equal(weights[group, classes:], 0)
    # Drawn apart, and not the same numbers on two scales.
    first, second = (weights[group, :40] / bounds[group] for group in (0, 1))
    assert np.abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.1


def test_a_step_trains_the_model_and_the_classifier_of_its_epochs_group():
    """Steps 0 and 1 are of the first group, 2 and 3 of the second, 4 of the first again."""
    start = random_params(CONFIG.model)
    state, frozen = init_train_state(start, "all", STEP, key=jax.random.key(1))
    images = pictures(6)
    for step, group in enumerate((0, 0, 1, 1, 0)):
        before = jax.tree.map(np.array, state)
        assert before.classifiers is not None
        state, metrics = train_step(state, frozen, images, LABELS, VALID, jax.random.key(0), STEP)
        descriptors = describe(
            merge_params(before.trainable, frozen, CONFIG.model), images, CONFIG.model
        )
        weights = jnp.asarray(before.classifiers.weights[group, : CLASSES[group]])
        expected = metric_loss(descriptors[:5], LABELS[:5], CONFIG.loss, params=weights)
        # float32 cosines times 30, of one program and of two.
        np.testing.assert_allclose(metrics.loss, expected.loss, rtol=1e-4)
        np.testing.assert_allclose(metrics.accuracy, expected.accuracy, rtol=1e-6)
        assert int(metrics.images) == 5
        after = state.classifiers
        assert after is not None
        changed = ~np.isclose(after.weights, before.classifiers.weights, rtol=0, atol=0).all(axis=2)
        assert changed[group, : CLASSES[group]].all()
        assert not changed[group, CLASSES[group] :].any()
        assert not changed[1 - group].any()
        assert after.optimiser[0].count.tolist() == [[1, 0], [2, 0], [2, 1], [2, 2], [3, 2]][step]
    for name, leaf in named_leaves(state.trainable).items():
        assert leaf.size == 0 or not np.array_equal(leaf, named_leaves(start)[name]), name


def test_a_run_logs_validates_and_keeps_classifiers_out_of_its_weights(
    finished: pathlib.Path,
):
    lines = read_metrics(finished / "metrics.jsonl")
    steps = [line for line in lines if "loss" in line]
    assert [line["epoch"] for line in steps] == [1, 1, 2, 2, 3, 3, 4, 4]
    assert all(0 <= line["accuracy"] <= 1 and line["gradient_norm"] > 0 for line in steps)
    assert [line["epoch"] for line in lines if "R@5" in line] == [2, 4]
    params, config = load_weights(finished / "last.safetensors")
    assert config == CONFIG.model
    assert named_leaves(params).keys() == named_leaves(random_params(config)).keys()
    with pytest.raises(InputError, match=r"last.safetensors: found no parameters of a loss, expec"):
        load_loss(finished / "last.safetensors")


@dataclasses.dataclass(frozen=True)
class Scaled(Loss):
    """Pulls by a learnt scale, which it reports."""

    def init(self, key, classes, dim):
        return {"scale": jnp.full((), 2.0), "width": jnp.full(dim, 1.0)}

    def apply(self, params, batch):
        pull = jax.nn.softplus(params["scale"] * (0.5 - batch.similarities)) * params["width"][0]
        loss = jnp.where(batch.pairs.positives, pull, 0).sum() / batch.anchors
        return LossValue(loss, numbers={"scale": params["scale"]})


@pytest.mark.slow
@pytest.mark.usefixtures("own_parts")
def test_weight_files_have_what_a_loss_learnt(tmp_path, places, benchmark):
    """A step logs the scale that it begins with, so the first after a save logs the saved one."""
    out = tmp_path / "run"
    LOSSES.register("scaled")(Scaled)
    config = dataclasses.replace(
        CONFIG, loss=LossConfig(kind="scaled", miner="none"), epochs=1, validate_every=1
    )
    end = fit(config, places, out, validation=benchmark, quiet=True).steps
    found = {name: load_loss(out / f"{name}.safetensors") for name in ("last", "best")}
    assert found["last"][0] == config.loss
    assert found["last"][1]["width"].shape == (config.model.descriptor_dim,)
    for each in jax.tree.leaves(found["last"][1]):
        assert each.dtype == jnp.float32
    assert_equal(found["best"][1], found["last"][1])  # of the same step
    scale = float(found["last"][1]["scale"])
    fit(dataclasses.replace(config, epochs=2), places, out, validation=benchmark, quiet=True)
    lines = read_metrics(out / "metrics.jsonl")
    logged = {line["step"]: line["loss.scale"] for line in lines if "loss" in line}
    assert logged[1] == 2.0
    assert logged[end + 1] == scale != 2.0


@pytest.mark.usefixtures("own_parts")
def test_a_model_does_not_depend_on_the_loss_in_its_file(tmp_path):
    params, config = random_params(CONFIG.model), CONFIG.model
    LOSSES.register("scaled")(Scaled)
    loss = LossConfig(kind=Scaled()), Scaled().init(None, 0, config.descriptor_dim)
    for name, learnt in (("with", loss), ("without", None)):
        save_weights(tmp_path / name, Model(params, config), loss=learnt)
    headers = [read_header(tmp_path / name) for name in ("with", "without")]
    assert headers[0].pop("loss") == to_plain(loss[0])
    assert headers[0] == headers[1]
    LOSSES._parts.pop("scaled")  # the model needs no loss
    assert_equal(load_weights(tmp_path / "with").params, params)
    with pytest.raises(
        InputError, match=r"with \(metadata\): loss: found 'scaled', expected one of"
    ):
        load_loss(tmp_path / "with")
    wrong = {"scale": loss[1]["scale"]}
    LOSSES.register("scaled")(Scaled)
    save_weights(tmp_path / "wrong", Model(params, config), loss=(loss[0], wrong))
    with pytest.raises(InputError, match=r"wrong: loss scaled: weights do not fit: width missing"):
        load_loss(tmp_path / "wrong")


@pytest.mark.parametrize("call", [4, 6])
def test_an_interrupted_run_goes_on_with_the_same_bits(
    tmp_path, places, benchmark, finished, monkeypatch, call
):
    """Within an epoch of the second group, and of the first when it trains once more."""
    run = CONFIG, places, tmp_path / "run"
    interrupt(monkeypatch, "train_step", call, *run, validation=benchmark, quiet=True)
    assert fit(*run, validation=benchmark, quiet=True).steps == STEPS
    assert_same_run(tmp_path / "run", finished)


def test_classes_that_cannot_be_made_are_told_before_any_file_is_written(tmp_path, places):
    loss = LargeMarginCosineConfig(classes=ClassesConfig(groups=3, steps=2))
    config = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, kind=loss))
    with pytest.raises(InputError, match=r"city: found 2 classes of .* in the smallest of 3 group"):
        fit(config, places, tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


DEVICES = """
import pathlib, sys
from unittest import mock
import jax
from crisalad_jax.training import loop as module
from crisalad_jax.data.places import read_places
from crisalad_jax.utils import devices as spreading
from tests.training.test_classifier import SPREAD

shared, out = map(pathlib.Path, sys.argv[1:3])
places, devices = read_places(shared / "city", min_images=2), jax.devices()
for count in (1, 3):
    with mock.patch.object(jax, "local_devices", lambda **_: devices[:count]):
        module.fit(SPREAD, places, out / str(count), quiet=True)
spreading.SHARD_FROM = 64
module.fit(SPREAD, places, out / "split", quiet=True, shard_state=True)
"""
SPREAD = dataclasses.replace(
    CONFIG,
    model=with_aggregator(CONFIG.model, "gem-pyramid", "tiny"),
    trainable="adapters,head",
)


@pytest.mark.slow
def test_devices_do_not_change_a_run(shared: pathlib.Path, tmp_path: pathlib.Path):
    run_on_devices(3, DEVICES, shared, tmp_path)
    one, *others = (
        [line["loss"] for line in read_metrics(tmp_path / name / "metrics.jsonl")]
        for name in ("1", "3", "split")
    )
    assert len(one) == STEPS
    for other in others:
        # float32 sums in other orders, 30 times as large in the exponent.
        np.testing.assert_allclose(other, one, rtol=1e-5)
