"""Compare 20 training steps from the same start on the same batches, without dropout.

Ours is the real `train_step`, with bytes in batches of one size, one of them padded; the reference
gets only the valid images, normalised by torch.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch

from crisalad_jax.checkpoints.formats import to_state
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import STATISTICS
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.training.trainable import merge_params
from parity.cases.case import LAYOUT, STEPS, build, cancelling, convert, random, split
from parity.cases.parts import LOSS, torch_normalise
from parity.compare import FROZEN, TOLERANCES, Arrays, Row, as_double, compare
from parity.reference.training import train

OPTIMISER = OptimiserConfig(learning_rate=1e-3)
"""About 15 times the paper's rate, decaying linearly to 0, so that 20 steps move the parameters."""
LABELS = np.array([0, 0, 1, 1, 2, 2], np.int32)
PADDED_STEP = 5
"""The step in which the last image is padding."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A model, and which of its parameters train."""

    name: str
    model: ModelConfig
    trainable: str
    size: tuple[int, int] = (42, 56)


class Batch(NamedTuple):
    """Bytes (image, height, width, 3), and which images are valid."""

    images: np.ndarray
    valid: np.ndarray


def check_run(run: Run, precision: str, seed: int) -> list[Row]:
    """Compare losses, final parameters and statistics, and check that the rest is frozen."""
    rng = random(run.name, seed)
    model = build(run.model, precision, rng)
    batches = [_batch(run, step, rng) for step in range(STEPS)]
    config = TrainConfig(
        model=model.config, loss=LOSS, optimiser=OPTIMISER, trainable=run.trainable
    )
    start = {name: as_double(tensor) for name, tensor in model.state_dict().items()}
    with jax.enable_x64(precision == "float64"):
        params, extras = convert(model)
        our_losses, ours = _our_training(model.config, params, extras, config, batches)
    dtype = model.backbone.cls_token.dtype
    their_batches = (
        (
            torch_normalise(torch.from_numpy(images[valid]), dtype).permute(0, 3, 1, 2),
            torch.from_numpy(LABELS[valid]),
        )
        for images, valid in batches
    )
    their_losses = {"losses": np.array(train(model, their_batches, config, steps=STEPS))}
    theirs = {name: as_double(tensor) for name, tensor in model.state_dict().items()}
    learnt = [name for name, p in model.named_parameters() if p.grad is not None]
    measured = [name for name in theirs if name.endswith(STATISTICS)]
    trained, reference, origin = (
        split({name: state[name] for name in learnt}) for state in (ours, theirs, start)
    )
    # A batch norm subtracts the batch mean, so the gradient of a bias before it is only rounding.
    absorbed = [name for name in trained if name.endswith(".conv.bias")]
    for name in (*cancelling(trained), *absorbed):
        del trained[name], reference[name], origin[name]
    frozen, untouched = (
        {n: x for n, x in state.items() if n not in (*learnt, *measured)} for state in (ours, start)
    )
    tolerances = TOLERANCES[precision]
    rows = [
        compare(run.name, "losses", precision, our_losses, their_losses, tolerances["losses"]),
        compare(
            run.name,
            "parameters at the end",
            precision,
            trained,
            reference,
            tolerances["trained"],
            note=_note(their_losses["losses"], trained, reference, origin),
        ),
    ]
    if measured:
        found, expected = ({n: state[n] for n in measured} for state in (ours, theirs))
        what = "running statistics at the end"
        rows.append(compare(run.name, what, precision, found, expected, tolerances["statistics"]))
    if frozen:
        rows.append(compare(run.name, "frozen", precision, frozen, untouched, FROZEN))
    return rows


def _batch(run: Run, step: int, rng: np.random.Generator) -> Batch:
    """Draw a batch in which images of a place share a picture, with independent noise."""
    places = rng.integers(0, 256, (3, *run.size, 3))[LABELS]
    noise = rng.integers(0, 256, places.shape)
    valid = np.ones(len(LABELS), bool)
    valid[-1] = step != PADDED_STEP
    return Batch((0.3 * places + 0.7 * noise).astype(np.uint8), valid)


def _our_training(
    model: ModelConfig,
    params: Crisalad,
    extras: Arrays,
    config: TrainConfig,
    batches: Sequence[Batch],
) -> tuple[Arrays, Arrays]:
    """Train ours; return the losses by step, and the final parameters by the reference's names."""
    step_config = StepConfig(model, config.loss, config.optimiser, STEPS)
    state, frozen = init_train_state(params, config.trainable, step_config)
    labels, key = jnp.asarray(LABELS), jax.random.key(0)
    losses = []
    for batch in batches:
        images, valid = jnp.asarray(batch.images), jnp.asarray(batch.valid)
        state, metrics = train_step(state, frozen, images, labels, valid, key, step_config)
        losses.append(float(metrics.loss))
    final = merge_params(state.trainable, frozen, model)
    by_name = to_state(jax.tree.map(as_double, final), model, LAYOUT, extras)
    return {"losses": np.array(losses)}, by_name


def _note(losses: np.ndarray, ours: Arrays, theirs: Arrays, start: Arrays) -> str:
    def norm(x: Arrays, y: Arrays) -> float:
        return float(np.sqrt(sum(np.sum((x[n] - y[n]) ** 2) for n in x)))

    moved = norm(theirs, start)
    size = norm(theirs, {name: np.zeros(()) for name in theirs})
    return (
        f"the loss went from {losses[0]:.3f} to {losses[-1]:.3f} and the parameters moved by "
        f"{moved / size:.1%} of their norm; the two sides are {norm(ours, theirs) / moved:.1e} "
        "of that way apart"
    )
