"""SALAD: optimal-transport aggregation of patch features (Izquierdo and Civera, CVPR 2024)."""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require, require_fraction, require_positive
from crisalad_jax.config.part import OrName, non_semantic_field
from crisalad_jax.config.registry import part_field, resolve_names
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, FeatureRequest, Features
from crisalad_jax.nn.layers import (
    Keys,
    Linear,
    at_least_float32,
    dropout,
    init_linear,
    l2_normalise,
    linear,
    split_key,
)
from crisalad_jax.nn.tokens import Tokens, TransportStatistics
from crisalad_jax.sinkhorn import (
    DUSTBINS,
    Dustbin,
    SinkhornConfig,
    SinkhornResult,
    assign_with_dustbin,
)
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class TwoLayer:
    """A network of one hidden layer: linear, ReLU, linear."""

    fc1: Linear
    fc2: Linear


@pytree_dataclass
class Salad:
    """The three networks over features, and the transport's learnt parameters.

    The published constant dustbin score has no effect: the transport's potentials absorb it, and
    the bias of the score network's last layer too. Both have gradient 0, but public checkpoints
    hold them.
    """

    token_features: TwoLayer
    cluster_features: TwoLayer
    score: TwoLayer
    dust_bin: Any
    """Learnt parameters of the dustbin, by default its score."""
    log_epsilon: Float[Array, ""] | None = None
    """Logarithm of the entropic regularisation, where it is learnt."""
    step: Any = None
    """Learnt parameters of the transport's step."""


