"""One record of how images are read, for everything that describes them."""

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Self

import numpy as np

from crisalad_jax.config.checks import check_count, check_types
from crisalad_jax.config.preprocessing import PreprocessingConfig, Size
from crisalad_jax.config.short_repr import with_field_docs
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.loader import THREADS, ImageBatch, ImageCache, read_batches
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.video import frame_time

_SMALL = 16
"""Largest number of images that is padded to a power of two, so that few sizes are compiled."""


@with_field_docs
@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """How images are read: how many at a time, and what one that cannot be read does.

    Example:
        >>> Reading(batch_size=32, on_bad_image="skip").batch_size
        32
    """

    batch_size: int = 16
    """Number of images described together."""
    on_bad_image: OnBadImage = "stop"
    """"stop" at an unreadable image, or "skip" it."""
    threads: int = THREADS
    """Number of threads that decode ahead; 0 decodes in the caller's thread."""
    cache: ImageCache | None = None
    """Cache of decoded images."""
    quiet: bool = False
    """Whether to show no progress bars."""

    def __post_init__(self) -> None:
        """Check the fields."""
        check_types(self)
        check_count("batch size", self.batch_size)

    def fitted(self, images: int) -> Self:
        """Return a smaller batch size where the batches of so few images would be mostly padding.

        Example:
            >>> [Reading(batch_size=32).fitted(count).batch_size for count in (1, 3, 12, 20, 50)]
            [1, 4, 16, 20, 32]
        """
        padded = images if images > _SMALL else 1 << max(0, images - 1).bit_length()
        return dataclasses.replace(self, batch_size=min(self.batch_size, padded))

    def batches(
        self, paths: Sequence[str | os.PathLike[str]], preparation: Preparation
    ) -> Iterator[ImageBatch]:
        """Yield batches of image files, in order; the last one is padded.

        Where a rule gives images sizes of their own, consecutive images of one size make a batch,
        and every change of size ends and pads one: then a `batch_size` of 1 saves work. Under
        "skip" an image that cannot be read is not valid but keeps its index.

        Args:
            paths: the files.
            preparation: how the model's images are prepared.

        Raises:
            InputError: while iterating under "stop" for an image that cannot be read.
        """
        threads = self.threads
        if any(frame_time(path) is not None for path in paths):
            threads = min(threads, 1)  # more would read a video each, from its beginning
        cache = self.cache or ImageCache(0)
        indices = np.arange(len(paths))
        return read_batches(
            lambda position: cache.read(paths[position], preparation),
            labels=indices,
            indices=indices,
            positions=indices,
            how=preparation,
            batch_size=self.batch_size,
            on_bad_image=self.on_bad_image,
            threads=threads,
        )


def image_batches(
    paths: Sequence[str | os.PathLike[str]],
    *,
    image_size: Size,
    batch_size: int,
    preprocessing: PreprocessingConfig = PreprocessingConfig(),
    side_multiple: int = 1,
    check_size: Callable[[Size], None] | None = None,
    on_bad_image: OnBadImage = "stop",
    threads: int = THREADS,
    cache: ImageCache | None = None,
) -> Iterator[ImageBatch]:
    """Yield batches of the images in `paths`, in order; the last one is padded to `batch_size`.

    See `Reading.batches`.

    Args:
        paths: image files.
        image_size: height and width in pixels that images are resized to, or what the rule of
            `preprocessing` takes from them.
        batch_size: number of images of a batch.
        preprocessing: how images are resized, and floats normalised.
        side_multiple: number of pixels that sides are rounded to multiples of.
        check_size: raises InputError for a height and width that no image may have.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        threads: how many decode ahead; 0 decodes in the caller's thread.
        cache: holds decoded images.

    Yields:
        The batches: pixels, indices into `paths`, and which images are valid.

    Raises:
        InputError: at once for arguments out of range; while iterating under "stop" for an image
            that cannot be read.

    Example:
        >>> paths = sorted(pictures.iterdir())
        >>> batches = list(image_batches(paths, image_size=(98, 98), batch_size=3))
        >>> [batch.valid.tolist() for batch in batches]
        [[True, True, True], [True, False, False]]
    """
    reading = Reading(
        batch_size=batch_size, on_bad_image=on_bad_image, threads=threads, cache=cache
    )
    return reading.batches(paths, Preparation(image_size, preprocessing, side_multiple, check_size))
