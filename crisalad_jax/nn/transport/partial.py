"""Partial transport: only a share of the patches' mass moves, and the dustbin takes the rest.

Entropic partial transport (Benamou et al., SIAM J. Sci. Comput. 2015) maximises, given scores S,
<P, S> + epsilon * entropy(P) over plans P between patches and clusters that move a given total
mass, and never exceed the mass of a patch or cluster. P is exp(kernel + row + column), where row
potentials are at most 0, and column potentials at most a level shared by all clusters, at which the
total is met.
"""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.config.checks import require_field
from crisalad_jax.nn.transport.dustbin import (
    DUSTBINS,
    Dustbin,
    Marginals,
    append_dustbin,
    check_params,
)
from crisalad_jax.nn.transport.problem import EMPTY, Columns, Matrix, Potentials, Problem
from crisalad_jax.nn.transport.steps import STEPS, Moved, Step


@DUSTBINS.register("partial")
class PartialDustbin(Dustbin):
    """The mass that partial transport leaves in the patches; it has no score.

    A share of the patches' mass moves to the clusters, each of which takes at most `room` times an
    equal part of that share. Use it with the step "partial".

    Example:
        >>> from crisalad_jax.sinkhorn import PartialDustbin, SinkhornConfig, assign_with_dustbin
        >>> config = SinkhornConfig(step="partial", iterations=20)
        >>> result = assign_with_dustbin(jnp.eye(8, 2), None, PartialDustbin(0.25), config=config)
        >>> [round(float(mass), 2) for mass in jnp.exp(result.log_plan).sum(axis=0)]
        [1.0, 1.0, 6.0]
    """

    capacities: ClassVar[bool] = True
    share: float = 0.25
    """Share of the patches' mass that moves, between 0 and 1; SALAD's at 224 x 224 is 0.25."""
    learn: bool = False
    """Whether the share is learnt, through a sigmoid, from `share` as its initial value."""
    room: float = 2.0
    """Largest mass of a cluster, relative to an equal part of what moves; 1 makes all equal."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_field(self, "share", 0 < self.share < 1, "more than 0 and less than 1")
        require_field(self, "room", 1 <= self.room < math.inf, "at least 1")

    def init(self, key: PRNGKeyArray, dim: int) -> Array | None:
        """Return the logit of `share`; None if it is not learnt."""
        return jnp.full((), self._logit, jnp.float32) if self.learn else None

    @property
    def _logit(self) -> float:
        return math.log(self.share / (1 - self.share))

    def marginals(self, params: Any, scores: Array, patches: Array | None) -> Marginals:
        """Append a column of zeros; `params` is the share's logit, or None for `share`."""
        rows, clusters = scores.shape[-2:]
        logit = check_params(self._logit if params is None else params)
        moved, kept = jax.nn.log_sigmoid(jnp.stack([logit, -logit])).astype(scores.dtype)
        most = jnp.broadcast_to(moved + math.log(self.room * rows / clusters), clusters)
        log_nu = jnp.append(most, kept + math.log(rows))
        return Marginals(append_dustbin(scores, 0.0), jnp.zeros(rows, scores.dtype), log_nu)


@STEPS.register("partial")
class PartialStep(Step):
    """Step that moves all mass but the last column's marginal, within the other columns' marginals.

    The last column of the plan is what patches keep; its scores have no effect. An iteration solves
    for the columns and the level that bounds their potentials, then for the rows. So the moved
    total is met at convergence, and patches give at most their mass after every iteration.
    """

    capacities: ClassVar[bool] = True

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Fill the columns to one level, then lower the rows that give more than they have."""
        sums, log_nu = problem.lse_rows(potentials.row)[..., :-1], problem.log_nu[..., :-1]
        moved = jnp.exp(problem.log_mu).sum(axis=-1) - jnp.exp(problem.log_nu[..., -1])
        clusters = _fill(sums, log_nu, moved)
        last = jnp.zeros_like(clusters[..., :1])
        row = problem.log_mu - problem.lse_columns(jnp.append(clusters, last + EMPTY, axis=-1))
        column = jnp.append(clusters, last, axis=-1)
        return Potentials(jnp.where(row < 0, row, 0), column), state

    def log_plan(self, problem: Problem, potentials: Potentials) -> Matrix:
        """Return logarithms of what each patch moves and, in the last column, of what it keeps."""
        moved = problem.log_plan(potentials)[..., :-1]
        share = jax.nn.logsumexp(moved, axis=-1) - problem.log_mu
        # Rows that give all have a negative potential; what rounding leaves of them is dropped.
        some = (potentials.row >= 0) & (share < -jnp.finfo(share.dtype).eps)
        kept = problem.log_mu + jnp.log(-jnp.expm1(jnp.where(some, share, -1)))
        return jnp.concatenate([moved, jnp.where(some, kept, EMPTY)[..., None]], axis=-1)


def _fill(sums: Columns, log_nu: Columns, total: Float[Array, "*batch"]) -> Columns:
    """Return potentials that give the columns a total mass, each at most its own.

    Columns that are not full share one potential, the level. The columns' masses are
    exp(potential + sums).

    Args:
        sums: logarithm of each column's mass at a potential of 0.
        log_nu: logarithm of each column's largest mass.
        total: mass to give to all columns together; columns that cannot hold it are all full.
    """
    at = log_nu - sums  # the level at which a column is full
    full = jax.lax.stop_gradient(_full(sums, log_nu, total))
    rest = total - jnp.where(full, jnp.exp(log_nu), 0).sum(axis=-1)
    level = _log(rest) - jax.nn.logsumexp(jnp.where(full, EMPTY, sums), axis=-1)
    return jnp.where(full, at, jnp.minimum(level[..., None], at))


def _full(
    sums: Columns, log_nu: Columns, total: Float[Array, "*batch"]
) -> Bool[Array, "*batch columns"]:
    """Return which columns are full: those that fill up first, all but one at most."""
    order = jnp.argsort(log_nu - sums, axis=-1)
    sums, log_nu = (jnp.take_along_axis(x, order, axis=-1) for x in (sums, log_nu))
    masses = jnp.exp(log_nu)
    rest = total[..., None] - (jnp.cumsum(masses, axis=-1) - masses)
    level = _log(rest) - jax.lax.cumlogsumexp(sums, axis=sums.ndim - 1, reverse=True)
    filled = (level >= log_nu - sums)[..., :-1]
    count = jnp.cumprod(filled, axis=-1).sum(axis=-1, keepdims=True)
    return jnp.argsort(order, axis=-1) < count


def _log(mass: Array) -> Array:
    return jnp.log(jnp.maximum(mass, jnp.finfo(mass.dtype).tiny))
