"""Prepare a decoded photograph for a network: resize it, and normalise what is no bytes."""

import dataclasses
from collections.abc import Callable

import numpy as np

from crisalad_jax.config.preprocessing import PreprocessingConfig, Size
from crisalad_jax.data.depth import as_rgb
from crisalad_jax.data.resize import Pixels, resize_image
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float32


@dataclasses.dataclass(frozen=True)
class Preparation:
    """All that decides how photographs are prepared; caches keep images by it."""

    image_size: Size
    preprocessing: PreprocessingConfig = PreprocessingConfig()
    side_multiple: int = 1
    """Number of pixels that sides are rounded to multiples of; see `ModelConfig.side_multiple`."""

    def __post_init__(self) -> None:
        """Check the size."""
        if min(self.image_size) < 1:
            raise InputError(
                f"image_size: found {self.image_size}, expected a height and width of at least 1"
            )

    @property
    def dtype(self) -> type[np.generic]:
        """Type of what is prepared: uint8 pixels, or float32 that are normalised."""
        return np.uint8 if self.preprocessing.pixels == "bytes" else np.float32

    def size_of(self, size: Size) -> Size:
        """Return the height and width that an image of `size` gets."""
        first = self.preprocessing.target_size(size, self.image_size)
        return self.preprocessing.rounded_size(first, self.side_multiple)

    def prepare(
        self,
        image: np.ndarray,
        check: Callable[[Size], None] | None = None,
        name: str | None = None,
    ) -> Pixels:
        """Resize an image, and normalise floats.

        Args:
            image: RGB or grey, as `as_rgb` takes it.
            check: raises InputError for a size that the model cannot describe, before any work.
            name: the image's, for messages.

        Returns:
            8-bit pixels, or normalised float32.

        Raises:
            InputError: the image is no array of pixels, or what `check` raises.
        """
        how = self.preprocessing
        image = as_rgb(image, how.bit_depth, name or "image")
        height, width = image.shape[:2]
        first = how.target_size((height, width), self.image_size)
        last = how.rounded_size(first, self.side_multiple)
        if check is not None:
            try:
                check(last)
            except InputError as error:
                raise InputError(f"{name}: {error}" if name else str(error)) from error
        if how.size_rule == "fixed" or first != (height, width):
            image = resize_image(
                image, first, filter=how.filter, antialias=how.antialias, pixels=how.pixels
            )
        if last != first:
            image = resize_image(image, last, pixels=how.pixels)
        return image if how.pixels == "bytes" else normalised(image, how)


def normalised(pixels: Pixels, how: PreprocessingConfig) -> Float32[np.ndarray, "..."]:
    """Normalise pixels from 0 to 255 by the mean and deviation of each colour.

    Args:
        pixels: RGB (..., 3), 8-bit or floats.
        how: has the mean and the deviation, of pixels from 0 to 1.
    """
    mean, deviation = (np.array(each, np.float32) for each in (how.mean, how.deviation))
    return (pixels / np.float32(255) - mean) / deviation
