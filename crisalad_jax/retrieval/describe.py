"""Descriptors of whole folders: of each image alone, or of images that attend to each other."""

import functools
import pathlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int64

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.loader import ImageBatch, ImageCache, OnBadImage
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.retrieval.grouping import (
    Batches,
    batches_of,
)
from crisalad_jax.retrieval.model import (
    Model,
    attend_across_images,
    cast_params,
    check_groupings,
    extract_tokens,
)
from crisalad_jax.retrieval.photographs import photograph_batches
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.progress import progress_bar


@brief
class FolderTokens(NamedTuple):
    """Tokens of many images on the host (see `Tokens`), and which images could be read."""

    global_tokens: Float[np.ndarray, "image global_dim"]
    local: Float[np.ndarray, "image token dim"]
    readable: Bool[np.ndarray, " image"]

    def of(self, images: Int64[np.ndarray, " n"]) -> Tokens:
        """Return the tokens of some images, by number."""
        return Tokens(jnp.asarray(self.global_tokens[images]), jnp.asarray(self.local[images]))


class HeldTokens(Protocol):
    """The tokens of many images, in memory or in files."""

    @property
    def readable(self) -> Bool[np.ndarray, " image"]:
        """Whether each image could be read."""
        ...

    def of(self, images: Int64[np.ndarray, " n"]) -> Tokens:
        """Return the tokens of some images, by number."""
        ...


def read_tokens(
    params: Model,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    label: str,
    on_bad_image: OnBadImage = "stop",
    cache: ImageCache | None = None,
    quiet: bool = False,
) -> FolderTokens:
    """Read images, resized as `config` says, and extract their tokens in order.

    Raises:
        InputError: an image cannot be read, and `on_bad_image` is "stop".
    """
    parts: list[tuple[np.ndarray, ...]] = []
    stream = tokens_in_batches(
        params, config, paths, batch_size=batch_size, on_bad_image=on_bad_image, cache=cache
    )
    with progress_bar(label, len(paths), "images", quiet=quiet) as bar:
        for tokens, batch in stream:
            used = int((batch.indices >= 0).sum())
            parts.append(tuple(leaf[:used] for leaf in tokens))
            bar.advance(used)
    return FolderTokens(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def tokens_in_batches(
    params: Model,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    cache: ImageCache | None = None,
) -> Iterator[tuple[FolderTokens, ImageBatch]]:
    """Yield the tokens of images in order, batch by batch; the last batch is padded, and so
    is each before a change of size.

    Each comes with the batch of images it was made of. Two batches are in memory, and the images
    that are read ahead.

    Raises:
        InputError: an image cannot be read and `on_bad_image` is "stop"; a batch of none.
    """
    batches = photograph_batches(
        config, paths, batch_size=batch_size, on_bad_image=on_bad_image, cache=cache
    )
    if isinstance(params, Runtime):
        for batch in batches:
            rows = params.tokens(batch.images)
            none = np.empty((len(rows), 0, 0), np.float32)
            yield FolderTokens(rows, none, batch.valid), batch
        return
    devices = devices_for(batch_size)
    params = devices.replicate(cast_params(params, config))

    def back(tokens: Tokens, batch: ImageBatch) -> tuple[FolderTokens, ImageBatch]:
        global_tokens, local = jax.device_get((tokens.global_token, tokens.local))
        return FolderTokens(global_tokens, local, batch.valid), batch

    ahead = None
    for batch in batches:
        tokens = extract_tokens(params, devices.shard_batch(batch.images), config)
        # The previous batch is fetched while the device computes this one.
        if ahead is not None:
            yield back(*ahead)
        ahead = (tokens, batch)
    if ahead is not None:
        yield back(*ahead)


def group(
    params: Model,
    config: ModelConfig,
    folder: HeldTokens,
    grouping: str,
    *,
    batch_size: int,
    seed: int = 0,
    label: str = "images",
    quiet: bool = True,
) -> Float[np.ndarray, "image descriptor"]:
    """Describe all images, in their order, under one of `GROUPINGS`.

    No image attends to one that could not be read; the rows of such images are meaningless.

    Raises:
        InputError: what `check_grouping` raises.
    """
    descriptors = np.empty((len(folder.readable), config.descriptor_dim), np.float32)
    options = {"batch_size": batch_size, "seed": seed, "label": label, "quiet": quiet}
    for images, rows in described(params, config, folder, grouping, **options):
        descriptors[images] = rows
    return descriptors


def described(
    params: Model,
    config: ModelConfig,
    folder: HeldTokens,
    grouping: str,
    *,
    batch_size: int,
    seed: int = 0,
    label: str = "images",
    quiet: bool = True,
) -> Iterator[tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n descriptor"]]]:
    """Yield the descriptors of `group` some at a time, each lot with its images' numbers.

    Raises:
        InputError: what `check_grouping` raises.
    """
    check_groupings(params, config, [grouping])
    count = len(folder.readable)
    batches = batches_of(count, grouping, batch_size, seed)
    # A window gives one descriptor, so `batch_size` windows are computed at a time.
    step = batch_size if grouping == "window" else 1
    # The other groupings take little time compared with the backbone: they need no bar.
    silent = quiet or grouping != "window"
    with progress_bar(f"{label}, {grouping}", count, "images", quiet=silent) as bar:
        for start in range(0, len(batches.images), step):
            part = batches.part(start, start + step)
            relate_part = _relate_windows if grouping == "window" else _relate_batch
            images = part.images[part.kept]
            yield images, relate_part(params, config, folder, part)
            bar.advance(len(images))


def _relate_batch(
    params: Model, config: ModelConfig, folder: HeldTokens, batch: Batches
) -> Float[np.ndarray, "image descriptor"]:
    """Describe the images of one batch."""
    (images,), (kept_places,), (mask,) = batch.images, batch.kept, batch.looks(folder.readable)
    tokens = folder.of(images)
    return np.asarray(attend_across_images(params, tokens, config, mask=mask))[kept_places]


def _relate_windows(
    params: Model, config: ModelConfig, folder: HeldTokens, windows: Batches
) -> Float[np.ndarray, "window descriptor"]:
    """Describe the last image of each of some windows."""
    if isinstance(params, Runtime):
        pairs = zip(windows.images, windows.looks(folder.readable), strict=True)
        lasts = [
            attend_across_images(params, folder.of(images), config, mask=mask)[-1]
            for images, mask in pairs
        ]
        return np.stack(lasts)
    width = windows.images.shape[1]
    # Windows overlap, so each image goes to the device once. Shapes are always those of `width`
    # windows, for one compilation.
    images, places = np.unique(windows.images, return_inverse=True)
    images = np.resize(images, 2 * width - 1)
    rows = np.arange(width) % len(windows.images)
    descriptors = _relate_last(
        params,
        folder.of(images),
        jnp.asarray(places.reshape(windows.images.shape)[rows]),
        jnp.asarray(windows.looks(folder.readable)[rows]),
        config,
    )
    return np.asarray(descriptors)[: len(windows.images)]


@functools.partial(compiler.jit, static_argnames="config")
def _relate_last(
    params: Crisalad,
    tokens: Tokens,
    places: Int[Array, "window place"],
    masks: Bool[Array, "window place place"],
    config: ModelConfig,
) -> Float[Array, "window descriptor"]:
    def last(places: Int[Array, " place"], mask: Bool[Array, "place place"]) -> Array:
        window = jax.tree.map(lambda leaf: leaf[places], tokens)
        return attend_across_images(params, window, config, mask=mask)[-1]

    return jax.vmap(last)(places, masks)
