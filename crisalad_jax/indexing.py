"""From folders of images to maps: each image described alone, in streams of bounded memory."""

import pathlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from crisalad_jax.config import ModelConfig
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.data.positions import Positions
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import group, tokens_in_batches
from crisalad_jax.maps import Map
from crisalad_jax.model import Crisalad
from crisalad_jax.progress import progress_bar

SEGMENT = 256
"""Images appended together: so many are described again, at most, after a kill."""


class Described(NamedTuple):
    """Descriptors of a few images."""

    indices: Int64[np.ndarray, " n"]
    """Of those that could be read, in the list of paths."""
    descriptors: Float32[np.ndarray, "n d"]
    unreadable: Int64[np.ndarray, " _"]


def describe_alone(
    params: Crisalad,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
) -> Iterator[Described]:
    """Descriptors of images, each as if it were alone, a batch at a time and in order.

    The numbers are those of the grouping `single` (`evaluation.group`). Two batches are in memory,
    and images that are read ahead.

    Raises:
        InputError: an image cannot be read and `on_bad_image` is "stop"; a batch of none.
    """
    stream = tokens_in_batches(
        params, config, paths, batch_size=batch_size, on_bad_image=on_bad_image
    )
    for tokens, batch in stream:
        descriptors = group(params, config, tokens, "single", batch_size=batch_size)
        unreadable = (batch.indices >= 0) & ~batch.valid
        yield Described(
            batch.indices[batch.valid], descriptors[batch.valid], batch.indices[unreadable]
        )


class Indexed(NamedTuple):
    """What became of the images of a folder."""

    added: int
    there: int
    """Images that the map had already."""
    positions: int
    """Images of those added whose position is known."""
    stay: int
    """Positions given of images that the map had already, which it keeps as it has them."""
    unreadable: list[str]


def index_images(
    target: Map,
    params: Crisalad,
    root: pathlib.Path,
    paths: Sequence[pathlib.Path],
    *,
    positions: Positions,
    batch_size: int = 16,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> Indexed:
    """Describe images as the map is described, and append them, `SEGMENT` at a time.

    Those whose names the map has are left out, so that the same call goes on after a kill.

    Args:
        target: open for appending.
        params: the map's model.
        root: the folder that names are relative to.
        paths: images in `root`.
        positions: by name, as far as known.
        batch_size: images described at once.
        on_bad_image: whether an image that cannot be read ends it, or is left out.
        quiet: no progress bar.

    Raises:
        InputError: an image cannot be read; a name in the map is of another picture here; or what
            `Map.append` raises.
    """
    config = target.description.config
    names, sizes, new = [], [], []
    for path in paths:
        name, size = path.relative_to(root).as_posix(), path.stat().st_size
        if (known := target.image(name)) is None:
            names.append(name)
            sizes.append(size)
            new.append(path)
        elif known.bytes != size:
            raise InputError(
                f"{path}: found {size} bytes, but the map has {name!r} of {known.bytes} bytes from "
                f"{known.root}, expected new names for new pictures"
            )
    target.axes_of(names, positions)  # before any work
    stay = sum(target.image(name) is not None for name in positions.of)
    waiting: list[Described] = []
    unreadable: list[str] = []

    def append() -> None:
        chosen = [int(i) for part in waiting for i in part.indices]
        if chosen:
            target.append(
                [names[i] for i in chosen],
                [sizes[i] for i in chosen],
                np.concatenate([part.descriptors for part in waiting]),
                root=root.resolve().as_posix(),
                positions=positions,
            )
        waiting.clear()

    there = len(target)
    stream = describe_alone(params, config, new, batch_size=batch_size, on_bad_image=on_bad_image)
    with progress_bar(
        "images", len(paths), "images", quiet=quiet, done=len(paths) - len(new)
    ) as bar:
        for part in stream:
            waiting.append(part)
            unreadable += [names[i] for i in part.unreadable]
            bar.advance(len(part.indices) + len(part.unreadable))
            if sum(len(part.indices) for part in waiting) >= SEGMENT:
                append()
        append()
    added = target.images[there:]
    return Indexed(
        added=len(added),
        there=len(paths) - len(new),
        positions=sum(image.position is not None for image in added),
        stay=stay,
        unreadable=unreadable,
    )
