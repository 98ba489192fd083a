"""SALAD (Izquierdo and Civera, CVPR 2024) and FoL (Wang et al., AAAI 2025): optimal transport."""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import Fraction, PositiveFloat, PositiveInt, require, require_field
from crisalad_jax.config.part import OrName, non_semantic_field
from crisalad_jax.config.registry import part_field, resolve_names
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, FlattenOrder, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid
from crisalad_jax.nn.layers import (
    Conv,
    Keys,
    TwoLayer,
    at_least_float32,
    init_transposed_conv,
    init_two_layer,
    l2_normalise,
    split_key,
    two_layer,
)
from crisalad_jax.nn.tokens import Tokens, TransportStatistics
from crisalad_jax.nn.transport.config import SinkhornConfig
from crisalad_jax.nn.transport.dustbin import DUSTBINS, Dustbin, TokenDustbin
from crisalad_jax.nn.transport.solve import SinkhornResult, assign_with_dustbin
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class Salad:
    """The three networks over features, and the transport's learnt parameters.

    The published constant dustbin score has no effect: the transport's potentials absorb it, and
    also the bias of the score network's last layer. Score and bias have gradient 0, but are here
    because public checkpoints contain them.
    """

    token_features: TwoLayer
    cluster_features: TwoLayer
    score: TwoLayer
    dust_bin: Any
    """Learnt parameters of the dustbin: for the default dustbin, its score."""
    log_epsilon: Float[Array, ""] | None = None
    """Logarithm of the entropic regularisation; None if it is not learnt."""
    step: Any = None
    """Learnt parameters of the solver's step; None if it has none."""
    start: Any = None
    """Learnt parameters of the solver's start; None if it has none."""
    logit_tau: dict[str, Float[Array, ""]] | None = None
    """Logits of `row_tau` and `column_tau`, by name; None if they are not learnt."""


_TINY = {"clusters": 16, "cluster_dim": 32, "token_dim": 64, "hidden": 128, "dropout": 0.0}


