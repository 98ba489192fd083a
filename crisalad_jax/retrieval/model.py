"""The functions of a model that retrieval describes images with: by JAX, or by another engine.

They have the names of those in `nn.model`. A `Runtime` stands in the place of parameters. Its
tokens are rows of numbers that only it can read: a global token here, and no local ones.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from crisalad_jax.checkpoints import weights
from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.nn import model
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.errors import InputError

Model = Crisalad | Runtime
"""Parameters of a model, or an engine that has them."""


def check_params(params: Model, config: ModelConfig) -> None:
    """Check that parameters are those of a configuration, or that an engine's images are.

    Raises:
        InputError: they are not; or an engine's program lets the images of a call look at each
            other, whichever they are.
    """
    if not isinstance(params, Runtime):
        model.check_params(params, config)
        return
    if params.input_size != config.input_size:
        found, expected = (" x ".join(map(str, s)) for s in (params.input_size, config.input_size))
        raise InputError(
            f"{params.folder}: found a program for images of {found}, expected {expected}"
        )
    if params.grouping == "batch" and config.cross_image.layers:
        raise InputError(
            f"{params.folder}: found a program of grouping batch, expected single or any"
        )


def check_groupings(params: Model, config: ModelConfig, groupings: Sequence[str]) -> None:
    """Check that an engine's program can describe images under these groupings.

    Raises:
        InputError: it describes every image alone.
    """
    if isinstance(params, Runtime) and params.grouping == "single" and config.cross_image.layers:
        for grouping in groupings:
            if set(grouping.split("/")) != {"single"}:
                raise InputError(
                    f"grouping: found {grouping}, expected single: {params.folder} was exported "
                    "with --grouping single"
                )


def model_hash(params: Model, config: ModelConfig) -> str:
    """Return the digest of a model; an engine's is that of the weights that were exported."""
    if isinstance(params, Runtime):
        return params.digest
    return weights.model_hash(params, config)


def cast_params(params: Model, config: ModelConfig) -> Any:
    """Cast parameters as `nn.model.cast_params`; an engine has cast its own."""
    return params if isinstance(params, Runtime) else model.cast_params(params, config)


def extract_tokens(params: Model, images: Any, config: ModelConfig) -> Tokens:
    """Extract every image's tokens."""
    if not isinstance(params, Runtime):
        return model.extract_tokens(params, images, config)
    rows = params.tokens(np.asarray(images))
    return Tokens(rows, np.empty((len(rows), 0, 0), np.float32))  # pyright: ignore


def attend_across_images(
    params: Model, tokens: Tokens, config: ModelConfig, *, mask: Any
) -> Float[Array, "image descriptor"]:
    """Make descriptors of tokens; `mask[i, j]` allows image i to attend to image j."""
    if not isinstance(params, Runtime):
        return model.attend_across_images(params, tokens, config, mask=mask)
    return jnp.asarray(params.attend(np.asarray(tokens.global_token), np.asarray(mask)))


def describe_each(
    params: Model, images: np.ndarray, config: ModelConfig
) -> Float[np.ndarray, "image descriptor"]:
    """Describe prepared images, each as if it were alone."""
    if isinstance(params, Runtime):
        return params.describe(images)
    mask = model.self_mask(len(images))
    return np.asarray(model.describe(params, images, config, mask=mask))
