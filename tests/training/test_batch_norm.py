"""Batch norms in training: CricaVPR's step, statistics in the state, files and several devices."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.nn.adapters.bottleneck import MultiResolutionConfig
from crisalad_jax.nn.model import init_crisalad, tokens_and_statistics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.step import init_train_state
from crisalad_jax.training.trainable import count_trainable, merge_params, split_params
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import RECIPE, assert_equal, random_params
from tests.nn.test_model import pictures
from tests.training.programs import run_on_devices
from tests.training.test_loop import interrupt
from tests.training.test_step import STEP as WITHOUT_NORMS
from tests.training.test_step import VALID, take_step

# Of 64 the multi-resolution adapter's narrow convolutions have 4 channels.
ADAPTER = MultiResolutionConfig(bottleneck=2.0)
MODEL = dataclasses.replace(
    WITHOUT_NORMS.model,
    backbone=dataclasses.replace(WITHOUT_NORMS.model.backbone, adapter=ADAPTER),
)
STEP = dataclasses.replace(WITHOUT_NORMS, model=MODEL)
PARAMS = random_params(MODEL)
tokens_of = jax.jit(tokens_and_statistics, static_argnames=("config", "micro_batch"))


def statistics(tree) -> dict[str, np.ndarray]:
    leaves = named_leaves(tree).items()
    return {name: np.asarray(leaf) for name, leaf in leaves if ".running_" in name}


def assert_close(found, expected) -> None:
    """The same statistics, from programs that sum in other orders: some 24 numbers of order 1."""
    for name, array in statistics(expected).items():
        np.testing.assert_allclose(
            statistics(found)[name], array, rtol=2e-5, atol=1e-6, err_msg=name
        )


def stepped(config=STEP, valid=VALID):
    state, frozen = init_train_state(PARAMS, "adapters,head", config)
    state, metrics = take_step(state, frozen, valid=valid, config=config)
    return merge_params(state.trainable, frozen, config.model), metrics


def test_the_state_holds_the_statistics_and_no_moments_of_them() -> None:
    state, frozen = init_train_state(PARAMS, "adapters,head", STEP)
    assert statistics(state.trainable)
    assert not statistics(frozen)
    assert not statistics(state.optimiser)
    for trainable in ("adapters,head", "last-1-blocks,norm,head", "all"):
        chosen, _ = split_params(PARAMS, MODEL, trainable)
        assert not statistics(chosen)
        assert any(".adapter.branch1.norm.weight" in name for name in named_leaves(chosen))
    # What counts as trained are the parameters that a gradient moves.
    sizes = sum(x.size for x in jax.tree.leaves(state.trainable))
    measured = sum(x.size for x in statistics(state.trainable).values())
    assert count_trainable(MODEL, "adapters,head") == sizes - measured


@pytest.mark.slow
def test_stored_statistics_stay_and_serve_the_step() -> None:
    config = dataclasses.replace(STEP, batch_norm="stored")
    state, _ = init_train_state(PARAMS, "adapters,head", config)
    assert not statistics(state.trainable)
    params, metrics = stepped(config)
    for name, array in statistics(params).items():
        np.testing.assert_array_equal(array, statistics(PARAMS)[name])
    _, by_batch = stepped()
    assert abs(metrics.loss - by_batch.loss) > 1e-3


def test_images_that_only_pad_count_for_nothing() -> None:
    """The statistics are those of a batch without them."""
    valid = jnp.array([True, True, True, False, False, False])
    _, ours = tokens_of(PARAMS, pictures(6), valid=valid, config=MODEL)
    _, fewer = tokens_of(PARAMS, pictures(6)[:3], valid=valid[:3], config=MODEL)
    assert_close(ours, fewer)


@pytest.mark.slow
def test_a_step_that_is_not_taken_changes_no_statistic() -> None:
    params, metrics = stepped(valid=np.zeros(6, bool))
    assert not metrics.updated
    assert_equal(statistics(params), statistics(PARAMS))


def test_micro_batches_are_forward_passes_in_turn() -> None:
    """As torch's: each has its own statistics, and moves the running ones by a tenth."""
    images, valid = pictures(6), jnp.ones(6, bool)
    _, found = tokens_of(PARAMS, images, valid=valid, config=MODEL, micro_batch=3)
    # Parts are interleaved.
    _, first = tokens_of(PARAMS, images[0::2], valid=valid[:3], config=MODEL)
    _, second = tokens_of(eqx.combine(first, PARAMS), images[1::2], valid=valid[:3], config=MODEL)
    assert_close(found, second)
    _, whole = tokens_of(PARAMS, images, valid=valid, config=MODEL)
    assert any(not np.allclose(statistics(whole)[n], x) for n, x in statistics(found).items())


@pytest.mark.slow
def test_runs_keep_and_resume_the_statistics(places, tmp_path, monkeypatch) -> None:
    """The weight file holds them, and a resumed run ends with the same bits."""
    config = dataclasses.replace(
        RECIPE, model=MODEL, trainable="adapters,head", epochs=2, patience=None
    )
    whole = fit(config, places, tmp_path / "whole", quiet=True).params
    written, _ = load_weights(tmp_path / "whole" / "last.safetensors")
    assert_equal(statistics(written), statistics(whole))
    start = init_crisalad(jax.random.key(0), MODEL)
    assert any(np.abs(x - statistics(start)[n]).max() > 0 for n, x in statistics(whole).items())

    run = config, places, tmp_path / "resumed"
    interrupt(monkeypatch, "train_step", 4, *run, quiet=True)
    assert_equal(fit(*run, quiet=True).params, whole)


DEVICES = """
import jax, numpy as np
from crisalad_jax.utils.devices import devices_for
from tests.training.test_batch_norm import *
from tests.training.test_step import LABELS

devices = devices_for(6)
assert devices.mesh.size == 2
state, frozen = init_train_state(PARAMS, "adapters,head", STEP)
state, frozen = devices.replicate((state, frozen))
images, labels, valid = (devices.shard_batch(np.asarray(x)) for x in (pictures(6), LABELS, VALID))
batch = {"images": images, "labels": labels, "valid": valid}
state, metrics = take_step(state, frozen, **batch, config=STEP)
params, alone = stepped()
assert_close(merge_params(state.trainable, frozen, MODEL), params)
np.testing.assert_allclose(metrics.loss, alone.loss, rtol=1e-5)
"""


@pytest.mark.slow
def test_devices_share_the_statistics_of_the_whole_batch() -> None:
    """Two devices give the step of one, up to the order of sums."""
    run_on_devices(2, DEVICES)
