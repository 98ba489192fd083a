"""Descriptors of files by another engine than JAX, which is not imported."""

import pathlib
from collections.abc import Iterator, Sequence

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.data.loader import OnBadImage, image_batches
from crisalad_jax.retrieval.described import Described
from crisalad_jax.retrieval.pca import Pca


def describe_by_engine(
    runtime: Runtime,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    components: Pca | None = None,
) -> Iterator[Described]:
    """Describe images in order, each as if it were alone, and yield batch by batch.

    Args:
        runtime: the model.
        paths: the image files.
        batch_size: images described at once.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        components: shorten the descriptors.

    Yields:
        The descriptors, as `alone.describe_alone` does.

    Raises:
        InputError: an image cannot be read and `on_bad_image` is "stop"; a batch of none.
    """
    how = runtime.preparation
    batches = image_batches(
        paths,
        image_size=how.image_size,
        batch_size=batch_size,
        preprocessing=how.preprocessing,
        side_multiple=how.side_multiple,
        on_bad_image=on_bad_image,
    )
    for batch in batches:
        descriptors = runtime.describe(batch.images[batch.valid])
        if components is not None and len(descriptors):
            descriptors = components.apply(descriptors)
        unreadable = (batch.indices >= 0) & ~batch.valid
        yield Described(batch.indices[batch.valid], descriptors, batch.indices[unreadable])
