"""A run that is given more epochs: the bits of the longer run where the learning rate allows."""

import dataclasses
import json
import pathlib
import shutil

import pytest

from crisalad_jax.config.io import read_config
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.schedules import LinearSchedule
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import RECIPE
from tests.training.test_loop import Interrupted, assert_same_run, fail_at

# Three epochs of two steps, whose learning rate falls in four steps and then stays.
LONG = dataclasses.replace(
    RECIPE,
    optimiser=OptimiserConfig(learning_rate=1e-3, schedule=LinearSchedule(0.2, decay_steps=4)),
    patience=None,
)


@pytest.mark.slow
def test_a_run_in_two_parts_has_the_bits_of_one_at_once(
    places, params, benchmark, tmp_path: pathlib.Path, monkeypatch, recwarn
):
    given = {"validation": benchmark, "initial": params, "quiet": True}
    fit(LONG, places, tmp_path / "whole", **given)
    out = tmp_path / "extended"
    fit(dataclasses.replace(LONG, epochs=1), places, out, **given)
    # Killed at its second step, which is after the longer configuration is written.
    with monkeypatch.context() as patch:
        fail_at(patch, "train_step", 2)
        with pytest.raises(Interrupted):
            fit(LONG, places, out, **given)
    assert fit(LONG, places, out, **given).steps == 6
    assert_same_run(out, tmp_path / "whole")
    assert read_config(TrainConfig, out / "config.json") == LONG
    history = json.loads((out / "epochs.json").read_text())["before"]
    assert history == [{"epochs": 1, "step": 2}]
    assert not [each for each in recwarn if issubclass(each.category, Note)]


@pytest.fixture
def copied(run, tmp_path):
    """A finished run of three epochs, two steps each, whose learning rate falls over all six."""
    return pathlib.Path(shutil.copytree(run, tmp_path / "run"))


def test_a_learning_rate_over_the_whole_run_jumps_and_a_note_says_so(
    places, params, benchmark, copied, monkeypatch
):
    longer = dataclasses.replace(RECIPE, patience=None, epochs=4)
    fail_at(monkeypatch, "train_step", 1)  # nothing of it is compiled
    note = "jumps at step 6, unlike in a run of 4 epochs from the start"
    with pytest.warns(Note, match=note), pytest.raises(Interrupted):
        fit(longer, places, copied, validation=benchmark, initial=params, quiet=True)
    assert read_config(TrainConfig, copied / "config.json") == longer
    history = json.loads((copied / "epochs.json").read_text())["before"]
    assert history == [{"epochs": 3, "step": 6}]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"epochs": 2}, "epochs: found 2, expected 3; "),
        ({"epochs": 4, "seed": 6}, "seed: found 6, expected 5; "),
    ],
)
def test_fewer_epochs_or_another_difference_are_refused(places, params, copied, change, words):
    before = (copied / "config.json").read_bytes()
    config = dataclasses.replace(RECIPE, patience=None, **change)
    with pytest.raises(InputError, match=f"holds a run of another configuration: {words}"):
        fit(config, places, copied, initial=params, quiet=True)
    assert (copied / "config.json").read_bytes() == before


def test_other_weights_leave_the_configuration_as_it_was(places, copied):
    before = (copied / "config.json").read_bytes()
    longer = dataclasses.replace(RECIPE, patience=None, epochs=4)
    with pytest.raises(InputError, match="the run started from other"):
        fit(longer, places, copied, quiet=True)
    assert (copied / "config.json").read_bytes() == before
    assert not (copied / "epochs.json").exists()
