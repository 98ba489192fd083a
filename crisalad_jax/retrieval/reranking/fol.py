"""FoL's second stage: local features of the patches with most mass (Wang et al., AAAI 2025).

It follows the paper's equations, with the constants of the public model.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from crisalad_jax.config.checks import require
from crisalad_jax.nn.aggregators.salad import Fol, FolConfig
from crisalad_jax.nn.aggregators.selavpr import SCALE, local_features
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Images, extract_features
from crisalad_jax.retrieval.reranking import matching
from crisalad_jax.utils import compiler

CHOSEN = 225
"""Number of patches whose features are compared, whatever the image size."""
_LEAST_ROWS = 19
"""Minimum rows of patches; with fewer, the public code has too little room for their features."""
_OUTLIERS, _USUAL = 3, 0.05
"""Number of largest masses that are replaced, and the share of patches above the one whose mass
replaces them."""
LEAST_COSINE = 0.7
"""Features match only if their cosine is above this value."""


def shape(config: ModelConfig) -> tuple[int, int]:
    """Return the maximum number of local features of an image, and their width.

    Raises:
        InputError: the images have fewer than 225 patches, or fewer than 19 rows of them.
    """
    assert isinstance(config.aggregator, FolConfig)
    height, width = config.input_size
    require(
        config.grid[0] >= _LEAST_ROWS and config.patches >= CHOSEN,
        f"rerank: found images of {height} x {width}, expected at least "
        f"{_LEAST_ROWS * config.backbone.patch_size} rows of pixels and {CHOSEN} patches, whose "
        "local features fol compares",
    )
    # A side of n patches has 4 n - 3 features: a patch has at most 4 x 4 of them.
    return CHOSEN * SCALE**4, config.aggregator.local


def confidence(plan: Float[Array, "patch column"]) -> Float[Array, " patch"]:
    """Compute the mean mass that each patch sends to a cluster, with the largest outliers reduced.

    The three largest means are replaced by the value that 5 % of the patches exceed.

    Args:
        plan: the mass that each patch sends to each cluster, and in the last column to the dustbin.
    """
    masses = plan[:, :-1].mean(axis=1)
    usual = jnp.sort(masses, descending=True)[int(_USUAL * len(masses))]
    return masses.at[jax.lax.top_k(masses, _OUTLIERS)[1]].set(usual)


def chosen_features(
    confidences: Float[Array, " patch"], local: Float[Array, "rows columns local"]
) -> Float[Array, "feature local"]:
    """Return the local features in the most confident patches, in row order, padded with zeros."""
    rows, columns, _ = local.shape
    size = [(side - 1) // SCALE**2 + 1 for side in (rows, columns)]
    first = jax.lax.top_k(confidences, CHOSEN)[1]
    chosen = jnp.zeros(confidences.shape, bool).at[first].set(True).reshape(size)
    chosen = chosen[_nearest(size[0], rows)][:, _nearest(size[1], columns)]
    (places,) = jnp.nonzero(chosen.ravel(), size=CHOSEN * SCALE**4, fill_value=rows * columns)
    flat = local.reshape(rows * columns, -1)
    return flat.at[places].get(mode="fill", fill_value=0)


def _nearest(source: int, target: int) -> Int[np.ndarray, " target"]:
    """Return the cells that torch's nearest interpolation takes, with its float32 rounding."""
    scale = np.float32(source) / np.float32(target)
    return np.floor(np.arange(target, dtype=np.float32) * scale).astype(int)


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image feature local"]:
    """Compute the `chosen_features` of every image, in float16."""
    assert isinstance(params.aggregator, Fol)
    assert isinstance(config.aggregator, FolConfig)
    features = extract_features(params, images, config)
    local = local_features(params.aggregator, features.patches, config.grid)
    confidences = jax.vmap(confidence)(config.aggregator.plan(params.aggregator, features))
    return jax.vmap(chosen_features)(confidences, local.astype(jnp.float16))


def count_matches(
    query: matching.Features, candidates: matching.Features, config: ModelConfig
) -> matching.Scores:
    """Count each candidate's mutual matches above `LEAST_COSINE`; a single match counts as none."""
    matches = np.asarray(matching.match_all(query, candidates, LEAST_COSINE))
    counts = (matches >= 0).sum(axis=1)
    return np.where(counts == 1, 0, counts).astype(np.float32)
