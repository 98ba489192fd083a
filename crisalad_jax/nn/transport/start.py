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

        Steps update the column potentials first, from those of the rows, so return row potentials
        that fit the columns (`from_columns`). With the gradient "unrolled", gradients flow through
        the start. The gradient of a converged solution does not depend on the start.
        """


STARTS = Registry("start", Start)


def from_columns(problem: Problem, column: Columns) -> Potentials:
    """Complete column potentials with the row potentials that meet the rows' marginals.

    Args:
        problem: the transport problem.
        column: potentials of the columns.

    Returns:
        The potentials of rows and columns.

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
    """Start at zero potentials, as published."""

    def potentials(self, problem: Problem, params: Any) -> Potentials:
        """Return potentials of 0."""
        return problem.zeros()


@STARTS.register("gaussian")
class GaussianStart(Start):
    """Start at the potentials of two Gaussians, in closed form from the scores' second moments.

    Apart from row and column means, scores over epsilon are inner products <x_n, y_k> of vectors
    from their singular value decomposition. If x and y were Gaussian, the entropic plan would be
    too, with quadratic potentials (Janati et al., NeurIPS 2020; Thornton and Cuturi, AISTATS 2023,
    start from them). With column masses nu that sum to 1, mean_k the weighted mean score of column
    k, and G the matrix of weighted second moments of the centred columns, column k starts at log
    nu_k - mean_k - (sqrt(1 + 4 G) - 1)_kk / (4 nu_k). For small scores the last term is half a
    variance. It costs a product of the scores with themselves and an eigendecomposition.
    """

    def potentials(self, problem: Problem, params: Any) -> Potentials:
        """Return the guessed column potentials, and row potentials that fit them."""
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
    network takes the first potential, and the mean, standard deviation and maximum of its scores.
    Initially its output is 0. It learns only with the gradient "unrolled".
    """

    hidden: PositiveInt = 16
    """Width of the hidden layer."""

    def init_params(self, key: PRNGKeyArray) -> dict[str, Array]:
        """Draw the hidden layer at random; biases and the output layer start at 0."""
        return {
            "hidden": jax.random.normal(key, (4, self.hidden)) / 2,
            "bias": jnp.zeros(self.hidden),
            "out": jnp.zeros(self.hidden),
        }

    def potentials(self, problem: Problem, params: dict[str, Array]) -> Potentials:
        """Return the corrected column potentials, and row potentials that fit them."""
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
