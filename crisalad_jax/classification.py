"""Classifiers that train beside a model and are no part of it: one for each group of classes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree


class Classifiers(NamedTuple):
    """Of all groups, as long as the largest, so that one program trains each of them."""

    weights: Float[Array, "group class descriptor"]
    """Rows beyond a group's classes take no part and never change."""
    optimiser: PyTree
    """Adam's state of each group by itself: one that rests while others train keeps its moments."""


def init_classifiers(
    key: PRNGKeyArray, classes: tuple[int, ...], dim: int, learning_rate: float
) -> Classifiers:
    """Random vectors for each group's classes (Glorot and Bengio 2010, uniform, as CosPlace's).

    Args:
        key: draws them.
        classes: how many each group has.
        dim: numbers in a descriptor.
        learning_rate: of `adam`.
    """
    shape = (len(classes), max(classes), dim)
    bounds = jnp.sqrt(6 / (jnp.asarray(classes, jnp.float32) + dim))
    weights = bounds[:, None, None] * jax.random.uniform(key, shape, jnp.float32, -1, 1)
    return Classifiers(weights, jax.vmap(adam(learning_rate).init)(weights))


def adam(learning_rate: float) -> optax.GradientTransformation:
    """Torch's Adam with its defaults (Kingma and Ba 2015)."""
    return optax.adam(learning_rate)


def updated(
    classifiers: Classifiers,
    group: Int[Array, ""],
    gradient: Float[Array, "class descriptor"],
    learning_rate: float,
) -> Classifiers:
    """A step of one group's optimiser; the others stay as they are."""
    mine = jax.tree.map(lambda leaf: leaf[group], classifiers)
    updates, optimiser = adam(learning_rate).update(gradient, mine.optimiser)
    stepped = Classifiers(mine.weights + updates, optimiser)
    return jax.tree.map(lambda all_, one: all_.at[group].set(one), classifiers, stepped)
