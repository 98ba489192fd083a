"""Read a list of image files in batches."""

import os
from collections.abc import Callable, Iterator, Sequence

from crisalad_jax.config.preprocessing import PreprocessingConfig, Size
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.loader import THREADS, ImageBatch, ImageCache
from crisalad_jax.data.loader import Reading as Reading
from crisalad_jax.data.prepare import Preparation


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

    If images differ in size, a batch holds consecutive images of one size (`Reading.batches`).

    Args:
        paths: image files.
        image_size: height and width in pixels that images are resized to, or from which the size
            rule of `preprocessing` computes the size.
        batch_size: number of images in a batch.
        preprocessing: how images are resized and, for "floats", normalised.
        side_multiple: sides are rounded to multiples of this number of pixels.
        check_size: function that raises InputError for a height and width to refuse.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        threads: number of threads that decode ahead; 0 decodes in the caller's thread.
        cache: cache of decoded images.

    Yields:
        The batches: pixels, indices into `paths`, and which images are valid.

    Raises:
        InputError: immediately, for arguments out of range; while iterating, for an unreadable
            image under "stop".

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
