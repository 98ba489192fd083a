"""One interface to models that describe images, in JAX or in another engine.

JAX is imported only through `jax_describer`, if a JAX model is given.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.data.loader import ImageBatch
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool, Float

if TYPE_CHECKING:  # an engine describes images without JAX
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model

Rows = Float[np.ndarray, "image token_numbers"]
"""Tokens of some images, one row each, in a form that only the describer's `attend` reads."""


class Describer(Protocol):
    """A model that describes images in two steps: tokens of each image, then descriptors."""

    config: "ModelConfig"
    """The model's configuration."""
    preparation: Preparation
    """How images are resized and normalised."""
    digest: str
    """The `model_hash` of the model: a SHA-256 of its parameters and configuration."""
    row_length: int
    """Number of values in the row of an image's tokens."""
    row_dtype: str
    """Type of the values in rows of tokens."""

    def tokens(self, batches: Iterable[ImageBatch]) -> Iterator[tuple[Rows, ImageBatch]]:
        """Yield the tokens of each batch's images, padding included, and the batch, in order."""
        ...

    def attend(
        self,
        rows: Float[np.ndarray, "group image row"],
        mask: Bool[np.ndarray, "group image image"],
    ) -> Float[np.ndarray, "group image descriptor"]:
        """Compute descriptors from the tokens of groups of images.

        `mask[g, i, j]` allows image i of group g to attend to image j of the same group.
        """
        ...


def describer_of(
    model: "Model | Runtime | Describer", groupings: Sequence[str] = ("single",)
) -> Describer:
    """Check a model, and return a describer for it.

    Args:
        model: parameters and configuration (`Model`), a model in another engine, or a describer.
        groupings: the groupings that it must support, in the syntax of `Grouping.parse`.

    Raises:
        InputError: `model` is none of these; its parameters do not match its configuration; or it
            is a program that was exported for other groupings.
    """
    if isinstance(model, Runtime):
        model.check_groupings(groupings)
    if hasattr(model, "attend"):
        return cast(Describer, model)
    if not isinstance(model, tuple):
        raise InputError(
            f"model: found {type(model).__name__}, expected a Model(params, config), as `load` "
            "returns it, or a Runtime"
        )
    from crisalad_jax.retrieval.jax_describer import JaxDescriber

    return cast(Describer, JaxDescriber(*model))
