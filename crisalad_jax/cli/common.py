"""Helpers of several commands: the terminal, and loading a model as their flags name it."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import jax
import rich.console

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, init_crisalad
from crisalad_jax.training.recipes import recipe

# Into a file or a pipe, wide enough that tables do not wrap. Brackets and colons in names are text.
console = rich.console.Console(
    width=None if sys.stdout.isatty() else 120, markup=False, emoji=False
)


def say(line: str) -> None:
    """Print a line without wrapping it to the terminal's width."""
    console.print(line, soft_wrap=True, highlight=False)


def load_model(
    weights: Path | None,
    *,
    preset: str = "b14",
    seed: int = 0,
    image_size: tuple[int, int] | None = None,
    compute_dtype: Literal["float32", "bfloat16"] | None = None,
) -> tuple[Crisalad, ModelConfig, str]:
    """Load a model from a file, or initialise an untrained preset without one.

    Args:
        weights: the file.
        preset: the size of the untrained model.
        seed: draws the parameters of the untrained model.
        image_size: height and width in pixels; None is the model's.
        compute_dtype: type of the matrix products; None is the model's.

    Returns:
        (params, config, name); the name stands in tables and titles.

    Raises:
        InputError: what `load_weights`, `recipe` and `ModelConfig.resized` raise.
    """
    if weights is None:
        config = recipe(preset).model
        params = init_crisalad(jax.random.key(seed), config)
        name = f"untrained {preset}, seed {seed}"
    else:
        params, config = load_weights(weights)
        name = f"{weights.parent.name}/{weights.name}" if weights.parent.name else weights.name
    if compute_dtype is not None:
        config = dataclasses.replace(config, compute_dtype=compute_dtype)
    return params, config.resized(image_size), name
