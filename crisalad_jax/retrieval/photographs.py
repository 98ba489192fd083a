"""Photographs as a model takes them: one, or files in batches."""

import os
from collections.abc import Iterator, Sequence

import numpy as np

from crisalad_jax.config.checks import takes
from crisalad_jax.data.loader import ImageBatch, ImageCache, OnBadImage, image_batches
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.resize import Pixels
from crisalad_jax.nn.config import ModelConfig


@takes(config=ModelConfig)
def prepare_image(image: np.ndarray, config: ModelConfig, name: str | None = None) -> Pixels:
    """Resize a photograph as a model's configuration says; floats are normalised, too.

    Args:
        image: 8-bit RGB, of `read_image`; or grey (height, width) or (height, width, 1), which is
            repeated over the channels; or uint16, of which the configuration makes 8 bits.
        config: the model.
        name: the image's, for messages.

    Returns:
        What `describe` takes, in a batch: 8-bit pixels, or normalised float32.

    Raises:
        InputError: the image is no such array, or the model cannot describe one of its size.

    Example:
        >>> import numpy as np
        >>> from crisalad_jax import PRESETS
        >>> prepare_image(np.zeros((60, 80, 3), np.uint8), PRESETS["b14"]).shape
        (224, 224, 3)
    """
    how = Preparation(config.image_size, config.preprocessing, config.side_multiple)
    return how.prepare(image, config.check_image_size, name)


def photograph_batches(
    config: ModelConfig,
    paths: Sequence[str | os.PathLike[str]],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    cache: ImageCache | None = None,
) -> Iterator[ImageBatch]:
    """Yield batches of image files as a model takes them; see `image_batches`.

    Raises:
        InputError: what `image_batches` raises; or, as for an image that cannot be read, the model
            cannot describe one of its size.
    """
    return image_batches(
        paths,
        image_size=config.image_size,
        batch_size=batch_size,
        preprocessing=config.preprocessing,
        side_multiple=config.side_multiple,
        check_size=config.check_image_size,
        on_bad_image=on_bad_image,
        cache=cache,
    )
