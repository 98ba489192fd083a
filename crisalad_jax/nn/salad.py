"""SALAD: optimal-transport aggregation of patch features (Izquierdo and Civera, CVPR 2024)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import SaladConfig
from crisalad_jax.nn.layers import (
    Keys,
    Linear,
    dropout,
    init_linear,
    l2_normalise,
    linear,
    split_key,
    widen,
)
from crisalad_jax.nn.tokens import Tokens, TransportStatistics
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params
from crisalad_jax.sinkhorn import SinkhornResult, assign


@params
class TwoLayer:
    """A network of one hidden layer: linear, ReLU, linear."""

    fc1: Linear
    fc2: Linear


@params
class Salad:
    """The three networks over features, and the dustbin's score.

    The published constant dustbin score changes nothing: the transport absorbs it, as it does the
    bias of the score network's last layer. Both have gradient 0; public checkpoints hold them. What
    the dustbin does otherwise, `SinkhornConfig.dustbin` says.
    """

    token_features: TwoLayer
    cluster_features: TwoLayer
    score: TwoLayer
    dust_bin: Float[Array, ""] | None
    """Score or logit of mass; None where there is no dustbin, or the score network has a column
    more for it."""


def init_salad(key: PRNGKeyArray, dim: int, config: SaladConfig) -> Salad:
    """Start as the public implementation: torch's default linears, dustbin score 1.

    As a logit of mass, 1 is a share of 0.73; the published share at 224 x 224 is 0.75.
    """
    token_key, cluster_key, score_key = jax.random.split(key, 3)
    dustbin = config.sinkhorn.dustbin
    return Salad(
        token_features=_init_two_layer(token_key, dim, config.hidden, config.token_dim),
        cluster_features=_init_two_layer(cluster_key, dim, config.hidden, config.cluster_dim),
        score=_init_two_layer(score_key, dim, config.hidden, config.scores),
        dust_bin=None if dustbin in ("none", "token") else jnp.ones(()),
    )


def _init_two_layer(key: PRNGKeyArray, d_in: int, hidden: int, d_out: int) -> TwoLayer:
    first, second = jax.random.split(key)
    return TwoLayer(init_linear(first, d_in, hidden), init_linear(second, hidden, d_out))


def _two_layer(
    params: TwoLayer, x: Float[Array, "*batch d_in"], rate: float, key: Keys | None
) -> Float[Array, "*batch d_out"]:
    hidden = dropout(linear(params.fc1, x), rate, key=key)
    return linear(params.fc2, jax.nn.relu(hidden))


def transport(
    params: Salad,
    patches: Float[Array, "*batch patch dim"],
    config: SaladConfig,
    *,
    key: Keys | None,
) -> SinkhornResult:
    """Assignment of patches to clusters, dustbin last (paper Eqs. 3 to 5), in float32.

    Raises:
        InputError: no more patches than clusters.
    """
    scores = widen(_two_layer(params.score, patches, config.dropout, key))
    dustbin = params.dust_bin
    if config.sinkhorn.dustbin == "token":
        scores, dustbin = scores[..., :-1], scores[..., -1]
    return assign(scores, dustbin, config.sinkhorn)


def salad(params: Salad, features: Features, config: SaladConfig, *, key: Keys | None) -> Tokens:
    """Global token and cluster tokens (paper Eq. 6), each L2-normalised, in float32.

    Beside them is how the transport went, without a gradient.

    Of one image, or of a batch at once, which the transport does faster than `vmap` could: its
    choice of domain is one for all. `key` draws the dropout of the cluster and score networks, one
    for all or one an image; None means inference.

    Raises:
        InputError: no more patches than clusters.
    """
    cluster_key, score_key = split_key(key, 2)
    global_token = _two_layer(params.token_features, features.class_token, 0.0, None)
    local = _two_layer(params.cluster_features, features.patches, config.dropout, cluster_key)
    result = transport(params, features.patches, config, key=score_key)
    plan = jnp.exp(result.log_plan[..., : config.clusters])
    clusters = jnp.einsum("...nm,...nd->...md", plan, local.astype(plan.dtype))
    statistics = jax.lax.stop_gradient(_statistics(result, config.clusters))
    return Tokens(l2_normalise(widen(global_token)), l2_normalise(clusters), statistics)


def _statistics(result: SinkhornResult, clusters: int) -> TransportStatistics:
    mass = jnp.exp(result.log_plan)
    shares = jax.nn.log_softmax(result.log_plan[..., :clusters], axis=-2)
    entropy = -(jnp.exp(shares) * shares).sum(axis=-2)
    return TransportStatistics(
        result.column_error,
        mass[..., clusters:].sum(axis=(-2, -1)) / mass.sum(axis=(-2, -1)),
        jnp.exp(entropy).mean(axis=-1),
    )


def published_order(
    clusters: Float[Array, "cluster cluster_dim"],
) -> Float[Array, "cluster_dim cluster"]:
    """The order of public descriptors: all clusters' first dimension, then all their second."""
    return clusters.T
