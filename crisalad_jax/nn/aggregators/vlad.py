"""Sums of patches, or of their residuals, by cluster: NetVLAD, SuperVLAD, VLAD-BuFF and AnyLoc.

All of them compute in at least float32, at JAX's highest precision of matrix products.
"""

import abc
import dataclasses
import math
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import (
    NonNegativeInt,
    PositiveInt,
    require,
    require_field,
    require_range,
)
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import (
    AGGREGATORS,
    Aggregator,
    Centroids,
    FeatureRows,
    TokenShape,
)
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid, Patches
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import pytree_dataclass

RATIO = 100
"""Initial ratio of a patch's two largest softmax shares, as in public implementations."""
BURST = (8.0, 7.0, 1.0)
"""Initial slope, offset and power of VLAD-BuFF's burst weights, as published."""


@dataclasses.dataclass(frozen=True)
class VladConfig(Aggregator):
    """Base class of VLAD aggregators: one local token per cluster, as wide as the backbone."""

    clusters: PositiveInt = 64

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_field(self, "clusters", self.count_centroids(0) > 1, "at least 2 to choose from")

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a local token of width `dim` per cluster, without a global token."""
        return TokenShape(0, self.clusters, dim)

    @abc.abstractmethod
    def sums(self, params: Any, patches: Patches) -> Float[Array, "*batch cluster dim"]:
        """Return each cluster's sum over an image's unit-length patches, in at least float32.

        All products use the highest precision: a small difference in scores or distances can move a
        patch to another cluster.
        """

    def apply(self, params: Any, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Scale patches to unit length, and return the local tokens that `sums` computes."""
        patches = l2_normalise(at_least_float32(features.patches))
        return Tokens.of_local(self.sums(params, patches))


@pytree_dataclass
class NetVlad:
    """The paper's decoupled parameters: the soft assignment of patches, and the centroids.

    The linear layer has no bias. The authors' code starts from unit centroids, so the paper's bias,
    -alpha |c|^2, is the same for all clusters and cancels in the softmax.
    """

    conv: Linear
    """Linear layer from a patch to one score for each cluster."""
    centroids: Centroids


@AGGREGATORS.register("netvlad", tiny={"clusters": 16})
class NetVladConfig(VladConfig):
    """NetVLAD (Arandjelovic et al., CVPR 2016)."""

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> NetVlad:
        """Draw unit centroids and a score layer at random; `from_centroids` replaces them."""
        conv_key, centroid_key = random_init.split(key)
        dim = backbone.dim
        return NetVlad(
            conv=init_linear(conv_key, dim, self.clusters, bias=False),
            centroids=l2_normalise(random_init.normal(centroid_key, (self.clusters, dim))),
        )

    def from_centroids(self, centroids: Centroids, features: FeatureRows) -> NetVlad:
        """Make parameters from k-means centroids, like the authors; see `scores_from_centroids`."""
        return NetVlad(scores_from_centroids(centroids, features), centroids)

    def sums(self, params: NetVlad, patches: Patches) -> Float[Array, "*batch cluster dim"]:
        """Sum residuals per cluster (Eq. 4), normalise each (Arandjelovic and Zisserman 2013)."""
        return l2_normalise(residual_sums(shares(params.conv, patches), patches, params.centroids))


@pytree_dataclass
class SuperVlad:
    """Parameters of the soft assignment of patches."""

    conv: Linear
    """Linear layer without bias from a patch to a score for each cluster, ghost clusters last."""


@AGGREGATORS.register("supervlad")
class SuperVladConfig(VladConfig):
    """SuperVLAD (Lu et al., NeurIPS 2024).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> one = SuperVladConfig(clusters=1, ghosts=2)
        >>> ModelConfig(aggregator=one, cross_image="none").descriptor_dim
        768
    """

    centroid_images: ClassVar[int] = 5000
    clusters: PositiveInt = 4
    ghosts: NonNegativeInt = 1
    """Number of ghost clusters, which take part in the softmax and are dropped after it."""

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> SuperVlad:
        """Draw the score layer as torch draws convolutions."""
        return SuperVlad(init_linear(key, backbone.dim, self.clusters + self.ghosts, bias=False))

    def from_centroids(self, centroids: Centroids, features: FeatureRows) -> SuperVlad:
        """Make the score layer as in NetVLAD; the centroids themselves are not stored."""
        return SuperVlad(scores_from_centroids(centroids, features))

    def count_centroids(self, dim: int) -> int:
        """Return the total number of clusters, ghosts included."""
        return self.clusters + self.ghosts

    def sums(self, params: SuperVlad, patches: Patches) -> Float[Array, "*batch cluster dim"]:
        """Sum patches weighted by share; normalise each cluster's sum, then all sums together."""
        parts = shares(params.conv, patches)[..., : self.clusters]
        sums = l2_normalise(jnp.einsum("...pk,...pd->...kd", parts, patches, precision="highest"))
        return l2_normalise(sums.reshape(*sums.shape[:-2], -1)).reshape(sums.shape)


