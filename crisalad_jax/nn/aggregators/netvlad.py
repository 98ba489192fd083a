"""NetVLAD: sums of residuals under a soft assignment (Arandjelovic et al., CVPR 2016)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require, require_positive
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, Features
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import pytree_dataclass

RATIO = 100
"""Initial ratio of a patch's largest share to its second largest, as in public implementations."""


@pytree_dataclass
class NetVlad:
    """The paper's decoupled parameters: the soft assignment of patches, and the centroids.

    The linear layer has no bias. The authors' code starts from unit centroids, so the paper's bias,
    -alpha |c|^2, is the same for all clusters and cancels in the softmax.
    """

    conv: Linear
    """Linear layer from a patch to one score for each cluster."""
    centroids: Float[Array, "cluster dim"]


@AGGREGATORS.register("netvlad", tiny={"clusters": 16})
@dataclasses.dataclass(frozen=True)
class NetVladConfig(Aggregator):
    """NetVLAD (Arandjelovic et al., CVPR 2016)."""

    clusters: int = 64

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters")
        require(
            self.clusters > 1,
            f"NetVladConfig.clusters: found {self.clusters}, expected at least 2 to choose from",
        )

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one sum of residuals for each cluster."""
        return TokenShape(0, self.clusters, dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> NetVlad:
        """Draw unit vectors as centroids. `training.vocabulary` makes centroids from images."""
        conv_key, centroid_key = draw.split(key)
        dim = backbone.dim
        return NetVlad(
            conv=init_linear(conv_key, dim, self.clusters, bias=False),
            centroids=l2_normalise(draw.normal(centroid_key, (self.clusters, dim))),
        )

    def from_centroids(
        self, centroids: Float[Array, "cluster dim"], features: Float[Array, "feature dim"]
    ) -> NetVlad:
        """Make parameters as the authors do; see `scores_from_centroids`."""
        return NetVlad(scores_from_centroids(centroids, features), centroids)

    def apply(
        self, params: NetVlad, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a sum of residuals for each cluster, of length 1; no global token."""
        return Tokens.of_local(netvlad(params, features.patches))


def scores_from_centroids(
    centroids: Float[Array, "cluster dim"], features: Float[Array, "feature dim"]
) -> Linear:
    """Make the scores' layer as the authors do: alpha times cosines to the k-means centroids.

    alpha is chosen so that a feature's largest share is `RATIO` times its second largest, in the
    geometric mean over these features.

    Args:
        centroids: of the features, two or more.
        features: unit vectors, or what the centroids are of.

    Raises:
        InputError: all features are as near to two centroids, as where all are alike.
    """
    directions = l2_normalise(centroids)
    cosines = jnp.matmul(features, directions.T, precision="highest")
    best = jax.lax.top_k(cosines, 2)[0]
    gap = float((best[:, 0] - best[:, 1]).mean())
    # Below this the two differ by rounding alone.
    if not gap > 1e-6:
        raise InputError(
            f"features: found {len(features)} that are as near to two of {len(centroids)} "
            "centroids, expected features that differ"
        )
    return Linear(math.log(RATIO) / gap * directions.T, None)


def netvlad(
    params: NetVlad, patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch cluster dim"]:
    """Aggregate unit patches by Eq. 4, then intra-normalise (Arandjelovic, Zisserman 2013).

    It computes in float32 at least, at the highest precision, because alpha multiplies the scores'
    rounding error.
    """
    patches = l2_normalise(at_least_float32(patches))
    return l2_normalise(residual_sums(shares(params.conv, patches), patches, params.centroids))


def shares(
    conv: Linear, patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch patch cluster"]:
    """Assign unit patches softly: compute a softmax over the clusters (the paper's Eq. 3)."""
    scores = jnp.matmul(patches, conv.weight, precision="highest")
    return jax.nn.softmax(scores, axis=-1)


def residual_sums(
    shares: Float[Array, "*batch patch cluster"],
    patches: Float[Array, "*batch patch dim"],
    centroids: Float[Array, "cluster dim"],
) -> Float[Array, "*batch cluster dim"]:
    """Sum, for each cluster, all patches' residuals from it, weighted by their shares.

    This is the weighted sum of the patches minus the centroid times the sum of the shares.
    """
    sums = jnp.einsum("...pk,...pd->...kd", shares, patches, precision="highest")
    return sums - shares.sum(axis=-2)[..., None] * centroids
