"""VLAD and bags of words, with visual words learnt only by k-means.

Patches of zeros are ignored: they pad images with fewer features than the backbone's `count`.
"""

from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import (
    AGGREGATORS,
    Aggregator,
    Centroids,
    FeatureRows,
    TokenShape,
)
from crisalad_jax.nn.aggregators.vlad import Words, WordsConfig, nearest_words, residual_sums
from crisalad_jax.nn.backbones.base import Backbone, Features, Grid, Patches
from crisalad_jax.nn.layers import Keys, at_least_float32, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@AGGREGATORS.register("vlad", tiny={"clusters": 16})
class HardVladConfig(WordsConfig):
    """VLAD (Jegou et al., CVPR 2010), intra-normalised (Arandjelovic and Zisserman, CVPR 2013)."""

    def sums(self, params: Words, patches: Patches) -> Float[Array, "*batch cluster dim"]:
        """Sum residuals from the nearest word, and normalise the sum of each cluster.

        If an image has no features, all values are 1.
        """
        shares = word_shares(params.words, patches)
        sums = l2_normalise(residual_sums(shares, patches, params.words))
        return _unless_empty(sums, axes=(-2, -1))


@pytree_dataclass
class Bow:
    """The visual words and their weights."""

    words: Centroids
    """k-means centroids of unit-length features; for binary features, the majority of each bit."""
    weights: Float[Array, " cluster"]
    """log(N / n) for a word in n of the N images from which the vocabulary was built."""


@AGGREGATORS.register("bow", tiny={"clusters": 100})
class BowConfig(Aggregator):
    """Bags of visual words with tf-idf weights (Sivic and Zisserman, ICCV 2003)."""

    trainable: ClassVar[bool] = False
    clusters: PositiveInt = 1000
    """Number of words of the vocabulary, which `crisalad vocabulary` builds."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token with a dimension for each word."""
        return TokenShape(self.clusters, 0, self.clusters)

    def count_centroids(self, dim: int) -> int:
        """Return the number of words."""
        return self.clusters

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Bow:
        """Draw random unit vectors as words of equal weight; `from_centroids` replaces them."""
        words = l2_normalise(random_init.normal(key, (self.clusters, backbone.dim)))
        return Bow(words, random_init.ones(self.clusters))

    def from_centroids(self, centroids: Centroids, features: FeatureRows) -> Bow:
        """Use the centroids as words; `with_frequencies` weights them."""
        return Bow(centroids, jnp.ones(len(centroids)))

    def with_frequencies(self, params: Bow, images: Sequence[np.ndarray]) -> Bow:
        """Weight each word by log(N / n), where n of the N images contain it."""
        has = [word_shares(params.words, jnp.asarray(each)).any(axis=0) for each in images]
        count = np.maximum(np.sum(has, axis=0), 1)
        return Bow(params.words, jnp.log(jnp.asarray(len(images) / count, jnp.float32)))

    def apply(self, params: Bow, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return a global token: each word's share of an image's patches, times the word's weight.

        If an image has no features, all values are 1.
        """
        patches = l2_normalise(at_least_float32(features.patches))
        counts = word_shares(params.words, patches).sum(axis=-2)
        shares = counts / jnp.maximum(counts.sum(axis=-1, keepdims=True), 1)
        return Tokens.of_global(_unless_empty(shares * params.weights, axes=(-1,)))


def word_shares(words: Centroids, patches: Patches) -> Float[Array, "*batch patch cluster"]:
    """Return, for each unit patch, 1 at its nearest word, else 0; patches of zeros get only 0."""
    nearest = jax.nn.one_hot(nearest_words(words, patches, "euclidean"), len(words))
    return nearest * patches.any(axis=-1, keepdims=True)


def _unless_empty(x: Float[Array, "*shape"], axes: tuple[int, ...]) -> Float[Array, "*shape"]:
    return jnp.where(x.any(axis=axes, keepdims=True), x, 1)
