"""Lower this package's programs for absent machines."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from crisalad_jax.nn.model import cast_params, describe, parameter_shapes
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.step import init_train_state, step_config, train_step
from crisalad_jax.utils.target import GPU, TPU, lowering_for
from scripts.compile_check.absent import assuming_cudnn
from scripts.compile_check.targets import COMPILER_OPTIONS, Machine, devices_of

_TARGETS = {"tpu": TPU, "cuda": GPU}


def compile_program(
    program: str, machine: Machine, config: TrainConfig, images: int
) -> jax.stages.Compiled:
    """Compile a program for the devices of a machine, which may be absent.

    Arrays are placed as in `crisalad train` and `extract`: images are sharded over all devices, and
    the rest is replicated.

    Args:
        program: "describe" or "train".
        machine: the machine to compile for.
        config: the model and its training.
        images: number of images in the batch, over all devices.

    Returns:
        The compiled program, which can't run here.

    Raises:
        InputError: the devices can't share the images, or the compiler doesn't know the machine.
    """
    machine.check_batch(images)
    mesh = Mesh(np.array(devices_of(machine)), ("image",))
    with lowering_for(_TARGETS[machine.platform]), assuming_cudnn():
        lowered = _LOWER[program](config, images, mesh)
        with _without_cache():
            return lowered.compile(compiler_options=COMPILER_OPTIONS[machine.platform])


@contextlib.contextmanager
def _without_cache() -> Iterator[None]:
    """Disable the compile cache, which can't load a program for an absent device."""
    was: Any = jax.config.jax_enable_compilation_cache  # pyright: ignore
    try:
        jax.config.update("jax_enable_compilation_cache", False)
        compilation_cache.reset_cache()  # JAX checks only once whether it is enabled
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", was)
        compilation_cache.reset_cache()


def _placed(tree: Any, mesh: Mesh, *axes: str) -> Any:
    where = NamedSharding(mesh, PartitionSpec(*axes))
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), tree
    )


def _pixels(config: TrainConfig, images: int, mesh: Mesh) -> Any:
    shape = (images, *config.model.input_size, 3)
    return _placed(jax.ShapeDtypeStruct(shape, jnp.uint8), mesh, "image")


def _lower_describe(config: TrainConfig, images: int, mesh: Mesh) -> jax.stages.Lowered:
    shapes = parameter_shapes(config.model)
    params = _placed(jax.eval_shape(lambda tree: cast_params(tree, config.model), shapes), mesh)
    return describe.lower(params, _pixels(config, images, mesh), config.model)


def _lower_train(config: TrainConfig, images: int, mesh: Mesh) -> jax.stages.Lowered:
    # Only schedules depend on the number of steps.
    step = step_config(
        config,
        steps=1000,
        steps_per_epoch=100,
        classes=(images,) if config.loss.kind.grouping is not None else (),
    )
    key = jax.eval_shape(lambda: jax.random.key(0))
    state, frozen = jax.eval_shape(
        lambda params, key: init_train_state(params, config.trainable, step, key=key),
        parameter_shapes(config.model),
        key,
    )
    frozen = jax.eval_shape(lambda tree: cast_params(tree, config.model), frozen)
    labels = jax.ShapeDtypeStruct((images,), jnp.int32)
    valid = jax.ShapeDtypeStruct((images,), jnp.bool_)
    proceed = jax.ShapeDtypeStruct((), jnp.bool_)
    state, frozen, key, proceed = _placed((state, frozen, key, proceed), mesh)
    return train_step.lower(
        state,
        frozen,
        _pixels(config, images, mesh),
        *_placed((labels, valid), mesh, "image"),
        key,
        step,
        proceed,
    )


_LOWER: Mapping[str, Callable[[TrainConfig, int, Mesh], jax.stages.Lowered]] = {
    "describe": _lower_describe,
    "train": _lower_train,
}
PROGRAMS: Sequence[str] = tuple(_LOWER)
"""Names of the programs."""
