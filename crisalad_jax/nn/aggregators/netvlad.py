"""NetVLAD: sums of residuals under a soft assignment (Arandjelovic et al., CVPR 2016)."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.nn.layers import Keys, Linear, init_linear, l2_normalise, widen
from crisalad_jax.nn.tokens import Tokens, local_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params

RATIO = 100
"""Of a patch's largest share to its second largest, at the start (the public implementations')."""


@params
class NetVlad:
    """The paper's decoupled parameters: how patches are shared out, and where they are seen from.

    The linear layer has no bias: the authors' code starts from the centroids' directions, which are
    all of one length, and so the paper's bias, -alpha |c|^2, is one for all clusters.
    """

    conv: Linear
    """Scores of a patch, one a cluster."""
    centroids: Float[Array, "cluster dim"]


def init(key: PRNGKeyArray, config: ModelConfig) -> NetVlad:
    """Start at random: centroids are unit vectors. `crisalad_jax.vocabulary` starts from images."""
    conv_key, centroid_key = jax.random.split(key)
    dim, clusters = config.backbone.dim, config.netvlad.clusters
    return NetVlad(
        conv=init_linear(conv_key, dim, clusters, bias=False),
        centroids=l2_normalise(jax.random.normal(centroid_key, (clusters, dim))),
    )


def from_centroids(
    centroids: Float[Array, "cluster dim"], features: Float[Array, "feature dim"]
) -> NetVlad:
    """Start as the authors do: scores are alpha times the cosines to the k-means centroids.

    alpha is such that of these features the largest share is `RATIO` times the second largest, in
    the mean of the logarithms.

    Args:
        centroids: of the features, two or more.
        features: unit vectors.

    Raises:
        InputError: all features are as near to two centroids, as where all are alike.
    """
    directions = l2_normalise(centroids)
    cosines = jnp.matmul(features, directions.T, precision="highest")
    best = jax.lax.top_k(cosines, 2)[0]
    gap = float((best[:, 0] - best[:, 1]).mean())
    # Below this the two are the same but for rounding.
    if not gap > 1e-6:
        raise InputError(
            f"features: found {len(features)} that are as near to two of {len(centroids)} "
            "centroids, expected features that differ"
        )
    return NetVlad(Linear(math.log(RATIO) / gap * directions.T, None), centroids)


def apply(
    params: NetVlad,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """A sum of residuals for each cluster, of length 1; no global token."""
    return local_alone(netvlad(params, features.patches))


def netvlad(
    params: NetVlad, patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch cluster dim"]:
    """The paper's Eq. 4 on unit patches, then intra-normalisation (Arandjelovic, Zisserman 2013).

    All in float32 at least, and as exact as the hardware is: what rounds scores is multiplied by
    alpha.
    """
    patches = l2_normalise(widen(patches))
    return l2_normalise(residual_sums(shares(params, patches), patches, params.centroids))


def shares(
    params: NetVlad, patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch patch cluster"]:
    """How each of unit patches is shared out: a softmax over the clusters (the paper's Eq. 3)."""
    scores = jnp.matmul(patches, params.conv.weight, precision="highest")
    return jax.nn.softmax(scores, axis=-1)


def residual_sums(
    shares: Float[Array, "*batch patch cluster"],
    patches: Float[Array, "*batch patch dim"],
    centroids: Float[Array, "cluster dim"],
) -> Float[Array, "*batch cluster dim"]:
    """For each cluster the sum of all patches' residuals from it, each times its share.

    That is the sum of the patches, less the centroid times the sum of the shares.
    """
    sums = jnp.einsum("...pk,...pd->...kd", shares, patches, precision="highest")
    return sums - shares.sum(axis=-2)[..., None] * centroids