@pytree_dataclass
class Reduction:
    """Dimensionality reduction of a unit-length patch: `(patch - mean) @ rotation`."""

    mean: Float[Array, " dim"]
    rotation: Float[Array, "dim reduced"]


@pytree_dataclass
class VladBuff:
    """Parameters of the reduction, of NetVLAD on reduced patches, and of the burst weights."""

    reduction: Reduction | None
    conv: Linear
    """Linear layer without bias from a patch to one score for each cluster."""
    centroids: Float[Array, "cluster reduced"]
    burst: Float[Array, "3"]
    """Slope, offset and power of the burst weights; see `burst_weights`."""


@AGGREGATORS.register("vlad-buff", tiny={"clusters": 16, "reduced": 32})
class VladBuffConfig(VladConfig):
    """VLAD-BuFF (Khaliq et al., ECCV 2024).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator="vlad-buff", cross_image="none").descriptor_dim
        12288
    """

    reduced: NonNegativeInt = 192
    """Width of a patch after the reduction; 0 disables the reduction."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a local token per cluster, `reduced` wide, or `dim` if that is 0."""
        return TokenShape(0, self.clusters, self.reduced or dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> VladBuff:
        """Draw an orthogonal reduction and unit centroids; `from_centroids` replaces them."""
        rotation_key, conv_key, centroid_key = random_init.split(key, 3)
        dim = self.reduced or backbone.dim
        rotation = jax.nn.initializers.orthogonal()(rotation_key, (backbone.dim, dim))
        reduction = Reduction(random_init.zeros(backbone.dim), rotation)
        return VladBuff(
            reduction=reduction if self.reduced else None,
            conv=init_linear(conv_key, dim, self.clusters, bias=False),
            centroids=l2_normalise(random_init.normal(centroid_key, (self.clusters, dim))),
            burst=jnp.asarray(BURST),
        )

    def centroid_features(self, features: FeatureRows) -> Float[Array, "feature reduced"]:
        """Reduce the features to their principal components, without normalising them again.

        Raises:
            InputError: there are fewer features, or fewer dimensions, than components.
        """
        if not self.reduced:
            return features
        return reduce_features(fit_reduction(features, self.reduced), features)

    def from_centroids(
        self, centroids: Float[Array, "cluster reduced"], features: FeatureRows
    ) -> VladBuff:
        """Fit the reduction by PCA, and make NetVLAD's parameters from the reduced features."""
        reduction = fit_reduction(features, self.reduced) if self.reduced else None
        conv = scores_from_centroids(centroids, self.centroid_features(features))
        return VladBuff(reduction, conv, centroids, jnp.asarray(BURST))

    def sums(self, params: VladBuff, patches: Patches) -> Float[Array, "*batch cluster reduced"]:
        """Sum reduced residuals weighted by share / burst weight; normalise each cluster's sum."""
        if params.reduction is not None:
            patches = l2_normalise(reduce_features(params.reduction, patches))
        weighed = shares(params.conv, patches) / burst_weights(params.burst, patches)[..., None]
        return l2_normalise(residual_sums(weighed, patches, params.centroids))


@pytree_dataclass
class Words:
    """The visual words."""

    words: Centroids
    """k-means centroids of unit-length features."""


class WordsConfig(VladConfig):
    """Base class of VLAD by nearest visual word, whose words come only from k-means."""

    trainable: ClassVar[bool] = False

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Words:
        """Draw random unit vectors as words; `from_centroids` replaces them."""
        return Words(l2_normalise(random_init.normal(key, (self.clusters, backbone.dim))))

    def from_centroids(self, centroids: Centroids, features: FeatureRows) -> Words:
        """Use the centroids as words."""
        return Words(centroids)


@AGGREGATORS.register("anyloc", tiny={"clusters": 16, "layer": -1})
class AnyLocConfig(WordsConfig):
    """AnyLoc: hard VLAD on a facet of one block, without training (Keetha et al., RA-L 2023)."""

    clusters: PositiveInt = 32
    """Number of words of the vocabulary, which `crisalad vocabulary` builds."""
    layer: int = -9
    """Index of the block that the facet is taken from: from 0, or from the end if negative. -9 is
    block 31 of ViT-g's 40, AnyLoc's choice."""
    facet: Literal["query", "key", "value", "token"] = "value"
    """Facet of the block: queries, keys or values of its attention, or its output tokens."""
    assignment: Literal["cosine", "euclidean"] = "cosine"
    """How the word nearest to a patch is found, in k-means too: by the angle ("cosine", as in the
    public code) or by Euclidean distance."""

    def features(self, depth: int) -> FeatureSpec:
        """Request the facet, without the last layer norm.

        Raises:
            InputError: `layer` is not the index of a block.
        """
        require_range(self, -depth, depth - 1, "layer")
        return FeatureSpec((self.layer % depth + 1,), self.facet, norm=False)

    @property
    def spherical_centroids(self) -> bool:
        """Whether k-means compares features with centroids by the angle; set by `assignment`."""
        return self.assignment == "cosine"

    def sums(self, params: Words, patches: Patches) -> Float[Array, "*batch cluster dim"]:
        """Compute VLAD (Jegou et al. 2010): residuals from the nearest word, intra-normalised.

        Words are not normalised before the subtraction. A word that is nearest to no patch has a
        sum of 0.
        """
        nearest = nearest_words(params.words, patches, self.assignment)
        one_hot = jax.nn.one_hot(nearest, len(params.words), dtype=patches.dtype)
        return l2_normalise(residual_sums(one_hot, patches, params.words))


def scores_from_centroids(centroids: Centroids, features: FeatureRows) -> Linear:
    """Make NetVLAD's score layer as its authors do: alpha times cosines to k-means centroids.

    alpha is chosen so that a feature's largest share is `RATIO` times its second largest, in the
    geometric mean over these features.

    Args:
        centroids: two or more centroids of the features.
        features: unit vectors, or the vectors that the centroids were computed from.

    Raises:
        InputError: all features are equally near two centroids, for example if all are equal.
    """
    directions = l2_normalise(centroids)
    cosines = jnp.matmul(features, directions.T, precision="highest")
    best = jax.lax.top_k(cosines, 2)[0]
    gap = float((best[:, 0] - best[:, 1]).mean())
    # Below this the two differ only by rounding.
    if not gap > 1e-6:
        raise InputError(
            f"features: found {len(features)} equally near two of {len(centroids)} "
            "centroids, expected features that differ"
        )
    return Linear(math.log(RATIO) / gap * directions.T, None)


def shares(conv: Linear, patches: Patches) -> Float[Array, "*batch patch cluster"]:
    """Return each unit patch's shares of the clusters: a softmax of scores (NetVLAD's Eq. 3)."""
    scores = jnp.matmul(patches, conv.weight, precision="highest")
    return jax.nn.softmax(scores, axis=-1)


def residual_sums(
    shares: Float[Array, "*batch patch cluster"], patches: Patches, centroids: Centroids
) -> Float[Array, "*batch cluster dim"]:
    """Sum the residuals of all patches from each centroid, weighted by the patches' shares.

    This is the weighted sum of the patches minus the centroid times the sum of the shares.
    """
    sums = jnp.einsum("...pk,...pd->...kd", shares, patches, precision="highest")
    return sums - shares.sum(axis=-2)[..., None] * centroids


def fit_reduction(features: FeatureRows, reduced: int) -> Reduction:
    """Fit the mean and the first principal components of features, without whitening.

    Args:
        features: at least `reduced` vectors, of at least `reduced` dimensions.
        reduced: number of components.

    Raises:
        InputError: there are fewer features, or fewer dimensions, than components.
    """
    require(
        min(features.shape) >= reduced,
        f"features: found {features.shape[0]} of width {features.shape[1]}, expected at least "
        f"{reduced} features and dimensions, one for each component of VLAD-BuFF",
    )
    mean = features.mean(axis=0)
    centred = features - mean
    scatter = jnp.matmul(centred.T, centred, precision="highest")
    # Eigenvalues are in ascending order.
    return Reduction(mean, jnp.linalg.eigh(scatter)[1][:, ::-1][:, :reduced])


def reduce_features(
    reduction: Reduction, features: Float[Array, "*batch feature dim"]
) -> Float[Array, "*batch feature reduced"]:
    """Reduce features to fewer dimensions. The results are not unit vectors."""
    return jnp.matmul(features - reduction.mean, reduction.rotation, precision="highest")


def burst_weights(burst: Float[Array, "3"], patches: Patches) -> Float[Array, "*batch patch"]:
    """Compute each patch's burst weight: a soft count of the patches similar to it.

    Args:
        burst: slope a, offset b and power p of (sum over j of sigmoid(b - a |x_i - x_j|^2))^p.
        patches: unit vectors x.
    """
    slope, offset, power = burst
    cosines = jnp.einsum("...id,...jd->...ij", patches, patches, precision="highest")
    alike = jax.nn.sigmoid(slope * (2 * cosines - 2) + offset)
    return alike.sum(axis=-1) ** power


def nearest_words(
    words: Centroids, patches: Patches, assignment: Literal["cosine", "euclidean"]
) -> Int[Array, "*batch patch"]:
    """Return the index of the word nearest to each unit patch, by angle or Euclidean distance."""
    if assignment == "cosine":
        return jnp.argmax(jnp.matmul(patches, l2_normalise(words).T, precision="highest"), axis=-1)
    products = jnp.matmul(patches, words.T, precision="highest")
    # |p - w|^2 = 1 - 2 p w + |w|^2.
    return jnp.argmax(products - 0.5 * jnp.square(words).sum(axis=-1), axis=-1)
