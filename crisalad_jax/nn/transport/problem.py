"""The entropic transport problem, in the log or scaling domain, and a plan's marginal errors."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.pytree import pytree_dataclass

SCALING_RANGE = 60
"""Bound on the difference of two scores of a row, divided by epsilon, in the scaling domain.

Below this bound sums are exact up to rounding: no sum is less than exp(-60), whatever the
potentials, and terms below exp(-87), which float32 flushes to zero, are too small to matter."""

LOG_ZERO = -1e5
"""Logarithm below which a mass counts as 0: no float format can represent exp(-1e5)."""
EMPTY = -1e30
"""Logarithm used for a mass of 0, and the potential of a row or column with that mass.

It is finite, so that differences and gradients are finite too, and so low that adding the potential
of another row or column does not change it."""


Matrix = Float[Array, "*batch rows columns"]
Rows = Float[Array, "*batch rows"]
Columns = Float[Array, "*batch columns"]


@brief
class Potentials(NamedTuple):
    """Dual variables divided by epsilon: the plan is exp(scores / epsilon + row + column)."""

    row: Rows
    column: Columns


@pytree_dataclass
class Problem:
    """Scores and marginals of entropic transport, with sums taken in the log domain.

    The last column is stored separately, because it is usually an appended dustbin. The compiler
    then need not write out the joined matrix, and the number of other columns can be a power of
    two.

    Attributes:
        clusters: scores divided by epsilon, without the last column.
        last: the last column of the scores divided by epsilon.
        log_mu: logarithms of the rows' masses (required sums); `EMPTY` for a mass of 0.
        log_nu: logarithms of the columns' masses, those of the last column included.
        taus: tau of the rows, and tau of the columns. None for sums that meet the marginals
            exactly; else an array (*batch, 1) below 1: a Kullback-Leibler penalty of weight
            epsilon * tau / (1 - tau) pulls sums to the marginals (Chizat et al., Math. Comp. 2018).

    Example:
        >>> problem = Problem.of(jnp.eye(2), jnp.zeros(2), jnp.zeros(2))
        >>> problem.lse_rows(jnp.zeros(2)).shape
        (2,)
    """

    clusters: Float[Array, "*batch rows clusters"]
    last: Rows
    log_mu: Rows
    log_nu: Float[Array, "*batch clusters+1"]
    taus: tuple[Array | None, Array | None] = (None, None)

    @classmethod
    def of(
        cls,
        kernel: Matrix,
        log_mu: Rows,
        log_nu: Columns,
        row_tau: float | Array = 1.0,
        column_tau: float | Array = 1.0,
    ) -> "Problem":
        """Make a problem from scores divided by epsilon, and the logarithms of the masses.

        The logarithm of a mass of 0 is -inf, or any value below -1e5. A tau of 1.0 makes sums meet
        their marginals exactly. As an array, a tau has one value, or the shape (*batch, 1) of
        `taus`.
        """
        one = (*kernel.shape[:-2], 1)

        def relaxed(tau: float | Array) -> Array | None:
            if isinstance(tau, float) and tau == 1:
                return None
            return jnp.broadcast_to(jnp.asarray(tau, kernel.dtype), one)

        log_mu, log_nu = (jnp.where(x < LOG_ZERO, EMPTY, x) for x in (log_mu, log_nu))
        # Split, not two slices: their gradients would be two zero-padded matrices to add up.
        clusters, last = jax.lax.split(kernel, (kernel.shape[-1] - 1, 1), axis=kernel.ndim - 1)
        return Problem(
            clusters, last[..., 0], log_mu, log_nu, (relaxed(row_tau), relaxed(column_tau))
        )

    @property
    def row_tau(self) -> float | Array:
        """Factor on updates of the row potentials: 1.0, or an array of shape (*batch, 1)."""
        return 1.0 if self.taus[0] is None else self.taus[0]

    @property
    def column_tau(self) -> float | Array:
        """Factor on updates of the column potentials; see `row_tau`."""
        return 1.0 if self.taus[1] is None else self.taus[1]

    @property
    def kernel(self) -> Matrix:
        """Scores divided by epsilon, with all columns."""
        return _joined(self.clusters, self.last)

    @property
    def balanced(self) -> bool:
        """Whether rows and columns both meet their marginals exactly at convergence."""
        return all(tau is None for tau in self.taus)

    @property
    def empty(self) -> tuple[Bool[Array, "*batch rows"], Bool[Array, "*batch columns"]]:
        """Which rows and which columns have no mass."""
        return self.log_mu < LOG_ZERO, self.log_nu < LOG_ZERO

    def masked(self, potentials: Potentials, value: float = EMPTY) -> Potentials:
        """Set the potentials of rows and columns without mass to `value`.

        The default, `EMPTY`, leaves these rows and columns out of every sum and plan.
        """
        pairs = zip(self.empty, potentials, strict=True)
        return Potentials(*(jnp.where(empty, value, x) for empty, x in pairs))

    def lse_columns(self, column: Columns) -> Rows:
        """Return the logarithm of each row's sum of exp(kernel + column)."""
        return jax.nn.logsumexp(self.kernel + column[..., None, :], axis=-1)

    def lse_rows(self, row: Rows) -> Columns:
        """Return the logarithm of each column's sum of exp(kernel + row)."""
        return jax.nn.logsumexp(self.kernel + row[..., :, None], axis=-2)

    def log_plan(self, potentials: Potentials) -> Matrix:
        """Return the logarithm of the plan with these potentials."""
        # If one side has no mass at all, the other's potentials must not make up for it.
        most = -EMPTY / 4
        row, column = (jnp.where((x > most) & (x < jnp.inf), most, x) for x in potentials)
        clusters = self.clusters + row[..., :, None] + column[..., None, :-1]
        return _joined(clusters, self.last + row + column[..., -1:])

    def zeros(self) -> Potentials:
        """Return potentials of 0, and of `EMPTY` for rows and columns without mass."""
        return self.masked(zero_potentials(self.kernel))


