"""Random weights far from every symmetric start, under the torch reference's names.

Gains differ from 1, biases and up-projections differ from 0, and batch statistics resemble those of
a trained model, so a layer that drops or confuses any of them gives different results.
"""

from collections.abc import Mapping

import numpy as np


def random_state(
    shapes: Mapping[str, tuple[int, ...]], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Draw an array for every name, in float32; batch counts are int64."""
    return {name: _array(name, shape, rng) for name, shape in shapes.items()}


def _array(name: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    leaf = name.rpartition(".")[2]
    if leaf == "num_batches_tracked":
        return np.full(shape, 7, np.int64)
    if leaf == "running_var":
        # From batch norm's epsilon of 1e-3 to 1, so that the epsilon matters.
        array = 10 ** rng.uniform(-3, 0, shape)
    elif leaf == "p":
        array = rng.uniform(2, 4, shape)
    elif leaf == "gamma" or (leaf == "weight" and len(shape) == 1):
        array = rng.uniform(0.5, 1.5, shape)
    elif leaf in ("weight", "in_proj_weight"):
        array = rng.normal(size=shape) / np.sqrt(np.prod(shape[1:]))
    else:  # biases, tokens, positions, running means, the dustbin's score
        array = rng.normal(scale=0.2, size=shape)
    return array.astype(np.float32)
