"""Accelerate the potentials by Anderson's method (J. ACM 1965)."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from crisalad_jax.transport.problem import Potentials, product

_flat = functools.partial(jnp.concatenate, axis=-1)


class Memory(NamedTuple):
    """The results of the last steps, and their residuals (result minus start)."""

    start: Potentials
    """Potentials from which the next step starts."""
    images: Float[Array, "*batch memory size"]
    moves: Float[Array, "*batch memory size"]


def empty_memory(start: Potentials, size: int) -> Memory:
    """Return an empty memory with room for `size` iterations."""
    images = _flat(start)[..., None, :].repeat(size, axis=-2)
    # Moves of 0: those of a start that is not 0 would count in the weights of the first steps.
    return Memory(start, images, 0 * images)


def accelerate(memory: Memory, moved: Potentials, count: Int[Array, ""]) -> Memory:
    """Store a step, and start the next at the mixture of past results with the least residual.

    Args:
        memory: the steps before.
        moved: the potentials that the step made of `memory.start`.
        count: number of steps before this one.
    """
    image = _flat(moved)
    slots = memory.images.shape[-2]
    here = (jnp.arange(slots) == count % slots)[:, None]
    images = jnp.where(here, image[..., None, :], memory.images)
    moves = jnp.where(here, (image - _flat(memory.start))[..., None, :], memory.moves)
    gram = product("...ik,...jk->...ij", moves, moves)
    filled = (jnp.arange(slots) <= count).astype(gram.dtype)
    scale = jnp.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    # Stop its gradient: the weights do not depend on it, and at convergence its square is 0.
    scale = jax.lax.stop_gradient(jnp.maximum(scale, jnp.finfo(gram.dtype).tiny))
    # Rows and columns of the identity give empty slots a weight of 0.
    ridge = jnp.finfo(gram.dtype).eps * jnp.eye(slots, dtype=gram.dtype)
    gram = gram / scale + ridge + jnp.diag(1 - filled)
    ones = jnp.broadcast_to(filled, (*image.shape[:-1], slots))[..., None]
    weights = jnp.linalg.solve(gram, ones)[..., 0] * filled
    weights = weights / weights.sum(axis=-1, keepdims=True)
    mixed = product("...i,...ik->...k", weights, images)
    mixed = jnp.where(jnp.isfinite(mixed).all(axis=-1, keepdims=True), mixed, image)
    rows = moved.row.shape[-1]
    return Memory(Potentials(mixed[..., :rows], mixed[..., rows:]), images, moves)
