"""The parameters that belong to a loss, per group of classes; they train with the model."""

import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PRNGKeyArray, PyTree

from crisalad_jax.checkpoints.weights import read_weights
from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.io import from_plain
from crisalad_jax.nn.model import tree_of
from crisalad_jax.training.losses import Loss, LossConfig
from crisalad_jax.utils import compiler
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import check_drawn


class Classifiers(NamedTuple):
    """A loss's parameters for all groups, padded to the largest, so that one program trains any."""

    weights: PyTree
    """Parameters, with a leading axis of groups. Padding beyond a group's classes never changes."""
    optimiser: PyTree
    """Adam's state for each group; it does not change while other groups train."""


def init_classifiers(
    key: PRNGKeyArray | None, loss: Loss, classes: tuple[int, ...], dim: int
) -> Classifiers | None:
    """Initialise a loss's parameters for each group; return None if it has none.

    Args:
        key: random key; None suffices for a loss without parameters.
        loss: the loss.
        classes: number of classes of each group; empty if the loss does not classify.
        dim: width of a descriptor.

    Raises:
        InputError: there is no key for a loss with parameters, or there are no classes for a loss
            that classifies.
    """
    name = f"loss {loss.part_name}"
    shapes = jax.eval_shape(lambda key: loss.init(key, 1, dim), jax.random.key(0))
    if not jax.tree.leaves(shapes):
        return None
    if key is None or (loss.grouping is not None and not classes):
        raise InputError(
            f"{name}: found {'no ' if key is None else 'a '}key and classes {classes}, expected a "
            "jax.random.key and, where it classifies, the number of classes of each group "
            "(step_config(..., classes=))"
        )
    counts = classes or (0,)
    keys = jax.random.split(key, len(counts))
    groups = [loss.init(each, count, dim) for each, count in zip(keys, counts, strict=True)]
    check_drawn(groups, name)
    largest = max(counts)

    def together(*leaves: Array) -> Array:
        # Leaves with a row for each class are padded with zeros.
        pairs = zip(leaves, counts, strict=True)
        return jnp.stack([_filled(leaf, count, largest) for leaf, count in pairs])

    weights = jax.tree.map(together, *groups)
    return Classifiers(weights, jax.vmap(optax.adam(loss.learning_rate).init)(weights))


def _filled(leaf: Array, count: int, largest: int) -> Array:
    if leaf.ndim == 0 or leaf.shape[0] != count:
        return leaf
    return jnp.pad(leaf, [(0, largest - count), *[(0, 0)] * (leaf.ndim - 1)])


def update_classifiers(
    classifiers: Classifiers, group: Int[Array, ""], gradient: PyTree, learning_rate: float
) -> Classifiers:
    """Take an Adam step (Kingma and Ba 2015) for the group at an index; others do not change."""
    mine = jax.tree.map(lambda leaf: leaf[group], classifiers)
    updates, optimiser = optax.adam(learning_rate).update(gradient, mine.optimiser)
    stepped = Classifiers(optax.apply_updates(mine.weights, updates), optimiser)
    return jax.tree.map(lambda all_, new: all_.at[group].set(new), classifiers, stepped)


@takes(path=PATH)
def load_loss(path: str | os.PathLike[str]) -> tuple[LossConfig, PyTree]:
    """Read the loss of a run and its learnt parameters.

    `load` reads the model from the same file. A run that starts from this file reinitialises the
    loss. Class vectors, and a projection to a teacher's descriptor length, are not in the file but
    only in a run's `state/`.

    Args:
        path: the `last.safetensors` or `best.safetensors` of a run.

    Returns:
        (configuration, parameters), for `metric_loss`.

    Raises:
        InputError: `load` cannot read the file; it has no parameters of a loss; or the loss is not
            registered.

    Example:
        >>> import crisalad_jax as cj
        >>> @cj.register_loss("warm")
        ... class Warm(cj.Loss):
        ...     def init(self, key, classes, dim):
        ...         return {"temperature": jnp.ones(())}
        ...
        ...     def apply(self, params, batch):
        ...         return cj.LossValue(params["temperature"] * batch.similarities.sum())
        >>> config = cj.recipe("tiny").model
        >>> model = cj.Model(cj.init_crisalad(jax.random.key(0), config), config)
        >>> learnt = cj.LossConfig(kind=Warm()), {"temperature": jnp.array(0.5)}
        >>> cj.save_weights(folder / "last.safetensors", model, loss=learnt)
        >>> loss, params = load_loss(folder / "last.safetensors")
        >>> loss.kind.part_name, float(params["temperature"])
        ('warm', 0.5)
    """
    found = read_weights(path)
    if found.loss is None:
        raise InputError(
            f"{path}: found no parameters of a loss, expected the weights of a run whose loss "
            "learns some, and not a vector for each class"
        )
    plain, arrays = found.loss
    config = from_plain(LossConfig, plain, source=f"{path} (metadata)")
    dim = found.config.descriptor_dim
    with compiler.number_types():
        template = jax.eval_shape(lambda key: config.kind.init(key, 0, dim), jax.random.key(0))
    return config, tree_of(arrays, template, source=f"{path}: loss {config.kind.part_name}")