@AGGREGATORS.register("salad", tiny=_TINY)
class SaladConfig(Aggregator):
    """SALAD aggregation (Izquierdo and Civera, CVPR 2024).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator=SaladConfig(clusters=32)).descriptor_dim
        4352
    """

    class_token: ClassVar[bool] = True
    flatten_order: ClassVar[FlattenOrder] = "dimension-first"
    clusters: PositiveInt = 64
    cluster_dim: PositiveInt = 128
    token_dim: PositiveInt = 256
    """Width of the global token."""
    hidden: PositiveInt = 512
    dropout: Fraction = non_semantic_field(0.3)
    dustbin: OrName[Dustbin] = part_field(DUSTBINS, "column")
    """Registered dustbin, or its name; it takes the patches that belong to no cluster."""
    epsilon: PositiveFloat = 1.0
    """Entropic regularisation; scores are divided by it."""
    learn_epsilon: bool = False
    """Whether epsilon is learnt, with `epsilon` as initial value."""
    row_tau: float = 1.0
    """How closely each patch keeps to its mass of 1: exactly if 1; if below 1, only through a
    Kullback-Leibler penalty of weight epsilon * tau / (1 - tau). If `column_tau` is below 1 too,
    high scores can make masses overflow."""
    column_tau: float = 1.0
    """The same as `row_tau`, for the masses of the clusters and the dustbin."""
    learn_tau: bool = False
    """Whether `row_tau` and `column_tau` are learnt, through a sigmoid; a tau of 1 stays fixed."""
    sinkhorn: SinkhornConfig = SinkhornConfig()
    """Solver of the transport problem."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        resolve_names(self)
        for name, tau in self._taus.items():
            require_field(self, name, 0 < tau <= 1, "more than 0 and at most 1")
        relaxed = min(self._taus.values()) < 1
        expected = "a row_tau or column_tau below 1"
        require_field(self, "learn_tau", relaxed or not self.learn_tau, expected)

    @property
    def scores(self) -> int:
        """Number of scores that the network gives a patch: one per cluster, and the dustbin's."""
        return self.clusters + self.dustbin.scores

    def check_grid(self, grid: Grid, patch_size: int) -> None:
        """Raise InputError if the grid has fewer patches than clusters and dustbin need."""
        patches = math.prod(grid)
        height, width = (patch_size * side for side in grid)
        side = patch_size * (math.isqrt(self.clusters) + 1)
        require(
            patches > self.clusters or not self.dustbin.takes_difference,
            f"image size: found {height} x {width}, which is {patches} patches for {self.clusters} "
            "clusters; expected more patches than clusters (the smallest square that works: "
            f"{side} x {side})",
        )

    def token_shape(self, dim: int) -> TokenShape:
        """Return the tokens' shape, which does not depend on the backbone."""
        return TokenShape(self.token_dim, self.clusters, self.cluster_dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Salad:
        """Draw parameters as the public code does: `nn.Linear` layers, and a dustbin score of 1."""
        token_key, cluster_key, score_key = random_init.split(key, 3)
        dim, hidden = backbone.dim, self.hidden
        below = {name: tau for name, tau in self._taus.items() if tau < 1}
        logits = {name: jnp.full((), math.log(tau / (1 - tau))) for name, tau in below.items()}
        return Salad(
            token_features=init_two_layer(token_key, dim, hidden, self.token_dim),
            cluster_features=init_two_layer(cluster_key, dim, hidden, self.cluster_dim),
            score=init_two_layer(score_key, dim, hidden, self.scores),
            # Start at 3: `split` may derive the keys above from 0 to 2.
            dust_bin=self.dustbin.init(jax.random.fold_in(key, 3), dim),
            log_epsilon=jnp.log(jnp.full((), self.epsilon)) if self.learn_epsilon else None,
            step=self.sinkhorn.step.init_params(jax.random.fold_in(key, 4)),
            start=self.sinkhorn.start.init_params(jax.random.fold_in(key, 5)),
            logit_tau=logits if self.learn_tau else None,
        )

    @property
    def _taus(self) -> dict[str, Any]:
        return {"row_tau": self.row_tau, "column_tau": self.column_tau}

    def dustbin_params(self, params: Any, features: Features) -> Any:
        """Return the dustbin's parameters for an image; by default the learnt ones."""
        return params.dust_bin

    def transport(self, params: Any, features: Features, *, key: Keys) -> SinkhornResult:
        """Solve the transport (SALAD's Eqs. 3 to 5), in at least float32; the dustbin comes last.

        Raises:
            InputError: the dustbin needs more patches than clusters, and there are too few.
        """
        patches, learnt = features.patches, params.log_epsilon
        scores = at_least_float32(two_layer(params.score, patches, self.dropout, key))
        return assign_with_dustbin(
            scores,
            self.dustbin_params(params, features),
            self.dustbin,
            patches=at_least_float32(patches),
            epsilon=self.epsilon if learnt is None else jnp.exp(learnt),
            **self._taus | jax.tree.map(jax.nn.sigmoid, params.logit_tau or {}),
            config=self.sinkhorn,
            step_params=params.step,
            start_params=params.start,
        )

    def apply(self, params: Any, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return global and cluster tokens (paper Eq. 6), each L2-normalised, in at least float32.

        The tokens include the transport's statistics, without gradients. Pass images as a batch:
        under `vmap`, the transport would be computed in both its domains (scaling and log).

        Raises:
            InputError: the dustbin needs more patches than clusters, and there are too few.
        """
        cluster_key, score_key = split_key(key, 2)
        global_token = two_layer(params.token_features, features.class_token, 0.0, None)
        local = two_layer(params.cluster_features, features.patches, self.dropout, cluster_key)
        result = self.transport(params, features, key=score_key)
        plan = jnp.exp(result.log_plan[..., : self.clusters])
        sums = jnp.einsum("...nm,...nd->...md", plan, local.astype(plan.dtype))
        statistics = jax.lax.stop_gradient(_statistics(result, self.clusters))
        return Tokens(l2_normalise(at_least_float32(global_token)), l2_normalise(sums), statistics)

    def plan(self, params: Any, features: Features) -> Float[Array, "*batch patch column"]:
        """Return the mass that each patch sends to each cluster and, last, to the dustbin."""
        return jnp.exp(self.transport(params, features, key=None).log_plan)


LEAST_ATTENTION = 0.01
"""Attention below which a patch counts as unseen by the class token, as published."""


@pytree_dataclass
class Fol(Salad):
    """SALAD's parameters, and two transposed convolutions of 3 x 3 for local features."""

    upconv1: Conv = dataclasses.field(kw_only=True)
    """First of the convolutions that compute local features, only for re-ranking."""
    upconv2: Conv = dataclasses.field(kw_only=True)


@AGGREGATORS.register("fol", tiny={**_TINY, "local_hidden": 32, "local": 16})
class FolConfig(SaladConfig):
    """FoL's global descriptor: SALAD with dustbin scores from attention (Wang et al., AAAI 2025).

    Written from the paper, with the constants of the public model.

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator="fol", cross_image="none").descriptor_dim
        8448
    """

    dustbin: ClassVar[Dustbin] = TokenDustbin()  # pyright: ignore[reportIncompatibleVariableOverride]
    local_hidden: PositiveInt = 256
    """Number of channels between the transposed convolutions."""
    local: PositiveInt = 128
    """Width of a local feature."""

    @property
    def scores(self) -> int:
        """Number of scores from the network: one per cluster. Attention gives the dustbin's."""
        return self.clusters

    def features(self, depth: int) -> FeatureSpec:
        """Request the last block's patches, the class token and its attention."""
        return FeatureSpec(class_token=True, class_attention=True)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Fol:
        """Draw parameters as the public code does: torch's default layers."""
        *_, first, second = random_init.split(key, 5)
        return Fol(
            **vars(super().init(key, backbone, grid)),
            upconv1=init_transposed_conv(first, 3, backbone.dim, self.local_hidden),
            upconv2=init_transposed_conv(second, 3, self.local_hidden, self.local),
        )

    def dustbin_params(self, params: Fol, features: Features) -> Float[Array, "*batch patch"]:
        """Return a score for each patch: 1 minus the class token's attention to it.

        Attention below `LEAST_ATTENTION` counts as 0.
        """
        attention = features.class_attention
        assert attention is not None
        return 1 - jnp.where(attention >= LEAST_ATTENTION, attention, 0)


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
