"""Prepare a decoded photograph for a network: 8-bit RGB, resized, and normalised if float."""

import dataclasses
import threading
from collections.abc import Callable
from typing import Any, Self

import numpy as np

from crisalad_jax.config.preprocessing import (
    BitDepth,
    LocalFeatures,
    PreprocessingConfig,
    Size,
)
from crisalad_jax.data.local_features import encode_local_features
from crisalad_jax.data.resize import Pixels, resize_image
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float32, UInt8, UInt16

PERCENTILES = (1, 99)
"""Percentiles of an image's values that "contrast-stretch" maps to 0 and 255. With the extremes
instead, a dead pixel of a thermal camera would use up the range."""
_NARROW = 2**14
"""Range of 16-bit values below which an image has fewer than 64 of 256 grey levels."""
_noted = threading.Lock()
"""Acquired for good by the first warning: a set of thermal images would give thousands."""


def as_rgb(
    image: Any, bit_depth: BitDepth = "high-byte", name: str = "image"
) -> UInt8[np.ndarray, "h w 3"]:
    """Convert an image to 8-bit RGB.

    Args:
        image: RGB (height, width, 3), or grey (height, width) or (height, width, 1). uint8 or
            uint16; for "contrast-stretch" any integers or floats.
        bit_depth: how more than 8 bits become 8; see `PreprocessingConfig`.
        name: prefix of messages, such as the file.

    Raises:
        InputError: `image` is not such an array, or none of its values is finite.

    Example:
        >>> import numpy as np
        >>> as_rgb(np.array([[7, 9]], np.uint8)).tolist()
        [[[7, 7, 7], [9, 9, 9]]]
    """
    expected = (
        "uint8 or uint16 of shape (height, width, 3), or grey (height, width), with sides of at "
        "least 1"
    )
    shape = image.shape if isinstance(image, np.ndarray) else ()
    grey = len(shape) == 2 or shape[2:] == (1,)
    right = 0 not in shape and (grey or shape[2:] == (3,))
    if right and image.dtype != np.uint8 and image.dtype.kind in "iuf":
        if bit_depth == "contrast-stretch":
            image = _stretched(image, name)
        elif image.dtype == np.uint16:
            _note_narrow(image, name)
            image = (image >> 8).astype(np.uint8)
    if not right or image.dtype != np.uint8:
        found = f"{image.dtype} of shape {shape}" if shape else type(image).__name__
        if right and image.dtype.kind in "iuf":
            expected = "uint8 or uint16; --resize contrast-stretch spreads such values over 8 bits"
        raise InputError(f"{name}: found {found}, expected {expected}")
    return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2) if grey else image


def _range(image: np.ndarray, name: str) -> tuple[float, float]:
    """Return `PERCENTILES` of the finite values, uninterpolated so that grey and RGB agree."""
    values = image[np.isfinite(image)] if image.dtype.kind == "f" else image
    if not values.size:
        raise InputError(f"{name}: found no finite value, expected some")
    low, high = np.percentile(values, PERCENTILES, method="inverted_cdf")
    return float(low), float(high)


def _stretched(image: np.ndarray, name: str) -> UInt8[np.ndarray, "..."]:
    """Spread the values between the percentiles over 0 to 255; NaN becomes 0."""
    low, high = _range(image, name)
    share = (image - np.float64(low)) / ((high - low) or 1.0)
    return np.rint(255 * np.clip(np.nan_to_num(share), 0, 1)).astype(np.uint8)


def _note_narrow(image: UInt16[np.ndarray, "..."], name: str) -> None:
    """Warn, once, that 16-bit values of a narrow range lose most of their detail."""
    if _noted.locked():
        return
    low, high = _range(image, name)
    if high - low < _NARROW and _noted.acquire(blocking=False):
        levels = int(high) // 256 - int(low) // 256 + 1
        warn(
            f"{name}: 16-bit values from {low:,.0f} to {high:,.0f} of 65,535 become {levels} of "
            "256 grey levels; --resize contrast-stretch spreads them over all"
        )


@dataclasses.dataclass(frozen=True)
class Preparation:
    """Everything that determines how photographs are prepared; caches use it as a key."""

    image_size: Size
    preprocessing: PreprocessingConfig = PreprocessingConfig()
    side_multiple: int = 1
    """Sides are rounded to multiples of this many pixels; see `ModelConfig.side_multiple`."""
    check_size: Callable[[Size], None] | None = dataclasses.field(
        default=None, compare=False, repr=False
    )
    """Function that raises InputError for a height and width that the model cannot describe."""
    local_features: LocalFeatures | None = None
    """Kind of local features that replace the pixels; None for pixels."""
    encoded_size: Size | None = None
    """Height and width of the array that encodes the local features; None for pixels."""

    def __post_init__(self) -> None:
        """Check the size."""
        if min(self.image_size) < 1:
            raise InputError(
                f"image_size: found {self.image_size}, expected a height and width of at least 1"
            )

    @classmethod
    def of(cls, model: Any) -> Self:
        """Return the preparation that a model's configuration specifies."""
        return cls(
            model.image_size,
            model.preprocessing,
            model.side_multiple,
            model.check_image_size,
            model.backbone.local_features,
            model.backbone.encoded_size,
        )

    @property
    def dtype(self) -> type[np.generic]:
        """Type of prepared images: uint8 for pixels as bytes, float32 for normalised floats."""
        return np.uint8 if self.preprocessing.pixels == "bytes" else np.float32

    def size_of(self, size: Size) -> Size:
        """Return the height and width that an image of `size` (height, width) has when prepared."""
        if self.encoded_size is not None:
            return self.encoded_size
        first = self.preprocessing.target_size(size, self.image_size)
        return self.preprocessing.rounded_size(first, self.side_multiple)

    def prepare(self, image: np.ndarray, name: str = "image") -> Pixels:
        """Resize an image and, if the model takes "floats", normalise it.

        Args:
            image: RGB or grey, as `as_rgb` takes it.
            name: the image's name, for messages.

        Returns:
            RGB (height, width, 3): 8-bit, or normalised float32; or bytes of local features.

        Raises:
            InputError: `as_rgb` refuses the image, or `check_size` refuses its size.
        """
        how = self.preprocessing
        image = as_rgb(image, how.bit_depth, name)
        height, width = image.shape[:2]
        first = how.target_size((height, width), self.image_size)
        last = how.rounded_size(first, self.side_multiple)
        if self.check_size is not None:
            try:
                self.check_size(last)
            except InputError as error:
                raise InputError(f"{name}: {error}") from error
        if how.size_rule == "fixed" or first != (height, width):
            image = resize_image(
                image, first, filter=how.filter, antialias=how.antialias, pixels=how.pixels
            )
        if last != first:
            image = resize_image(image, last, pixels=how.pixels)
        if self.local_features is not None and self.encoded_size is not None:
            return encode_local_features(image, self.local_features, self.encoded_size[0])
        return image if how.pixels == "bytes" else normalised(image, how)


def normalised(pixels: Pixels, how: PreprocessingConfig) -> Float32[np.ndarray, "..."]:
    """Normalise pixels from 0 to 255 by the mean and deviation of each colour.

    Args:
        pixels: RGB (..., 3), 8-bit or floats.
        how: configuration with the mean and deviation, which are for pixels from 0 to 1.
    """
    mean, deviation = (np.array(each, np.float32) for each in (how.mean, how.deviation))
    return (pixels / np.float32(255) - mean) / deviation
