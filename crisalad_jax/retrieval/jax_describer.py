"""Describe images with a JAX model, on all devices that can share a batch."""

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from crisalad_jax.checkpoints.weights import model_hash
from crisalad_jax.data.loader import ImageBatch
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import at_least_float32
from crisalad_jax.nn.model import (
    AnyArray,
    Crisalad,
    Images,
    attend_across_images,
    cast_params,
    check_params,
    extract_tokens,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.retrieval.describer import Rows
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import Devices, devices_for, over_images


class JaxDescriber:
    """A `Describer` for a JAX model."""

    def __init__(self, params: Crisalad, config: ModelConfig) -> None:
        """Check that the parameters match the configuration, and cast them once."""
        check_params(params, config)
        self.config = config
        self.preparation = Preparation.of(config)
        self.row_length = config.unprojected_dim
        self.row_dtype = "float64" if config.compute_dtype == "float64" else "float32"
        self._given, self._params = params, cast_params(params, config)
        self._placed: tuple[int, Devices, Crisalad] | None = None
        """A batch size, the devices that share such a batch, and the parameters on them."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the model; the process that loads it splits its CPU into as many devices.

        The bits of a batch depend on the number of devices that share it.
        """
        devices = jax.local_device_count() if jax.default_backend() == "cpu" else None
        return _sent, (jax.tree.map(np.asarray, self._given), self.config, devices)

    @functools.cached_property
    def digest(self) -> str:
        """The `model_hash` of the model."""
        return model_hash(self._given, self.config)

    def tokens(self, batches: Iterable[ImageBatch]) -> Iterator[tuple[Rows, ImageBatch]]:
        """Yield the tokens of each batch, and the batch; devices compute one batch ahead."""

        def dispatched() -> Iterator[tuple[jax.Array, ImageBatch] | None]:
            for batch in batches:
                devices, params = self._on_devices(len(batch.images))
                yield _token_rows(params, devices.shard_batch(batch.images), self.config), batch
            yield None

        for ready, _ in itertools.pairwise(dispatched()):
            if ready is not None:
                yield np.asarray(ready[0]), ready[1]

    def _on_devices(self, batch_size: int) -> tuple[Devices, Crisalad]:
        if self._placed is None or self._placed[0] != batch_size:
            devices = devices_for(batch_size)
            self._placed = batch_size, devices, devices.replicate(self._params)
        return self._placed[1:]

    def attend(
        self,
        rows: Float[np.ndarray, "group image row"],
        mask: Bool[np.ndarray, "group image image"],
    ) -> Float[np.ndarray, "group image descriptor"]:
        """Compute descriptors from the tokens of groups of images; see `Describer.attend`."""
        return np.asarray(_attend(self._params, rows, mask, self.config))


def _sent(params: Crisalad, config: ModelConfig, devices: int | None) -> JaxDescriber:
    compiler.configure(devices)
    return JaxDescriber(params, config)


@over_images("images", 1)
@functools.partial(compiler.jit, static_argnames="config")
def _token_rows(params: Crisalad, images: Images, config: ModelConfig) -> Float[Array, "image row"]:
    """Extract tokens, and flatten those of each image into a row."""
    tokens = extract_tokens(params, images, config)
    width = config.token_shape.tokens * config.token_shape.token_dim
    local = tokens.local.reshape(len(images), width)
    return at_least_float32(jnp.concatenate([tokens.global_token, local], axis=1))


@functools.partial(compiler.jit, static_argnames="config")
def _attend(
    params: Crisalad,
    rows: Float[AnyArray, "group image row"],
    mask: Bool[AnyArray, "group image image"],
    config: ModelConfig,
) -> Float[Array, "group image descriptor"]:
    shape = config.token_shape

    def one_group(rows: Array, mask: Array) -> Array:
        global_token, local = jnp.split(rows, [shape.global_dim], axis=1)
        tokens = Tokens(global_token, local.reshape(len(rows), shape.tokens, shape.token_dim))
        return attend_across_images(params, tokens, config, mask=mask)

    return jax.vmap(one_group)(jnp.asarray(rows), jnp.asarray(mask))
