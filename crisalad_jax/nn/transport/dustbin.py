"""Dustbins, which take the patches that belong to no cluster, and their marginals.

`marginals` sets the mass of a dustbin: for "column" and "token", what the clusters leave (see
`log_marginals`); for "row and column", that of all patches; for "mass", a learnt share. The mass is
separate from the score that the dustbin appends.
"""

import math
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.transport.problem import Matrix, Rows


@brief
class Marginals(NamedTuple):
    """Scores that include the dustbin, and the masses of rows and columns."""

    scores: Matrix
    log_mu: Float[Array, "*#batch rows"]
    log_nu: Float[Array, "*#batch columns"]


class Dustbin(Part):
    """Base class of dustbins, which take the patches that belong to no cluster.

    The plan's first rows are the patches, and its first columns the clusters. A dustbin appends its
    row or column after them.
    """

    scores: ClassVar[int] = 0
    """Number of dustbin scores that the score network gives each patch, after the clusters'."""
    takes_difference: ClassVar[bool] = False
    """Whether its mass is the number of patches minus that of clusters, which must be positive."""
    capacities: ClassVar[bool] = False
    """Whether its clusters may take less than their marginals, which not every step supports."""

    def init(self, key: PRNGKeyArray, dim: int) -> Any:
        """Return the initial parameters, a pytree of arrays; by default None.

        Args:
            key: random key.
            dim: width of a patch's features.
        """
        return None

    def marginals(
        self,
        params: Any,
        scores: Float[Array, "*batch patches clusters"],
        patches: Float[Array, "*batch patches dim"] | None,
    ) -> Marginals:
        """Return the scores that include the dustbin, and all masses.

        Args:
            params: the learnt parameters, or an array of the shape that the dustbin expects.
            scores: scores of each patch for each cluster, in at least float32.
            patches: the patches' features; None outside of a model.
        """
        raise NotImplementedError


DUSTBINS = Registry("dustbin", Dustbin)


def check_params(params: Any, *shape: int) -> Array:
    """Return a dustbin's parameters as an array; raise InputError if its shape is not `shape`."""
    found = jnp.shape(params) if params is not None else None
    require(found == shape, f"dustbin: found parameters of shape {found}, expected {shape}")
    return jnp.asarray(params)


@DUSTBINS.register("none")
class NoDustbin(Dustbin):
    """No dustbin: the clusters share the patches' mass equally."""

    def marginals(self, params: Any, scores: Array, patches: Array | None) -> Marginals:
        """Return the scores unchanged; each cluster has the same mass."""
        rows, clusters = scores.shape[-2:]
        log_nu = jnp.full(clusters, math.log(rows / clusters), scores.dtype)
        return Marginals(scores, jnp.zeros(rows, scores.dtype), log_nu)


class ScalarDustbin(Dustbin):
    """Base class of dustbins with one learnt scalar."""

    def init(self, key: PRNGKeyArray, dim: int) -> Array:
        """Return 1: the score of the public implementation, or a logit whose share is 0.73."""
        return jnp.ones(())


@DUSTBINS.register("column")
class ColumnDustbin(ScalarDustbin):
    """A column with one learnt score, as published; the score has no effect on plain iterations."""

    takes_difference: ClassVar[bool] = True

    def marginals(self, params: Any, scores: Array, patches: Array | None) -> Marginals:
        """Append a column with the score."""
        return _with_column(scores, check_params(params))


@DUSTBINS.register("row and column")
class RowAndColumnDustbin(ScalarDustbin):
    """A row and a column with one learnt score, as in SuperGlue (Sarlin et al., CVPR 2020)."""

    def marginals(self, params: Any, scores: Array, patches: Array | None) -> Marginals:
        """Append the column, then the row."""
        rows, clusters = scores.shape[-2:]
        score = check_params(params).astype(scores.dtype)
        full = append_dustbin(scores, score)
        last = jnp.broadcast_to(score, (*full.shape[:-2], 1, clusters + 1))
        log_mu = jnp.append(jnp.zeros(rows, full.dtype), math.log(clusters))
        log_nu = jnp.zeros(clusters + 1, full.dtype).at[-1].set(math.log(rows))
        return Marginals(jnp.concatenate([full, last], axis=-2), log_mu, log_nu)