@AGGREGATORS.register(
    "salad",
    tiny={"clusters": 16, "cluster_dim": 32, "token_dim": 64, "hidden": 128, "dropout": 0.0},
)
@dataclasses.dataclass(frozen=True)
class SaladConfig(Aggregator):
    """SALAD aggregation (Izquierdo and Civera, CVPR 2024)."""

    dimension_first: ClassVar[bool] = True
    width_field: ClassVar[str] = "cluster_dim"
    clusters: int = 64
    cluster_dim: int = 128
    token_dim: int = 256
    """Width of the global token."""
    hidden: int = 512
    dropout: float = non_semantic_field(0.3)
    dustbin: OrName[Dustbin] = part_field(DUSTBINS, "column")
    """Registered dustbin, or its name; it takes the patches that belong to no cluster."""
    epsilon: float = 1.0
    """Entropic regularisation, by which scores are divided."""
    learn_epsilon: bool = False
    """Whether epsilon is learnt, from `epsilon` as its initial value."""
    row_tau: float = 1.0
    """1 fixes the patches' masses. Below 1 a Kullback-Leibler penalty of epsilon * tau / (1 - tau)
    draws them to their marginals. With both sides free, high scores make masses that overflow
    outside of logarithms."""
    column_tau: float = 1.0
    """The same as `row_tau` for the clusters' masses."""
    sinkhorn: SinkhornConfig = SinkhornConfig()
    """Solver of the transport."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        resolve_names(self)
        require_positive(self, "clusters", "cluster_dim", "token_dim", "hidden", "epsilon")
        require_fraction(self, "dropout")
        for name in ("row_tau", "column_tau"):
            value = getattr(self, name)
            require(
                0 < value <= 1,
                f"SaladConfig.{name}: found {value}, expected more than 0 and at most 1",
            )

    @property
    def scores(self) -> int:
        """Number of scores of a patch: one for each cluster, and the dustbin's."""
        return self.clusters + self.dustbin.scores

    def features(self, depth: int) -> FeatureRequest:
        """Request the last patches and the class token."""
        return FeatureRequest(class_token=True)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the tokens' shape, which does not depend on the backbone."""
        return TokenShape(self.token_dim, self.clusters, self.cluster_dim)

    def check_grid(self, grid: tuple[int, int], patch_size: int) -> None:
        """Require more patches than clusters, where the dustbin's mass is the difference."""
        if self.dustbin.takes_difference:
            require_more_patches(self.clusters, grid, patch_size)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> Salad:
        """Draw parameters as the public code: torch's default linears, dustbin score 1."""
        token_key, cluster_key, score_key = draw.split(key, 3)
        dim = backbone.dim
        return Salad(
            token_features=init_two_layer(token_key, dim, self.hidden, self.token_dim),
            cluster_features=init_two_layer(cluster_key, dim, self.hidden, self.cluster_dim),
            score=init_two_layer(score_key, dim, self.hidden, self.scores),
            # Start at 3: `split` may derive the keys above from 0 to 2.
            dust_bin=self.dustbin.init(draw.fold_in(key, 3), dim),
            log_epsilon=jnp.log(jnp.full((), self.epsilon)) if self.learn_epsilon else None,
            step=self.sinkhorn.step.init_params(draw.fold_in(key, 4)),
        )

    def transport(
        self, params: Salad, patches: Float[Array, "*batch patch dim"], *, key: Keys | None
    ) -> SinkhornResult:
        """Assign patches to clusters, dustbin last (paper Eqs. 3 to 5), in float32.

        Raises:
            InputError: no more patches than clusters.
        """
        scores = at_least_float32(two_layer(params.score, patches, self.dropout, key))
        learnt = params.log_epsilon
        return assign_with_dustbin(
            scores,
            params.dust_bin,
            self.dustbin,
            patches=at_least_float32(patches),
            epsilon=self.epsilon if learnt is None else jnp.exp(learnt),
            row_tau=self.row_tau,
            column_tau=self.column_tau,
            config=self.sinkhorn,
            step_params=params.step,
        )

    def apply(
        self, params: Salad, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return the global token and cluster tokens (paper Eq. 6), each L2-normalised, in float32.

        The tokens carry the transport's statistics, without a gradient. A whole batch is faster
        than `vmap`: the transport chooses the domain once for all images.

        Raises:
            InputError: no more patches than clusters.
        """
        cluster_key, score_key = split_key(key, 2)
        global_token = two_layer(params.token_features, features.class_token, 0.0, None)
        local = two_layer(params.cluster_features, features.patches, self.dropout, cluster_key)
        result = self.transport(params, features.patches, key=score_key)
        return transported_tokens(global_token, local, result, self.clusters)

    def plan(self, params: Salad, features: Features) -> Float[Array, "*batch patch column"]:
        """Return the mass that each patch sends to each cluster and to the dustbin."""
        return jnp.exp(self.transport(params, features.patches, key=None).log_plan)


def require_more_patches(clusters: int, grid: tuple[int, int], patch_size: int) -> None:
    """Check that there are more patches than clusters, as a dustbin of the difference needs.

    Raises:
        InputError: there are not.
    """
    patches = math.prod(grid)
    height, width = (patch_size * side for side in grid)
    side = patch_size * (math.isqrt(clusters) + 1)
    require(
        patches > clusters,
        f"image size: found {height} x {width}, which is {patches} patches for {clusters} "
        "clusters; expected more patches than clusters (the smallest square that works: "
        f"{side} x {side})",
    )


def init_two_layer(key: PRNGKeyArray, d_in: int, hidden: int, d_out: int) -> TwoLayer:
    """Draw a network of one hidden layer, each layer as torch's `nn.Linear`."""
    first, second = draw.split(key)
    return TwoLayer(init_linear(first, d_in, hidden), init_linear(second, hidden, d_out))


def two_layer(
    params: TwoLayer, x: Float[Array, "*batch d_in"], rate: float, key: Keys | None
) -> Float[Array, "*batch d_out"]:
    """Apply the network, with dropout of this rate before the ReLU where there is a key."""
    hidden = dropout(linear(params.fc1, x), rate, key=key)
    return linear(params.fc2, jax.nn.relu(hidden))


def transported_tokens(
    global_token: Float[Array, "*batch token"],
    local: Float[Array, "*batch patch dim"],
    result: SinkhornResult,
    clusters: int,
) -> Tokens:
    """Sum patches by the transport's plan to cluster tokens (paper Eq. 6); make all unit vectors.

    Args:
        global_token: before normalisation.
        local: features of every patch.
        result: the transport, whose columns after the first `clusters` are the dustbin's.
        clusters: number of clusters.

    Returns:
        The tokens in float32 at least, with the transport's statistics, without a gradient.
    """
    plan = jnp.exp(result.log_plan[..., :clusters])
    sums = jnp.einsum("...nm,...nd->...md", plan, local.astype(plan.dtype))
    statistics = jax.lax.stop_gradient(_statistics(result, clusters))
    return Tokens(l2_normalise(at_least_float32(global_token)), l2_normalise(sums), statistics)


def _statistics(result: SinkhornResult, clusters: int) -> TransportStatistics:
    mass = jnp.exp(result.log_plan)
    shares = jax.nn.log_softmax(result.log_plan[..., :clusters], axis=-2)
    # Leave out masses of 0, whose logarithm is not finite.
    weighted = jnp.where(shares > -jnp.inf, jnp.exp(shares) * shares, 0)
    entropy = -weighted.sum(axis=-2)
    return TransportStatistics(
        result.column_error,
        mass[..., clusters:].sum(axis=(-2, -1)) / mass.sum(axis=(-2, -1)),
        jnp.exp(entropy).mean(axis=-1),
    )
