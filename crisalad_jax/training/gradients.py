"""Compute norms of the gradient of a batch's loss, for each part of the model."""

import dataclasses
import functools
from fnmatch import fnmatchcase
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, UInt8

from crisalad_jax.config.checks import takes
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.step import (
    StepConfig,
    TrainState,
    checked_batch,
    init_train_state,
    loss_and_gradient,
    step_config,
)
from crisalad_jax.training.trainable import choose, numbered_names
from crisalad_jax.utils import compiler
from crisalad_jax.utils.pytree import named_leaves

_NO_MOMENTS = optax.identity()


@takes(params=Crisalad, config=TrainConfig)
def gradient_norms(
    params: Crisalad,
    images: UInt8[Array | np.ndarray, "image height width 3"],
    labels: Int[Array | np.ndarray, " image"],
    config: TrainConfig,
    *,
    key: PRNGKeyArray | None = None,
) -> dict[str, float]:
    """Compute the norm of the gradient of a batch's loss for each trainable part of the model.

    The configuration says which loss, and which parameters train. The squares of all norms add up
    to the square of the whole gradient's norm, `Metrics.gradient_norm`.

    Args:
        params: the whole model's parameters.
        images: a batch, as `training_batches` yields it.
        labels: the place of each image.
        config: the run's configuration; `trainable="all"` shows all parts.
        key: random key for dropout and for the loss's parameters; None disables dropout.

    Returns:
        Euclidean norms by name, in the order of the model: `backbone.blocks.3` for a block,
        `backbone.blocks.3.adapter` for its adapter, other parts of the backbone such as
        `backbone.patch_embed`, then `aggregator`, `cross_image`, `projection` and `loss`. Parts
        that do not train are left out.

    Raises:
        InputError: nothing would train; there is no key for a loss with parameters; the step of
            `make_train_step` refuses the batch; or the loss classifies: only a run has its classes.

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import init_crisalad, recipe
        >>> config = recipe("tiny")
        >>> params = init_crisalad(jax.random.key(0), config.model)
        >>> images = np.random.default_rng(0).integers(0, 256, (4, 98, 98, 3), np.uint8)
        >>> norms = gradient_norms(params, images, np.array([0, 0, 1, 1]), config)
        >>> list(norms)[-3:]
        ['backbone.norm', 'aggregator', 'cross_image']
    """
    model = config.model
    static = step_config(config, steps=1, optimiser=_NO_MOMENTS)
    state, frozen = init_train_state(params, config.trainable, static, key=key)
    squares, of_loss = _squares(state, frozen, *checked_batch(images, labels, model), key, static)
    chosen, names = (choose(params, model, config.trainable), numbered_names(params, model))
    adapters = [f"backbone.{pattern}" for pattern in model.backbone.trains]
    sums: dict[str, float] = {}
    for leaf, values in named_leaves(squares).items():
        values = np.asarray(values) if len(names[leaf]) > 1 else [np.sum(values)]
        for name, value, trains in zip(names[leaf], values, chosen[leaf], strict=True):
            if trains:
                part = _part_of(name, adapters)
                sums[part] = sums.get(part, 0.0) + float(value)
    if jax.tree.leaves(state.classifiers):
        sums["loss"] = float(of_loss)
    return {part: square**0.5 for part, square in sums.items()}


@functools.partial(compiler.jit, static_argnames="config")
def _squares(
    state: TrainState,
    frozen: PyTree,
    images: UInt8[Array, "image height width 3"],
    labels: Int[Array, " image"],
    key: PRNGKeyArray | None,
    config: StepConfig,
) -> tuple[Any, Float[Array, ""]]:
    """Sum the squared gradient over all axes but the first, and that of the loss's parameters."""
    valid = jnp.ones(len(labels), bool)
    _, (gradient, of_loss) = loss_and_gradient(state, frozen, images, labels, valid, key, config)
    whole = eqx.combine(gradient, jax.tree.map(jnp.zeros_like, frozen))
    backbone = config.model.backbone.join_blocks(whole.backbone)
    squares = jax.tree.map(
        lambda leaf: jnp.square(leaf).sum(axis=range(1, leaf.ndim)),
        dataclasses.replace(whole, backbone=backbone),
    )
    return squares, jnp.square(optax.tree.norm(of_loss))


def _part_of(name: str, adapters: list[str]) -> str:
    """Return the part that a parameter belongs to, from its name with its block's number."""
    parts = name.split(".")
    for pattern in adapters:
        part = ".".join(parts[: 1 + pattern.count(".")])
        if fnmatchcase(part, pattern):
            return part
    if parts[0] != "backbone":
        return parts[0]
    return ".".join(parts[: 3 if parts[2:3] and parts[2].isdecimal() else 2])
