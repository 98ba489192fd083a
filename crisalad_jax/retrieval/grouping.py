"""Grouping protocols: which images attend to each other in the cross-image encoder.

With such an encoder, the descriptor of an image depends on the images that it attended to. A recall
therefore means nothing without its protocol, for queries and for the database.
"""

import dataclasses
import re
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from crisalad_jax.config.checks import choose, require
from crisalad_jax.utils.shapes import Bool, Int64

GROUPINGS = {
    "single": "each image independently",
    "shuffled": "batches of images in random order",
    "sequential": "batches of images in file order: neighbours help each other",
    "window": "every image with those just before it in file order, as from a moving camera",
}
"""Groupings of one side (queries or database), and what they do. The two sides never mix."""

MASKED = "masked"
"""The batches of `sequential`, in which an image does not attend to others of the same place. This
needs the ground truth, so only an evaluation can use it."""
_WORDS = GROUPINGS | {MASKED: "as sequential, but no image sees another of the same place"}

DEFAULT_GROUPINGS = ("single", "shuffled", "sequential", "window/single")
"""Default groupings; in the last, a robot's latest frames query a map of single images."""


@dataclasses.dataclass(frozen=True)
class Grouping:
    """A protocol: one of `GROUPINGS` or `MASKED` for the queries and one for the database.

    `window` assumes that files are in temporal order. That holds for numbered frames, but not for
    @UTM names, which are sorted by easting. A database under `window` is a map whose images were
    described as they were recorded, each with those just before it.
    """

    queries: str
    database: str
    batch_size: int | None = None
    """Number of images that attend to each other; None is the batch size for reading images."""

    @classmethod
    def parse(cls, text: str) -> "Grouping":
        """Parse "window/single", for queries and database, or "single", for both.

        A number of images may follow, as in "sequential@26"; see `batch_size`.

        Raises:
            InputError: a grouping is unknown, there are more than two, or the size is invalid.
        """
        names, at, size = text.partition("@")
        kinds, expected = names.split("/"), None
        if at and not re.fullmatch("[1-9][0-9]{0,5}", size):
            expected = f"a number of images after @, as in {names}@16"
        elif len(kinds) > 2:
            expected = "one for both sides, or QUERIES/DATABASE"
        elif at and {*kinds} == {"single"}:
            expected = "single without a number of images"
        require(expected is None, f"grouping: found {text!r}, expected {expected}")
        for kind in kinds:
            choose("grouping", kind, _WORDS)
        return cls(kinds[0], kinds[-1], int(size) if at else None)

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        size = "" if self.batch_size is None else f"@{self.batch_size}"
        if self.queries == self.database:
            return self.queries + size
        return f"{self.queries}/{self.database}{size}"


def grouping_words(groupings: Iterable[str]) -> str:
    """Explain groupings, for a note below a table.

    Args:
        groupings: some of `GROUPINGS`, or `MASKED`.

    Returns:
        A clause for each, in order, separated by semicolons.

    Example:
        >>> grouping_words(["single"])
        'single = each image independently'
    """
    return "; ".join(f"{name} = {_WORDS[name]}" for name in groupings)


def parse_groupings(texts: Iterable[str]) -> list[Grouping]:
    """Parse protocols in order, without repeats.

    Raises:
        InputError: `Grouping.parse` does not accept one of them.
    """
    return list(dict.fromkeys(map(Grouping.parse, texts)))


class Batches(NamedTuple):
    """All queries or all database images in batches, and which descriptors to take from each."""

    images: Int64[np.ndarray, "batch place"]
    """Indices of the images at the places (slots) of a batch; padding repeats one of them."""
    filled: Bool[np.ndarray, "batch place"]
    """Whether a place holds an image rather than padding."""
    kept: Bool[np.ndarray, "batch place"]
    """Whether to take the descriptor at a place; each image has exactly one such place."""
    grouping: str
    """One of `GROUPINGS`, or `MASKED`; under "single" each image attends only to itself."""

    def part(self, start: int, stop: int) -> "Batches":
        """Return the batches from `start` to just before `stop`."""
        images, filled, kept = (each[start:stop] for each in self[:3])
        return Batches(images, filled, kept, self.grouping)

    @property
    def attention_mask(self) -> Bool[np.ndarray, "batch place place"]:
        """Whether the image at place i of a batch attends to the one at place j.

        Every image attends to itself, and none to padding.
        """
        seen = self.filled & (self.grouping != "single")
        return seen[:, :, None] & seen[:, None, :] | np.eye(self.images.shape[1], dtype=bool)


def batches_of(count: int, grouping: str, batch_size: int, seed: int = 0) -> Batches:
    """Split `count` images into batches under one of `GROUPINGS`.

    Under `window`, image i has its own batch: the last `batch_size` images up to and including i
    (fewer for the first images). Only the descriptor of i is taken. One long batch with a banded
    mask would not work: over several layers, information from before the window would leak in.

    Args:
        count: number of queries, or of database images.
        grouping: how they are grouped.
        batch_size: number of images that attend to each other.
        seed: random seed of the order in `shuffled`.
    """
    order = np.arange(count)
    if grouping == "window":
        images = order[:, None] + np.arange(1 - batch_size, 1)
        filled = images >= 0
        keep = np.zeros_like(filled)
        keep[:, -1] = True
        return Batches(np.where(filled, images, order[:, None]), filled, keep, grouping)
    if grouping == "shuffled":
        order = np.random.default_rng(seed).permutation(count)
    starts = np.arange(0, count, batch_size)
    places = starts[:, None] + np.arange(batch_size)
    filled = places < count
    # The last batch is padded with its own images, masked out, so that all have one shape.
    sizes = np.minimum(count - starts, batch_size)[:, None]
    wrapped = starts[:, None] + np.arange(batch_size) % sizes
    return Batches(order[wrapped], filled, filled, grouping)
