"""Descriptors of a moving camera's frames: each with those just before it (grouping `window`)."""

import collections
import itertools
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.retrieval.alone import describe_alone, describe_images
from crisalad_jax.retrieval.describe import FolderTokens, group, tokens_in_batches
from crisalad_jax.retrieval.described import Described
from crisalad_jax.retrieval.model import (
    Model,
    attend_across_images,
    cast_params,
    extract_tokens,
)
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.retrieval.photographs import prepare_image
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float32


def check_window(config: ModelConfig, window: int) -> None:
    """Check a number of frames that are described together.

    Raises:
        InputError: it is below 1, or above in a model whose images do not look at each other.
    """
    if window < 1:
        raise InputError(f"window: found {window}, expected at least 1")
    if window > 1 and not config.cross_image.layers:
        raise InputError(
            f"window: found {window} with a model without a cross-image encoder, expected 1: it "
            "describes every image alone"
        )


def describe_windows(
    params: Model,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    window: int,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    components: Pca | None = None,
) -> Iterator[Described]:
    """Describe images in order, each with the `window - 1` before it, and yield batch by batch.

    The descriptors are those of the grouping `window` (`retrieval.describe.group`) of all images.
    No image looks at one that could not be read. Components shorten the descriptors.

    Raises:
        InputError: an image cannot be read and `on_bad_image` is "stop"; a batch of none.
    """
    before: FolderTokens | None = None
    for tokens, batch in tokens_in_batches(
        params, config, paths, batch_size=batch_size, on_bad_image=on_bad_image
    ):
        new = FolderTokens(*(leaf[batch.indices >= 0] for leaf in tokens))
        known = 0 if before is None else len(before.readable)
        both = new if before is None else FolderTokens(*map(_join, before, new))
        descriptors = group(params, config, both, "window", batch_size=window)[known:]
        if components is not None and new.readable.any():
            descriptors = components.apply(descriptors)
        indices = batch.indices[batch.indices >= 0]
        yield Described(indices[new.readable], descriptors[new.readable], indices[~new.readable])
        before = FolderTokens(*(leaf[1 - window :] for leaf in both))


def describe_sources(
    params: Model,
    config: ModelConfig,
    sources: Sequence[list[pathlib.Path]],
    *,
    window: int,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    components: Pca | None = None,
) -> Iterator[Described]:
    """Describe the images of all sources in order; a window holds images of one source alone.

    Indices count the images of all sources.

    Raises:
        InputError: what `describe_alone` raises.
    """
    options: dict[str, Any] = {
        "batch_size": batch_size,
        "on_bad_image": on_bad_image,
        "components": components,
    }
    if window == 1:
        yield from describe_alone(params, config, list(itertools.chain(*sources)), **options)
        return
    first = 0
    for source in sources:
        for part in describe_windows(params, config, source, window=window, **options):
            yield Described(part.indices + first, part.descriptors, part.unreadable + first)
        first += len(source)


def _join(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.concatenate([first, second])


class FrameDescriber:
    """Describe pictures as they come, each with the `window - 1` before it."""

    def __init__(self, params: Model, config: ModelConfig, window: int = 1) -> None:
        """Start without a picture.

        Raises:
            InputError: what `check_window` raises.
        """
        check_window(config, window)
        self._params, self._config = params, config
        self._cast = cast_params(params, config)
        self._tokens: collections.deque[Tokens] = collections.deque(maxlen=window)

    def __call__(self, image: np.ndarray) -> Float32[np.ndarray, "1 d"]:
        """Describe the next picture: 8-bit RGB or grey, of any size.

        Raises:
            InputError: what `prepare_image` raises.
        """
        window = self._tokens.maxlen or 1
        if window == 1:
            return describe_images(self._params, self._config, [image])
        batch = prepare_image(image, self._config)[None]
        self._tokens.append(jax.device_get(extract_tokens(self._cast, batch, self._config)))
        # The first pictures have fewer before them. One of them is repeated, and not looked at.
        missing = window - len(self._tokens)
        rows = [self._tokens[0]] * missing + list(self._tokens)
        filled = np.arange(window) >= missing
        mask = filled[:, None] & filled | np.eye(window, dtype=bool)
        tokens = jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows)
        described = attend_across_images(self._params, tokens, self._config, mask=mask)
        return np.asarray(described)[-1:]

    def forget(self) -> None:
        """Start again without a picture."""
        self._tokens.clear()
