"""Grouping protocols: which images look at each other in the cross-image encoder. No model is here.

A descriptor of such a model depends on the images that its own image looked at, so a recall means
nothing without saying which those were, for queries and database apart.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64

from crisalad_jax.config import choose
from crisalad_jax.errors import InputError

GROUPINGS = {
    "single": "every image alone",
    "shuffled": "batches of images in random order",
    "sequential": "batches of images in file order: neighbours help each other",
    "window": "every image with those just before it in file order: what a moving camera has",
}
"""How the images of one side, queries or database, are grouped. The two sides never mix."""

DEFAULT_GROUPINGS = ("single", "shuffled", "sequential", "window/single")
"""The last is what a robot has: its last frames, and a map whose images were described alone."""


@dataclasses.dataclass(frozen=True)
class Grouping:
    """A protocol: one of `GROUPINGS` for the queries and one for the database.

    `window` takes the order of the files for the order in time. That is so of numbered frames;
    @UTM names stand in the order of their eastings. A database by `window` is a map whose images
    were described as they were recorded, one by one on the way.
    """

    queries: str
    database: str

    def __post_init__(self) -> None:
        """Check both.

        Raises:
            InputError: an unknown one.
        """
        for kind in (self.queries, self.database):
            choose("grouping", kind, GROUPINGS)

    @classmethod
    def parse(cls, text: str) -> "Grouping":
        """Read "window/single", queries and database apart, or "single" for both alike.

        Raises:
            InputError: an unknown grouping, or more than two.
        """
        kinds = text.split("/")
        if len(kinds) > 2:
            raise InputError(
                f"grouping: found {text!r}, expected one for both sides, or QUERIES/DATABASE"
            )
        return cls(kinds[0], kinds[-1])

    def __str__(self) -> str:
        """What `parse` reads."""
        if self.queries == self.database:
            return self.queries
        return f"{self.queries}/{self.database}"


def parse_groupings(texts: Iterable[str]) -> list[Grouping]:
    """Read protocols, each once, in their order.

    Raises:
        InputError: what `Grouping.parse` raises.
    """
    return list(dict.fromkeys(map(Grouping.parse, texts)))


def check_grouping(groupings: Sequence[str], batch_size: int, seed: int, seeds: int = 1) -> None:
    """Check how the images of a side are to be grouped, before the work of describing them.

    Raises:
        InputError: one that is not among `GROUPINGS`, a batch of none, a negative seed, or no seed.
    """
    for grouping in groupings:
        choose("grouping", grouping, GROUPINGS)
    numbers = (("batch size", batch_size, 1), ("seed", seed, 0), ("seeds", seeds, 1))
    for name, value, least in numbers:
        if value < least:
            raise InputError(f"{name}: found {value}, expected at least {least}")


class Batches(NamedTuple):
    """All images of a side in batches, and whose descriptor each batch gives."""

    images: Int64[np.ndarray, "batch place"]
    """The images of each batch, by number; a place that is not filled repeats one of them."""
    filled: Bool[np.ndarray, "batch place"]
    kept: Bool[np.ndarray, "batch place"]
    """Whose descriptor is kept: every image has exactly one batch that gives its."""
    mutual: bool
    """Whether the images of a batch look at each other, or each at itself alone."""

    def part(self, start: int, stop: int) -> "Batches":
        """Batches `start` to `stop`."""
        return Batches(
            self.images[start:stop], self.filled[start:stop], self.kept[start:stop], self.mutual
        )

    def looks(self, readable: Bool[np.ndarray, " image"]) -> Bool[np.ndarray, "batch place place"]:
        """Whether the image at place i of a batch looks at the one at place j.

        Each looks at itself. Nobody looks at a place that is not filled, nor at an image that could
        not be read.
        """
        seen = self.filled & readable[self.images] & self.mutual
        return seen[:, :, None] & seen[:, None, :] | np.eye(self.images.shape[1], dtype=bool)


def batches_of(count: int, grouping: str, batch_size: int, seed: int = 0) -> Batches:
    """Batches of images 0 to `count` under one of `GROUPINGS`.

    By `window` image i has a batch of its own, of the last `batch_size` images up to and with i
    (the first images have fewer), and only its own descriptor is kept. One strip with a mask would
    not do: through each of the encoder's layers an image would hear of older ones. So it is as
    many images that look at each other as under the other groupings.

    Args:
        count: images of the side.
        grouping: how they are grouped.
        batch_size: images that look at each other.
        seed: draws the order of `shuffled`.

    Raises:
        InputError: what `check_grouping` raises.
    """
    check_grouping([grouping], batch_size, seed)
    order = np.arange(count)
    if grouping == "window":
        images = order[:, None] + np.arange(1 - batch_size, 1)
        filled = images >= 0
        kept = np.zeros_like(filled)
        kept[:, -1] = True
        return Batches(np.where(filled, images, order[:, None]), filled, kept, mutual=True)
    if grouping == "shuffled":
        order = np.random.default_rng(seed).permutation(count)
    starts = np.arange(0, count, batch_size)
    places = starts[:, None] + np.arange(batch_size)
    filled = places < count
    # A last batch that is not full repeats its images, unseen, so that shapes stay alike.
    wrapped = (
        starts[:, None] + np.arange(batch_size) % np.minimum(count - starts, batch_size)[:, None]
    )
    return Batches(order[wrapped], filled, filled, mutual=grouping != "single")
