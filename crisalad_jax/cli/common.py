"""What several commands need: the terminal, and a model as their flags name it."""

import dataclasses
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import jax
import rich.console

from crisalad_jax.checkpoint import load_weights
from crisalad_jax.config import ModelConfig, recipe
from crisalad_jax.groupings import GROUPINGS
from crisalad_jax.model import Crisalad, init_crisalad

# Into a file or a pipe, wide enough that tables do not wrap. Brackets and colons in names are text.
console = rich.console.Console(
    width=None if sys.stdout.isatty() else 120, markup=False, emoji=False
)


def model_of(
    weights: Path | None,
    *,
    preset: str = "b14",
    seed: int = 0,
    image_size: tuple[int, int] | None = None,
    compute_dtype: Literal["float32", "bfloat16"] | None = None,
) -> tuple[Crisalad, ModelConfig, str]:
    """A model from a file, or without one an untrained preset, and what to call it."""
    if weights is None:
        config = recipe(preset).model
        params = init_crisalad(jax.random.key(seed), config)
        name = f"untrained {preset}, seed {seed}"
    else:
        params, config = load_weights(weights)
        name = f"{weights.parent.name}/{weights.name}" if weights.parent.name else weights.name
    if compute_dtype is not None:
        config = dataclasses.replace(config, compute_dtype=compute_dtype)
    return params, resized(config, image_size), name


def resized(config: ModelConfig, image_size: tuple[int, int] | None) -> ModelConfig:
    """The configuration at another image size (height, width), where one is given."""
    if image_size is None:
        return config
    config.check_image_size(image_size)
    return dataclasses.replace(config, image_size=image_size)


def grouping_words(groupings: Iterable[str]) -> str:
    """What groupings mean, for under a table."""
    return "; ".join(f"{name} = {GROUPINGS[name]}" for name in groupings)
