"""SuperVLAD: sums of patches in few clusters, without centroids (Lu et al., NeurIPS 2024)."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require, require_positive
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.netvlad import scores_from_centroids
from crisalad_jax.nn.backbones.base import Backbone, Features
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class SuperVlad:
    """The soft assignment of patches."""

    conv: Linear
    """Linear layer without bias from a patch to a score for each cluster, ghosts last."""


@AGGREGATORS.register("supervlad")
@dataclasses.dataclass(frozen=True)
class SuperVladConfig(Aggregator):
    """SuperVLAD (Lu et al., NeurIPS 2024).

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> one = SuperVladConfig(clusters=1, ghosts=2)
        >>> ModelConfig(aggregator=one, cross_image=CrossImageConfig(layers=0)).descriptor_dim
        768
    """

    centroid_images: ClassVar[int] = 5000
    clusters: int = 4
    ghosts: int = 1
    """Number of clusters that take part in the softmax, and are dropped after it."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters")
        require(
            self.ghosts >= 0, f"SuperVladConfig.ghosts: found {self.ghosts}, expected at least 0"
        )
        require(
            self.clusters + self.ghosts > 1,
            "SuperVladConfig.clusters: found 1 and no ghost, expected at least 2 to choose from",
        )

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one sum of patches for each cluster."""
        return TokenShape(0, self.clusters, dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> SuperVlad:
        """Draw the scores' layer as torch's convolution."""
        return SuperVlad(init_linear(key, backbone.dim, self.clusters + self.ghosts, bias=False))

    def from_centroids(
        self, centroids: Float[Array, "cluster dim"], features: Float[Array, "feature dim"]
    ) -> SuperVlad:
        """Make the scores as NetVLAD's; the centroids themselves are not kept."""
        return SuperVlad(scores_from_centroids(centroids, features))

    def count_centroids(self, dim: int) -> int:
        """Return the number of all clusters, ghosts included."""
        return self.clusters + self.ghosts

    def apply(
        self, params: SuperVlad, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a sum of patches for each cluster, of the same length; together of length 1."""
        return Tokens.of_local(supervlad(params, features.patches, self.clusters))


def supervlad(
    params: SuperVlad, patches: Float[Array, "*batch patch dim"], clusters: int
) -> Float[Array, "*batch cluster dim"]:
    """Sum unit patches by their shares in the clusters, then normalise each sum, then all.

    It computes in float32 at least, at the highest precision, as `netvlad` does.
    """
    patches = l2_normalise(at_least_float32(patches))
    scores = jnp.matmul(patches, params.conv.weight, precision="highest")
    shares = jax.nn.softmax(scores, axis=-1)[..., :clusters]
    sums = l2_normalise(jnp.einsum("...pk,...pd->...kd", shares, patches, precision="highest"))
    flat = l2_normalise(sums.reshape(*sums.shape[:-2], -1))
    return flat.reshape(sums.shape)
