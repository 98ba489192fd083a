"""Warm-ups that are long for their run: told before the first step, and shortened on demand."""

import dataclasses
import re
import warnings

import jax
import numpy as np
import pytest
import torch

from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.optimiser import (
    count_steps,
    learning_rate_schedule,
    with_short_warmup,
)
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.schedules import CosineSchedule, LinearSchedule, MilestonesSchedule
from crisalad_jax.training.step import StepConfig, init_train_state
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from crisalad_jax.utils.pytree import check_drawn, named_leaves
from tests.conftest import MODEL, RECIPE, STEPS
from tests.training.test_loop import Interrupted, fail_at


def told(params, optimiser: OptimiserConfig, steps: int, steps_per_epoch: int) -> list[str]:
    config = StepConfig(MODEL, RECIPE.loss, optimiser, steps, steps_per_epoch=steps_per_epoch)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        init_train_state(params, "head,-adapters", config)
    return [str(each.message) for each in caught if each.category is Note]


BOQ = recipe("b14", "boq").optimiser
"""It warms up for 10 of its 40 epochs."""


SHARED = OptimiserConfig(warmup_epochs=10, accumulate=4)
"""Twenty epochs of 7 batches are 40 of its steps, and 10 epochs of them 20."""


@pytest.mark.parametrize(
    ("config", "steps", "per_epoch", "words", "short"),
    [
        (OptimiserConfig(warmup_steps=30), 32, 1, "steps: found 30 steps for a run of 32, .* 2", 8),
        (OptimiserConfig(warmup_steps=30), 3, 1, "steps: found 30 steps for a run of 3, .* 0", 0),
        (OptimiserConfig(warmup_steps=9), 36, 1, None, None),
        (OptimiserConfig(), 1, 1, None, None),
        (BOQ, 5 * 7, 7, "epochs: found 70 steps for a run of 35, which leaves 0 after", 8),
        (BOQ, 40 * 7, 7, None, None),
        (SHARED, 20 * 7, 7, "epochs: found 20 steps for a run of 40, which leaves 20", 10),
    ],
)
def test_a_warm_up_of_more_than_a_quarter_is_told_in_a_line_and_shortened(
    params, config, steps, per_epoch, words, short
) -> None:
    notes = told(params, config, steps, per_epoch)
    assert len(notes) == (words is not None)
    for note in notes:
        assert "\n" not in note
        assert re.match(f"--optimiser.warmup-{words}", note)
    found = with_short_warmup(config, steps, per_epoch)
    changes = {} if short is None else {"warmup_steps": short, "warmup_epochs": 0}
    assert found == dataclasses.replace(config, **changes)
    assert not told(params, found, steps, per_epoch)


def test_it_is_told_once_and_before_the_first_step(places, tmp_path, monkeypatch) -> None:
    config = dataclasses.replace(RECIPE, optimiser=OptimiserConfig(warmup_steps=STEPS))
    fail_at(monkeypatch, "train_step", 1)
    note = f"found {STEPS} steps for a run of {STEPS}"
    with pytest.warns(Note, match=note) as caught, pytest.raises(Interrupted):
        fit(config, places, tmp_path / "run", quiet=True)
    assert len([each for each in caught if each.category is Note]) == 1


EPOCH, STEPS_OF_RUN = 7, 300
"""Steps of an epoch, and of a run of some 43 epochs."""


def warmed_up(count: int, lengths: list[int], gamma: float) -> tuple[OptimiserConfig, list[float]]:
    """As MixVPR's, Conv-AP's and BoQ's code: torch's MultiStepLR by epoch, and a rate that the
    warm-up sets anew before each of its steps."""
    ours = OptimiserConfig(
        learning_rate=0.05,
        schedule=MilestonesSchedule(tuple(lengths), gamma),
        warmup_steps=count,
    )
    optimiser = torch.optim.SGD([torch.zeros(1)], lr=0.05)
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimiser, lengths, gamma)
    rates = []
    for step in range(STEPS_OF_RUN):
        (group,) = optimiser.param_groups
        if step < count:
            group["lr"] = min(1.0, (step + 1) / count) * 0.05
        rates.append(group["lr"])
        optimiser.step()
        if (step + 1) % EPOCH == 0:
            scheduler.step()
    return ours, rates


def stepped(
    ours: OptimiserConfig, make, steps: int = STEPS_OF_RUN
) -> tuple[OptimiserConfig, list[float]]:
    """A scheduler that takes a step after each of the optimiser's."""
    optimiser = torch.optim.SGD([torch.zeros(1)], lr=ours.learning_rate)
    scheduler, rates = make(optimiser), []
    for _ in range(steps):
        rates.append(optimiser.param_groups[0]["lr"])
        optimiser.step()
        scheduler.step()
    return ours, rates