@pytree_dataclass
class ScalingProblem(Problem):
    """A problem in the scaling domain: exponentials once, then sums as matrix products.

    Attributes:
        row_max: each row's largest score, divided by epsilon.
        gibbs: exp(clusters - row_max).
        gibbs_last: exp(last - row_max).
        in_range: whether, in every row of the batch, the scores are close enough to each other for
            exact sums (`SCALING_RANGE`). If not, all sums are finite but wrong.
    """

    row_max: Rows = dataclasses.field(kw_only=True)
    gibbs: Float[Array, "*batch rows clusters"] = dataclasses.field(kw_only=True)
    gibbs_last: Rows = dataclasses.field(kw_only=True)
    in_range: Bool[Array, ""] = dataclasses.field(kw_only=True)

    @classmethod
    def scaled(cls, problem: Problem) -> "ScalingProblem":
        """Convert a problem to the scaling domain."""
        clusters, last = jax.lax.stop_gradient((problem.clusters, problem.last))
        row_max = jnp.maximum(clusters.max(axis=-1, initial=-jnp.inf), last)
        row_min = jnp.minimum(clusters.min(axis=-1, initial=jnp.inf), last)
        return cls(
            **{field.name: getattr(problem, field.name) for field in dataclasses.fields(Problem)},
            row_max=row_max,
            gibbs=jnp.exp(problem.clusters - row_max[..., None]),
            gibbs_last=jnp.exp(problem.last - row_max),
            in_range=(row_max - row_min).max(initial=0) < SCALING_RANGE,
        )

    def lse_columns(self, column: Columns) -> Rows:
        """Return the logarithm of each row's sum of exp(kernel + column)."""
        scaled, top = _exponentials(column)
        sums = product("...nk,...k->...n", self.gibbs, scaled[..., :-1])
        return self.row_max + self._log(sums + self.gibbs_last * scaled[..., -1:]) + top

    def lse_rows(self, row: Rows) -> Columns:
        """Return the logarithm of each column's sum of exp(kernel + row)."""
        scaled, top = _exponentials(row + self.row_max)
        sums = product("...nk,...n->...k", self.gibbs, scaled)
        last = (self.gibbs_last * scaled).sum(axis=-1, keepdims=True)
        return self._log(jnp.concatenate([sums, last], axis=-1)) + top

    def _log(self, sums: Array) -> Array:
        return jnp.log(jnp.where(self.in_range, sums, 1))


# HIGHEST: with the tensor cores' default of 10 bits the iteration does not converge.
product = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)


def zero_potentials(kernel: Matrix) -> Potentials:
    """Return potentials of 0 for the rows and columns of a kernel."""
    # Derive them from the kernel, so that under `shard_map` they vary over devices as it does.
    row = 0 * jax.lax.stop_gradient(kernel)[..., 0]
    return Potentials(row, jnp.repeat(row[..., :1], kernel.shape[-1], axis=-1))


def _joined(clusters: Array, last: Array) -> Array:
    return jnp.concatenate([clusters, last[..., None]], axis=-1)


def _exponentials(potential: Array) -> tuple[Array, Array]:
    """Return the exponentials of a potential minus its largest entry, and that entry."""
    top = jax.lax.stop_gradient(potential.max(axis=-1, keepdims=True))
    return jnp.exp(potential - top), top


def marginal_error(
    log_plan: Matrix,
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
    *,
    capacities: bool = False,
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Compute the largest relative errors of the row masses and of the column masses of a plan.

    Args:
        log_plan: logarithms of the plan's masses.
        log_mu: logarithms of the rows' marginals.
        log_nu: logarithms of the columns' marginals.
        capacities: whether columns may have less than their marginals; only excess is then an
            error.

    Returns:
        The largest |mass / marginal - 1| over the rows, and over the columns. Where a marginal is
        0, the error is 0 if the mass is 0 too, else infinite.

    Example:
        >>> import jax.numpy as jnp
        >>> log_plan, log_nu = jnp.log(jnp.eye(2)), jnp.log(jnp.full(2, 0.5))
        >>> rows, columns = marginal_error(log_plan, jnp.zeros(2), log_nu)
        >>> float(rows), float(columns)
        (0.0, 1.0)
    """
    rows = _excess(jax.nn.logsumexp(log_plan, axis=-1), log_mu)
    columns = _excess(jax.nn.logsumexp(log_plan, axis=-2), log_nu)
    columns = jnp.maximum(columns, 0) if capacities else jnp.abs(columns)
    return jnp.abs(rows).max(axis=-1), columns.max(axis=-1)


def _excess(log_mass: Array, log_marginal: Array) -> Array:
    empty = log_marginal < LOG_ZERO
    error = jnp.expm1(log_mass - jnp.where(empty, 0, log_marginal))
    return jnp.where(empty, jnp.where(log_mass < LOG_ZERO, 0, jnp.inf), error)
