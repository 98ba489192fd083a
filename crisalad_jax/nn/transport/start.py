"""Where a solver starts: at zeros, at a Gaussian guess, or at the output of a small network."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.nn.transport.problem import Columns, Potentials, Problem, product


class Start(Part, abc.ABC):
    """Base class of starts: the potentials from which the iterations of any step begin.

    Example:
        >>> from crisalad_jax.sinkhorn import SinkhornConfig, register_start, solve
        >>> @register_start("softmax-rows")
        ... class SoftmaxRows(Start):
        ...     def potentials(self, problem, params):
        ...         return from_columns(problem, problem.zeros().column)
        >>> config = SinkhornConfig(start="softmax-rows", iterations=1)
        >>> float(solve(jnp.eye(2), jnp.zeros(2), jnp.zeros(2), config=config).column_error)
        0.0
    """

    def init_params(self, key: PRNGKeyArray) -> Any:
        """Return the start's initial parameters, a pytree of arrays; by default None."""
        return None

    @abc.abstractmethod
    def potentials(self, problem: Problem, params: Any) -> Potentials:
        """Return the potentials of rows and columns to start from.

        Steps update the columns first, from the rows: return rows that fit the columns
        (`from_columns`). The gradient "unrolled" flows through the start; that of a converged
        solution does not depend on it.
        """


STARTS = Registry("start", Start)


def from_columns(problem: Problem, column: Columns) -> Potentials:
    """Complete potentials of the columns with those of rows that meet their marginals.

    Args:
        problem: the transport problem.
        column: potentials of the columns.

    Returns:
        The potentials of both.

    Example:
        >>> problem = Problem.of(jnp.eye(2), jnp.zeros(2), jnp.zeros(2))
        >>> start = from_columns(problem, jnp.zeros(2))
        >>> jnp.exp(problem.log_plan(start)).sum(axis=1).tolist()
        [1.0, 1.0]
    """
    _, column = problem.masked(Potentials(problem.log_mu, column))
    return Potentials(problem.row_tau * (problem.log_mu - problem.lse_columns(column)), column)


@STARTS.register("zeros")
class ZeroStart(Start):
    """Start at zeros, as published."""

    def potentials(self, problem: Problem, params: Any) -> Potentials:
        """Return zeros."""
        return problem.zeros()


@STARTS.register("gaussian")
class GaussianStart(Start):
    """Start at the potentials of two Gaussians, in closed form from the scores' spectrum.

    Up to row and column means, scores are inner products <x_n, y_k> of vectors from their singular
    value decomposition. If x and y were Gaussian, the entropic plan would be too, with quadratic
    potentials (Janati et al., NeurIPS 2020; Thornton and Cuturi, AISTATS 2023, start from them).
    With masses that sum to 1, and G the columns' weighted second moments of the scores, the
    columns' potential is log nu - mean - (sqrt(1 + 4 G) - 1)_kk / (4 nu_k); for small scores the
    last term is half a variance. It costs a product of the scores with themselves and an
    eigendecomposition.
    """

    def potentials(self, problem: Problem, params: Any) -> Potentials:
        """Return the guess for the columns, and the rows that fit it."""
        kernel = problem.kernel
        rows, columns = (jax.nn.softmax(x, axis=-1) for x in (problem.log_mu, problem.log_nu))
        mean = product("...n,...nk->...k", rows, kernel)
        off = kernel - mean[..., None, :]
        off = off - product("...k,...nk->...n", columns, off)[..., None]
        moments = product("...n,...nk,...nl->...kl", rows, off, off)
        some = jnp.sqrt(jnp.maximum(columns, jnp.finfo(columns.dtype).tiny))
        moments = moments * some[..., None] * some[..., None, :]
        bend = jnp.diagonal(_root(moments), axis1=-2, axis2=-1) - 1
        # By concavity, at most this column's correction without the others, even at small mass.
        guess = problem.log_nu - mean - bend / (4 * some**2)
        return from_columns(problem, guess)


@jax.custom_jvp
def _root(moments: Array) -> Array:
    """Return the square root of 1 + 4 times a positive semidefinite matrix."""
    values, vectors = jnp.linalg.eigh(moments)
    roots = jnp.sqrt(1 + 4 * jnp.maximum(values, 0))
    return product("...ij,...j,...kj->...ik", vectors, roots, vectors)


@_root.defjvp
def _root_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Solve X dX + dX X = 4 dG, even for equal eigenvalues: roots are at least 1."""
    (moments,), (change,) = primals, tangents
    values, vectors = jnp.linalg.eigh(moments)
    roots = jnp.sqrt(1 + 4 * jnp.maximum(values, 0))
    inner = 4 * product("...ji,...jk,...kl->...il", vectors, change, vectors)
    inner = inner / (roots[..., None] + roots[..., None, :])
    return _root(moments), product("...ij,...jk,...lk->...il", vectors, inner, vectors)


@STARTS.register("network")
class NetworkStart(Start):
    """Start at Sinkhorn's first column potentials, plus a small network's output for each column.

    Learnt starts are from Amos et al. (Meta optimal transport, ICML 2023). For each column, the
    network gets the first potential, and the mean, deviation and maximum of its scores; initially
    it adds 0. It learns only with the gradient "unrolled".
    """

    hidden: PositiveInt = 16
    """Width of the hidden layer."""

    def init_params(self, key: PRNGKeyArray) -> dict[str, Array]:
        """Draw the hidden layer; the output layer starts at 0."""
        return {
            "hidden": jax.random.normal(key, (4, self.hidden)) / 2,
            "bias": jnp.zeros(self.hidden),
            "out": jnp.zeros(self.hidden),
        }

    def potentials(self, problem: Problem, params: dict[str, Array]) -> Potentials:
        """Return the corrected columns, and the rows that fit them."""
        kernel, (row, _) = problem.kernel, problem.zeros()
        first = problem.column_tau * (problem.log_nu - problem.lse_rows(row))
        rows = jax.nn.softmax(problem.log_mu, axis=-1)
        mean = product("...n,...nk->...k", rows, kernel)
        variance = product("...n,...nk->...k", rows, (kernel - mean[..., None, :]) ** 2)
        # The floor is for constant columns, whose deviation has no gradient.
        deviation = jnp.sqrt(variance + jnp.finfo(kernel.dtype).eps)
        inputs = jnp.stack([first, mean, deviation, kernel.max(axis=-2)], axis=-1)
        _, empty = problem.empty
        hidden = jnp.tanh(
            jnp.where(empty[..., None], 0, inputs) @ params["hidden"] + params["bias"]
        )
        return from_columns(problem, first + hidden @ params["out"])