SCHEDULES = {
    "MixVPR": lambda: warmed_up(23, [5, 10, 15, 25, 40], 0.3),
    "Conv-AP, a milestone within the warm-up": lambda: warmed_up(40, [5, 10, 15, 25], 0.3),
    "a milestone at the warm-up's end": lambda: warmed_up(35, [5, 10], 0.3),
    "BoQ": lambda: warmed_up(10 * EPOCH, [10, 20], 0.1),
    "no warm-up": lambda: warmed_up(0, [5, 10], 0.3),
    "SALAD": lambda: stepped(
        OptimiserConfig(learning_rate=6e-5, schedule=LinearSchedule(0.2, decay_steps=200)),
        lambda each: torch.optim.lr_scheduler.LinearLR(each, 1.0, 0.2, total_iters=200),
    ),
    "a cosine": lambda: stepped(
        OptimiserConfig(learning_rate=1e-3, schedule=CosineSchedule(0.1, decay_steps=250)),
        lambda each: torch.optim.lr_scheduler.CosineAnnealingLR(each, 250, eta_min=1e-4),
        steps=250,
    ),
    "CricaVPR": lambda: stepped(
        OptimiserConfig(learning_rate=1e-4, schedule="step"),
        lambda each: torch.optim.lr_scheduler.StepLR(each, 3 * EPOCH, 0.5),
    ),
    "Patch-NetVLAD": lambda: stepped(
        recipe("b14", "patch-netvlad").optimiser,
        lambda each: torch.optim.lr_scheduler.StepLR(each, 5 * EPOCH, 0.5),
    ),
    # Nanne's loop tells the scheduler the epoch's number, from 1, before the epoch.
    "NetVLAD": lambda: stepped(
        recipe("b14", "netvlad").optimiser,
        lambda each: torch.optim.lr_scheduler.LambdaLR(
            each, lambda step: 0.5 ** ((step // EPOCH + 1) // 5)
        ),
        steps=30 * EPOCH,
    ),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_the_learning_rate_of_every_step_is_torchs(name: str) -> None:
    ours, theirs = SCHEDULES[name]()
    schedule = learning_rate_schedule(ours, len(theirs), EPOCH)
    rates = jax.vmap(schedule)(np.arange(len(theirs)))
    # Sums and powers in float32.
    np.testing.assert_allclose(rates, theirs, rtol=2e-6)
    assert len(set(theirs)) > 2


@pytest.mark.parametrize("epoch", [7, 8, 3, 1])
def test_several_batches_share_a_step_and_its_learning_rate(epoch: int) -> None:
    """DINO-Mix's four. An epoch of 7 batches has two steps, the second of three batches.

    As Lightning does it: `global_step` counts steps, by which the code warms up; torch's
    MultiStepLR counts epochs.
    """
    ours = dataclasses.replace(recipe("b14", "dino-mix").optimiser, warmup_steps=23)
    optimiser = torch.optim.SGD([torch.zeros(1)], lr=0.005)
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimiser, [5, 10, 15, 25, 45], 0.3)
    rates, counts, global_step = [], [], 0
    (group,) = optimiser.param_groups
    for batch in range(50 * epoch):
        number = batch % epoch + 1
        if global_step < 23:
            group["lr"] = min(1.0, (global_step + 1) / 23) * 0.005
        counts.append(global_step)
        rates.append(group["lr"])
        if number % 4 == 0 or number == epoch:
            optimiser.step()
            global_step += 1
        if number == epoch:
            scheduler.step()
    config = StepConfig(MODEL, RECIPE.loss, ours, len(rates), steps_per_epoch=epoch)
    assert [count_steps(ours, batch, epoch) for batch in range(len(rates))] == counts
    assert count_steps(ours, len(rates), epoch) == global_step
    # Sums and powers in float32.
    found = jax.vmap(config.learning_rate)(np.arange(len(rates)))
    np.testing.assert_allclose(found, rates, rtol=2e-6)
    # The milestones after the warm-up: of one step an epoch that is at epoch 23.
    assert len(set(rates)) >= 23 + 2


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"schedule": "cosin"}, r"OptimiserConfig\.schedule: found 'cosin', expected one of const"),
        ({"kind": "muon"}, r"OptimiserConfig\.kind: found 'muon', expected .*, sgd, .*optax\.NAME"),
        ({"kind": "optax.no"}, r"found 'optax\.no', expected a function of optax that takes a le"),
        ({"kind": "optax.contrib"}, "found 'optax.contrib', expected a function of optax"),
        ({"kind": "optax.contrib.jax.jit"}, "expected a function of optax that takes a learning"),
        ({"kind": "optax.lbfgs"}, "optax.lbfgs: cannot step with only a gradient and a schedule"),
        ({"warmup_steps": 3, "warmup_epochs": 2}, "warmup_epochs: found 2, expected 0 with"),
        ({"accumulate": 0}, r"OptimiserConfig\.accumulate: found 0, expected a whole number of"),
        (
            {"clip_value": 0.0},
            r"OptimiserConfig\.clip_value: found 0\.0, expected a finite number above 0",
        ),
        (
            {"ema": 1.0},
            r"OptimiserConfig\.ema: found 1\.0, expected a number of at least 0 and less than 1",
        ),
    ],
)
def test_optimisers_that_do_not_fit_are_refused(fields, words) -> None:
    with pytest.raises(InputError, match=words):
        OptimiserConfig(**fields)


@pytest.mark.parametrize("preset", PRESETS)
def test_no_parameter_is_an_array_of_no_numbers(preset):
    assert not [n for n, x in named_leaves(parameter_shapes(PRESETS[preset])).items() if not x.size]


def test_no_built_in_parts_parameter_is_an_array_of_no_numbers():
    """Against shapes alone; a plug-in's is refused."""
    backbone = PRESETS["b14"].backbone
    for name in REGISTRIES["aggregator"]:
        part = REGISTRIES["aggregator"].make(name)
        made = jax.eval_shape(
            lambda key, p=part: p.init(key, backbone, (16, 16)), jax.random.key(0)
        )
        check_drawn(made, name)
    with pytest.raises(InputError, match=r"^mine: found an empty parameter a, expected None$"):
        check_drawn({"a": np.zeros((0, 3), np.float32)}, "mine")
