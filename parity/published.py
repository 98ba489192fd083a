"""Compare full-size published models with random weights with outputs of their public code."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import torch

from crisalad_jax.checkpoints.formats import infer, to_params
from crisalad_jax.config.preprocessing import IMAGENET_DEVIATION, IMAGENET_MEAN
from crisalad_jax.nn.model import describe
from parity import zoo
from parity.compare import Row, Tolerance, as_double, compare

CLOSE = Tolerance(
    2e-5, "forty times what float32 makes; a wrong mean, axis or norm shows at 1e-3 and more"
)
ROUNDED = {
    name: Tolerance(value, "activations are rounded to 8 bits: 1e-6 of the pixels moves features")
    for name, value in {"tetra_boq": 5e-3, "tetra_salad": 1e-2}.items()
}
"""Bounds of ternary models: a change of 1e-6 in the pixels moves features by 1.6e-2, as far as ours
are from those of the public code; descriptors differ from theirs by 1.3e-3 and 2.8e-3."""
HASHES = "hash_descriptor"
"""Name of the descriptor to compare for models that have a second one for the bits."""


def tolerance_of(name: str) -> Tolerance:
    """Return the bound on a model's descriptors."""
    return ROUNDED.get(name, CLOSE)


def images_of(name: str) -> np.ndarray:
    """Return the golden images; TeTRA's are normalised, and resized as tensors to its only size."""
    images = zoo.golden(name)["images"]
    if name not in ROUNDED:
        return images
    unit = (images / np.float32(255) - np.float32(IMAGENET_MEAN)) / np.float32(IMAGENET_DEVIATION)
    tensor = torch.from_numpy(unit).permute(0, 3, 1, 2)
    resized = torch.nn.functional.interpolate(tensor, (322, 322), mode="bilinear")
    return resized.permute(0, 2, 3, 1).numpy()


def expected_of(name: str) -> np.ndarray:
    """Return the descriptors of the public code."""
    golden = zoo.golden(name)
    return golden[HASHES if HASHES in golden else "descriptor"]


def published_checks() -> dict[str, Callable[[], list[Row]]]:
    """Make a float32 check for each published network, by name."""
    return {f"published: {name}": lambda name=name: [_check(name)] for name in zoo.NAMES}


def _check(name: str) -> Row:
    state = zoo.random_state(name)
    layout, config = infer(state, source=name)
    params, _ = to_params(state, config, layout, source=name)
    found = describe(jax.tree.map(jnp.asarray, params), images_of(name), config)
    pair = {"descriptors": as_double(found)}, {"descriptors": as_double(expected_of(name))}
    return compare(f"published: {name}", "forward", "float32", *pair, tolerance_of(name))
