"""What describes images: a model in JAX or in another engine, behind one interface.

Nothing here imports JAX: `jax_describer` does, where a model of JAX's is given.
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
"""The tokens of some images, a row of numbers each, which only the describer's `attend` reads."""


class Describer(Protocol):
    """A model that describes images in two steps: every image's tokens, then their descriptors."""

    config: "ModelConfig"
    """The model's configuration."""
    preparation: Preparation
    """How images are prepared."""
    digest: str
    """The `model_hash` of the model."""
    row_length: int
    """Number of values in the row of an image's tokens."""
    row_dtype: str
    """Type of the values in rows of tokens."""

    def tokens(self, batches: Iterable[ImageBatch]) -> Iterator[tuple[Rows, ImageBatch]]:
        """Yield each batch with the tokens of its images, padding included, in order."""
        ...

    def attend(
        self,
        rows: Float[np.ndarray, "group image row"],
        mask: Bool[np.ndarray, "group image image"],
    ) -> Float[np.ndarray, "group image descriptor"]:
        """Make descriptors of the tokens of some groups of images.

        `mask[g, i, j]` allows image i of group g to attend to image j of it.
        """
        ...


def describer_of(
    model: "Model | Runtime | Describer", groupings: Sequence[str] = ("single",)
) -> Describer:
    """Return what describes images with a model, and check it.

    Args:
        model: parameters and configuration, or a model in another engine.
        groupings: the groupings of images that it has to describe, each as `Grouping.parse` takes.

    Raises:
        InputError: the parameters are not of the configuration; or the engine's program is for
            other groupings.
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
