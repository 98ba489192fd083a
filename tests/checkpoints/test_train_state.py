"""States to resume from: there and back bit for bit, damaged ones, and those of another model."""

import os
import re

import jax
import jax.numpy as jnp
import pytest

from crisalad_jax.checkpoints.train_state import StateStore
from crisalad_jax.training.step import StepConfig, init_train_state
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, RECIPE, assert_equal


@pytest.fixture
def state(params):
    step = StepConfig(MODEL, RECIPE.loss, RECIPE.optimiser, 6)
    return init_train_state(params, "adapters,head", step)[0]


def test_a_state_survives_bit_for_bit_and_the_last_ones_stay(tmp_path, state):
    store = StateStore(tmp_path / "state", keep=2)
    assert store.load(state) is None
    for step in (1, 2, 5):
        moved = jax.tree.map(lambda leaf, step=step: leaf + step, state)
        store.save(step, moved, {"best": 0.1 * step})
    moved = jax.tree.map(lambda leaf: leaf + 6, state)
    store.save(5, moved, {"best": 9.0})  # in place of the other
    store.close()
    assert sorted(os.listdir(tmp_path / "state")) == ["2", "5"]
    again = StateStore(tmp_path / "state")
    saved = again.load(state)
    again.close()
    assert saved is not None
    assert (saved.step, saved.record) == (5, {"best": 9.0})
    assert_equal(saved.state, moved)


def test_a_state_of_another_model_is_refused(tmp_path, state):
    store = StateStore(tmp_path / "state")
    store.save(1, state, {})
    leaves, structure = jax.tree.flatten(state)
    largest = max(range(len(leaves)), key=lambda i: leaves[i].size)
    shape = leaves[largest].shape
    leaves[largest] = jnp.zeros((*shape, 2))
    words = re.escape(f"found float32 {shape}, expected float32 {(*shape, 2)}")
    here = f"^{tmp_path}/state/1: this state is damaged or not of this run .*{words}"
    with pytest.raises(InputError, match=here):
        store.load(jax.tree.unflatten(structure, leaves))
    store.close()


def cut_short(data: bytes) -> bytes:
    return data[:100]


def with_one_bit_turned(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


@pytest.mark.parametrize("damage", [cut_short, with_one_bit_turned])
@pytest.mark.parametrize("part", ["state", "record"])
def test_a_damaged_state_is_refused_and_the_older_one_named(tmp_path, state, capfd, part, damage):
    """In one line: what reads the arrays, all at once, must not come to the damaged one."""
    store = StateStore(tmp_path / "state")
    store.save(1, state, {"best": list(range(100))})
    store.save(2, state, {"best": list(range(100))})
    store.wait()
    files = [file for file in (tmp_path / "state" / "2" / part).rglob("*") if file.is_file()]
    largest = max(files, key=lambda file: file.stat().st_size)
    largest.write_bytes(damage(largest.read_bytes()))
    file = re.escape(f"{largest.relative_to(tmp_path / 'state' / '2')}")
    refused = f"^{tmp_path}/state/2: this state is damaged .*; delete it to resume from step 1 .*"
    with pytest.raises(InputError, match=f"{refused}{file}: found other bytes than were saved"):
        store.load(state)
    largest.unlink()
    with pytest.raises(InputError, match=f"{refused}{file}: found no file"):
        store.load(state)
    store.close()
    assert capfd.readouterr().err == ""
