"""Compare descriptors of the paper's model at full width and depth, with random weights."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import torch

from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import Crisalad, describe
from parity.cases.case import build, convert, random
from parity.compare import TOLERANCES, Row, Tolerance, as_double, compare
from parity.reference.model import Crisalad as TorchCrisalad

PRESET = "b14"
SIZES = ((224, 224), (322, 322), (224, 308))
"""Image sizes: the paper's, DINO-SALAD's, and one that is not square."""
BATCH = 2
FEW_ROUNDINGS = Tolerance(
    1e-15, "nine roundings of 1.1e-16 in a sum of 1, where the descriptor's squared is far below"
)


def full_size_checks(precision: str, seed: int) -> dict[str, Callable[[], list[Row]]]:
    """Make a check for each size, by name; the weights are made when the first check runs."""

    @functools.cache
    def sides() -> tuple[TorchCrisalad, Crisalad]:
        model = build(PRESETS[PRESET], precision, random(PRESET, seed))
        with jax.enable_x64(precision == "float64"):
            return model, convert(model)[0]

    def at(size: tuple[int, int]) -> Callable[[], list[Row]]:
        return lambda: _check(*sides(), size, precision, seed)

    return {_name(size): at(size) for size in SIZES}


def _name(size: tuple[int, int]) -> str:
    return f"{PRESET} at {size[0]} x {size[1]}"


def _check(
    model: TorchCrisalad, params: Crisalad, size: tuple[int, int], precision: str, seed: int
) -> list[Row]:
    name = _name(size)
    images = random(name, seed).normal(size=(BATCH, *size, 3)).astype(np.float32)
    dtype = model.backbone.cls_token.dtype
    with torch.no_grad():
        channels_first = torch.from_numpy(images).to(dtype).permute(0, 3, 1, 2)
        theirs = as_double(model(channels_first))
    with jax.enable_x64(precision == "float64"):
        ours = as_double(
            describe(params, jnp.asarray(images, params.backbone.cls_token.dtype), model.config)
        )
    tolerance = TOLERANCES[precision]["full size"]
    pair = {"descriptors": ours}, {"descriptors": theirs}
    row = compare(name, "forward", precision, *pair, tolerance)
    return [row, cosine_row(row, ours, theirs)]


def cosine_row(row: Row, ours: np.ndarray, theirs: np.ndarray) -> Row:
    """Make the row that compares directions (image, descriptor), next to the descriptors' `row`."""
    norms = np.linalg.norm(ours, axis=-1) * np.linalg.norm(theirs, axis=-1)
    distance = float(np.abs(1 - (ours * theirs).sum(-1) / norms).max())
    squared = Tolerance(row.tolerance**2, "the descriptor's squared: 1 - cosine is half of that")
    tolerance = max(squared, FEW_ROUNDINGS)
    return dataclasses.replace(
        row,
        quantity="1 - smallest cosine",
        max_abs=distance,
        relative=distance,
        tolerance=tolerance.value,
        why=tolerance.why,
    )
