"""Descriptors of images that are each described alone: of files, or of pictures in memory."""

import os
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from crisalad_jax.config.checks import takes
from crisalad_jax.data.loader import ImageCache, OnBadImage
from crisalad_jax.data.resize import Pixels
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.describe import group, tokens_in_batches
from crisalad_jax.retrieval.described import Described
from crisalad_jax.retrieval.grouping import check_grouping, useful_batch_size
from crisalad_jax.retrieval.model import Model, check_params, describe_each
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.retrieval.photographs import prepare_image
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Float32


def describe_alone(
    params: Model,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    components: Pca | None = None,
    cache: ImageCache | None = None,
) -> Iterator[Described]:
    """Describe images in order, each as if it were alone, and yield batch by batch.

    The descriptors equal those of the grouping `single` (`retrieval.describe.group`). Two batches
    are in memory, and the images that are read ahead. Components shorten whole batches, so that no
    descriptor's bits depend on the batch's others.

    Raises:
        InputError: an image cannot be read and `on_bad_image` is "stop"; a batch of none.
    """
    stream = tokens_in_batches(
        params, config, paths, batch_size=batch_size, on_bad_image=on_bad_image, cache=cache
    )
    for tokens, batch in stream:
        descriptors = group(params, config, tokens, "single", batch_size=batch_size)
        if components is not None and batch.valid.any():
            descriptors = components.apply(descriptors)
        unreadable = (batch.indices >= 0) & ~batch.valid
        yield Described(
            batch.indices[batch.valid], descriptors[batch.valid], batch.indices[unreadable]
        )


def describe_files(
    params: Model,
    config: ModelConfig,
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    batch_size: int = 16,
    quiet: bool = True,
) -> Float32[np.ndarray, "image descriptor"]:
    """Describe image files, each as if it were alone.

    Files are decoded upright and resized as `config` says, which is all that a descriptor depends
    on. `extract` does the same for folders, and writes files.

    Args:
        params: the model's parameters.
        config: the model.
        files: an image file, or a list of them.
        batch_size: number of images described together.
        quiet: whether to show no progress bar.

    Returns:
        A descriptor of each file, in order.

    Raises:
        InputError: no files, one that cannot be read, a batch of none, or parameters that are not
            of the configuration.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> describe_files(params, config, pictures / "0.png").shape
        (1, 576)
    """
    check_params(params, config)
    check_grouping((), batch_size, seed=0)
    given = [files] if isinstance(files, str | os.PathLike) else files
    paths = [pathlib.Path(file) for file in given]
    if not paths:
        raise InputError("files: found none, expected at least one image file")
    batch_size = useful_batch_size(batch_size, len(paths))
    parts = []
    with progress_bar("images", len(paths), "images", quiet=quiet) as bar:
        for part in describe_alone(params, config, paths, batch_size=batch_size):
            parts.append(part.descriptors)
            bar.advance(len(part.indices))
    return np.concatenate(parts)


@takes(config=ModelConfig)
def describe_images(
    params: Model,
    config: ModelConfig,
    images: Sequence[np.ndarray],
    *,
    batch_size: int = 16,
) -> Float32[np.ndarray, "image descriptor"]:
    """Describe pictures in memory, each as if it were alone.

    A batch is padded to a power of two, so that few programs are compiled, and one picture costs
    one. The values differ from those of `describe_files` by the rounding of other batch sizes.

    Args:
        params: the model's parameters.
        config: the model; pictures are resized as it says.
        images: 8-bit RGB, of any sizes, as `read_image` returns them, or grey; see
            `prepare_image`.
        batch_size: largest number of images described together.

    Returns:
        A descriptor of each picture, in order.

    Raises:
        InputError: no pictures; one that `prepare_image` does not take or that the model cannot
            describe; a batch of none.

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> describe_images(params, config, [np.zeros((60, 80, 3), np.uint8)]).shape
        (1, 576)
    """
    check_grouping((), batch_size, seed=0)
    if isinstance(images, np.ndarray) and images.ndim in (2, 3):
        raise InputError(
            f"images: found one array of shape {images.shape}, expected a list of pictures"
        )
    if not len(images):
        raise InputError("images: found none, expected at least one picture")
    for image in images:
        if not isinstance(image, np.ndarray):
            raise InputError(
                f"images: found {type(image).__name__}, expected pictures as of `read_image` "
                "(`describe_files` takes files)"
            )
    prepared = [prepare_image(image, config) for image in images]
    return describe_prepared(params, config, prepared, batch_size=batch_size)


def describe_prepared(
    params: Model, config: ModelConfig, prepared: Sequence[Pixels], *, batch_size: int
) -> Float32[np.ndarray, "image descriptor"]:
    """Describe pictures of `prepare_image`, each as if it were alone; see `describe_images`."""
    by_shape: dict[tuple[int, ...], list[int]] = {}
    for number, image in enumerate(prepared):
        by_shape.setdefault(image.shape, []).append(number)
    descriptors = np.empty((len(prepared), config.descriptor_dim), np.float32)
    for numbers in by_shape.values():
        for start in range(0, len(numbers), batch_size):
            part = numbers[start : start + batch_size]
            count = min(batch_size, 1 << (len(part) - 1).bit_length())
            batch = np.stack([prepared[part[i % len(part)]] for i in range(count)])
            descriptors[part] = describe_each(params, batch, config)[: len(part)]
    return descriptors
