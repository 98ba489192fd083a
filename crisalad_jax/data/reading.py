"""One record of how images are read, for everything that describes them."""

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Self

from crisalad_jax.config.checks import check_count, check_types
from crisalad_jax.config.preprocessing import Size
from crisalad_jax.config.short_repr import with_field_docs
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.loader import THREADS, ImageBatch, ImageCache, image_batches
from crisalad_jax.data.prepare import Preparation

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
        self,
        paths: Sequence[str | os.PathLike[str]],
        preparation: Preparation,
        check_size: Callable[[Size], None] | None = None,
    ) -> Iterator[ImageBatch]:
        """Yield batches of image files as a model takes them; see `image_batches`.

        Args:
            paths: the files.
            preparation: how the model's images are prepared.
            check_size: raises InputError for a height and width that the model cannot describe.

        Raises:
            InputError: what `image_batches` raises.
        """
        return image_batches(
            paths,
            image_size=preparation.image_size,
            batch_size=self.batch_size,
            preprocessing=preparation.preprocessing,
            side_multiple=preparation.side_multiple,
            check_size=check_size,
            on_bad_image=self.on_bad_image,
            threads=self.threads,
            cache=self.cache,
        )