@DUSTBINS.register("token")
class TokenDustbin(Dustbin):
    """A dustbin score for each patch, from the score network."""

    scores: ClassVar[int] = 1
    takes_difference: ClassVar[bool] = True

    def marginals(self, params: Any, scores: Array, patches: Array | None) -> Marginals:
        """Use `params`, one score per patch, as the dustbin's; if None, each patch's last score."""
        if params is None:
            scores, params = scores[..., :-1], scores[..., -1]
        return _with_column(scores, check_params(params, *scores.shape[:-1]))


@DUSTBINS.register("mass")
class MassDustbin(ScalarDustbin):
    """A column with a learnt mass, sigmoid(logit) of all mass; clusters share the rest equally.

    The initial share is 0.73; that of published SALAD at 224 x 224 is 0.75.
    """

    def marginals(self, params: Any, scores: Array, patches: Array | None) -> Marginals:
        """Append a column of zero scores; `params` is the logit of its share."""
        rows, clusters = scores.shape[-2:]
        logit = check_params(params)
        share = jax.nn.log_sigmoid(jnp.stack([-logit, logit])).astype(scores.dtype) + math.log(rows)
        log_nu = jnp.append(jnp.broadcast_to(share[0] - math.log(clusters), clusters), share[1])
        full = append_dustbin(scores, jnp.zeros_like(logit))
        return Marginals(full, jnp.zeros(rows, scores.dtype), log_nu)


def _with_column(scores: Array, column: Array) -> Marginals:
    log_mu, log_nu = log_marginals(*scores.shape[-2:], dtype=scores.dtype)
    return Marginals(append_dustbin(scores, column), log_mu, log_nu)


def append_dustbin(
    scores: Float[Array, "*batch rows clusters"], dustbin: float | Float[Array, ""] | Rows
) -> Float[Array, "*batch rows clusters+1"]:
    """Append a column of the dustbin's score to the scores (paper Eq. 4).

    Args:
        scores: scores of each row for each cluster.
        dustbin: one score for all rows, or one per row.

    Returns:
        The scores with one more column.

    Example:
        >>> import jax.numpy as jnp
        >>> append_dustbin(jnp.zeros((2, 1)), 1.0).tolist()
        [[0.0, 1.0], [0.0, 1.0]]
    """
    column = jnp.asarray(dustbin).astype(scores.dtype)
    column = jnp.broadcast_to(column[..., None] if column.ndim else column, (*scores.shape[:-1], 1))
    return jnp.concatenate([scores, column], axis=-1)


def log_marginals(
    rows: int, clusters: int, dtype: DTypeLike = jnp.float32
) -> tuple[Float[Array, " {rows}"], Float[Array, " {clusters}+1"]]:
    """Compute SALAD's marginals: each row has mass 1, each cluster 1, the dustbin the rest.

    Args:
        rows: number of patches.
        clusters: number of clusters, without the dustbin.
        dtype: type of the result.

    Returns:
        Logarithms of the rows' masses, and of the columns', the dustbin last.

    Raises:
        InputError: the dustbin's mass, `rows - clusters`, is not positive.

    Example:
        >>> [x.tolist() for x in log_marginals(3, 2)]
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    require(
        rows > clusters,
        f"transport: found {rows} patches for {clusters} clusters, expected more patches than "
        "clusters: the dustbin's mass is their difference",
    )
    log_mu = jnp.zeros(rows, dtype)
    log_nu = jnp.zeros(clusters + 1, dtype).at[-1].set(math.log(rows - clusters))
    return log_mu, log_nu
