"""Warm-ups that are long for their run: told before the first step, and shortened on demand."""

import dataclasses
import re
import warnings

import jax
import numpy as np
import pytest

from crisalad_jax.data.places import read_places
from crisalad_jax.training import loop
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.optimiser import learning_rate_schedule, with_short_warmup
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.step import StepConfig, init_train_state
from crisalad_jax.utils.notes import Note
from tests.conftest import MODEL, RECIPE, STEPS


def told(params, warmup: int, steps: int) -> list[str]:
    optimiser = OptimiserConfig(warmup_steps=warmup)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        init_train_state(params, "head", StepConfig(MODEL, RECIPE.loss, optimiser, steps))
    return [str(each.message) for each in caught if each.category is Note]


@pytest.mark.parametrize(
    ("warmup", "steps", "words"),
    [
        (30, 32, "found 30 for a run of 32 steps, which leaves 2 at .*; at most 6 would"),
        (30, 10, "found 30 for a run of 10 steps, which leaves 0 at .*; at most 2 would"),
        (7, 34, "found 7 for a run of 34 steps, which leaves 27 at .*; at most 6 would"),
        (7, 35, None),
        (30, 180, None),  # of the demo
        (0, 1, None),
    ],
)
def test_a_warm_up_of_more_than_a_fifth_is_told_in_a_line(params, warmup, steps, words) -> None:
    notes = told(params, warmup, steps)
    assert len(notes) == (words is not None)
    for note in notes:
        assert "\n" not in note
        assert re.match(f"OptimiserConfig.warmup_steps: {words}", note)


def test_it_is_told_once_and_before_the_first_step(shared, tmp_path, monkeypatch) -> None:
    config = dataclasses.replace(RECIPE, optimiser=OptimiserConfig(warmup_steps=STEPS))
    monkeypatch.setattr(loop, "_train", lambda *_: None)  # takes no step
    with pytest.warns(Note, match=f"found {STEPS} for a run of {STEPS} steps") as caught:
        loop.fit(config, read_places(shared / "city", min_images=2), tmp_path / "run", quiet=True)
    assert len([each for each in caught if each.category is Note]) == 1


def test_a_shortened_warm_up_reaches_the_learning_rate() -> None:
    given = OptimiserConfig(learning_rate=1.0, warmup_steps=30)
    short = with_short_warmup(given, 32)
    assert short == OptimiserConfig(learning_rate=1.0, warmup_steps=6)
    with jax.enable_x64(True):
        rates = [float(learning_rate_schedule(short, 32)(step)) for step in (0, 5, 6, 32)]
    np.testing.assert_allclose(rates, [1 / 6, 1, 1, 0], atol=1e-7)
    assert with_short_warmup(given, 150) == given


def test_published_recipes_keep_their_warm_up() -> None:
    assert recipe("tiny").optimiser.warmup_steps == 30
    assert recipe("b14").optimiser.warmup_steps == 0
