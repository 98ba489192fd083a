"""VLAD-BuFF: NetVLAD whose patches weigh less the more there are alike (Khaliq et al., ECCV 2024).

Written from the paper, with the constants of the public model.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require, require_positive
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.netvlad import residual_sums, scores_from_centroids, shares
from crisalad_jax.nn.backbones.base import Backbone, Features
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

BURST = (8.0, 7.0, 1.0)
"""Initial slope, offset and power of the burst weights, as published."""


@pytree_dataclass
class Reduction:
    """Fewer dimensions of a unit patch: `(patch - mean) @ rotation`."""

    mean: Float[Array, " dim"]
    rotation: Float[Array, "dim reduced"]


@pytree_dataclass
class VladBuff:
    """NetVLAD's parameters, those of the burst weights, and the reduction before them."""

    reduction: Reduction | None
    conv: Linear
    """Linear layer without bias from a patch to one score for each cluster."""
    centroids: Float[Array, "cluster reduced"]
    burst: Float[Array, "3"]
    """Slope, offset and power."""


@AGGREGATORS.register("vlad-buff", tiny={"clusters": 16, "reduced": 32})
@dataclasses.dataclass(frozen=True)
class VladBuffConfig(Aggregator):
    """VLAD-BuFF (Khaliq et al., ECCV 2024).

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> alone = CrossImageConfig(layers=0)
        >>> ModelConfig(aggregator="vlad-buff", cross_image=alone).descriptor_dim
        12288
    """

    clusters: int = 64
    reduced: int = 192
    """Width of a patch after the reduction; 0 leaves the reduction out."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters")
        require(
            self.clusters > 1,
            f"VladBuffConfig.clusters: found {self.clusters}, expected at least 2 to choose from",
        )
        require(
            self.reduced >= 0, f"VladBuffConfig.reduced: found {self.reduced}, expected at least 0"
        )

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one sum of residuals for each cluster."""
        return TokenShape(0, self.clusters, self.reduced or dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> VladBuff:
        """Draw an orthogonal reduction and unit centroids; `from_centroids` replaces them."""
        rotation_key, conv_key, centroid_key = draw.split(key, 3)
        dim = self.reduced or backbone.dim
        rotation = jax.nn.initializers.orthogonal()(rotation_key, (backbone.dim, dim))
        return VladBuff(
            reduction=Reduction(draw.zeros(backbone.dim), rotation) if self.reduced else None,
            conv=init_linear(conv_key, dim, self.clusters, bias=False),
            centroids=l2_normalise(draw.normal(centroid_key, (self.clusters, dim))),
            burst=jnp.asarray(BURST),
        )

    def centroid_features(
        self, features: Float[Array, "feature dim"]
    ) -> Float[Array, "feature reduced"]:
        """Return the features reduced by their principal components, at their own lengths.

        Raises:
            InputError: there are fewer features than components.
        """
        if not self.reduced:
            return features
        return reduce_features(fit_reduction(features, self.reduced), features)

    def from_centroids(
        self, centroids: Float[Array, "cluster reduced"], features: Float[Array, "feature dim"]
    ) -> VladBuff:
        """Make the reduction of principal components, and NetVLAD's start of reduced features."""
        reduction = fit_reduction(features, self.reduced) if self.reduced else None
        conv = scores_from_centroids(centroids, self.centroid_features(features))
        return VladBuff(reduction, conv, centroids, jnp.asarray(BURST))

    def apply(
        self, params: VladBuff, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a sum of residuals for each cluster, of length 1; no global token."""
        return Tokens.of_local(vlad_buff(params, features.patches))


def fit_reduction(features: Float[Array, "feature dim"], reduced: int) -> Reduction:
    """Fit the mean and the first principal components of features, without whitening.

    Args:
        features: at least `reduced` of them, and at least so wide.
        reduced: number of components.

    Raises:
        InputError: there are fewer features, or they are narrower.
    """
    require(
        min(features.shape) >= reduced,
        f"features: found {features.shape[0]} of width {features.shape[1]}, expected at least "
        f"{reduced} of each, one for each component that VLAD-BuFF keeps",
    )
    mean = features.mean(axis=0)
    centred = features - mean
    scatter = jnp.matmul(centred.T, centred, precision="highest")
    # Eigenvalues rise.
    return Reduction(mean, jnp.linalg.eigh(scatter)[1][:, ::-1][:, :reduced])


def reduce_features(
    reduction: Reduction, features: Float[Array, "*batch feature dim"]
) -> Float[Array, "*batch feature reduced"]:
    """Reduce features to fewer dimensions, in which they are no unit vectors."""
    return jnp.matmul(features - reduction.mean, reduction.rotation, precision="highest")


def vlad_buff(
    params: VladBuff, patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch cluster reduced"]:
    """Reduce unit patches to shorter ones, and sum their residuals by shares over burst weights.

    It computes in float32 at least, at the highest precision, as `netvlad` does.
    """
    patches = l2_normalise(at_least_float32(patches))
    if params.reduction is not None:
        patches = l2_normalise(reduce_features(params.reduction, patches))
    weighed = shares(params.conv, patches) / burst_weights(params.burst, patches)[..., None]
    return l2_normalise(residual_sums(weighed, patches, params.centroids))


def burst_weights(
    burst: Float[Array, "3"], patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch patch"]:
    """Count, softly, the patches that are like each: sigmoids of squared distances, summed.

    Args:
        burst: slope a, offset b and power p of (sum over j of sigmoid(b - a |x_i - x_j|^2))^p.
        patches: unit vectors.
    """
    slope, offset, power = burst
    cosines = jnp.einsum("...id,...jd->...ij", patches, patches, precision="highest")
    alike = jax.nn.sigmoid(slope * (2 * cosines - 2) + offset)
    return alike.sum(axis=-1) ** power
