"""EigenPlaces' classes as places, for pair losses (Berton et al., ICCV 2023)."""

import collections
import functools
from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from crisalad_jax.config.checks import PositiveFloat, PositiveInt
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.class_groups import Class, find_classes, known_views
from crisalad_jax.data.places import Places
from crisalad_jax.data.samplers.base import SAMPLERS, Draw, Sampler
from crisalad_jax.utils.shapes import Int

_SIDES = ("lateral", "frontal")


@SAMPLERS.register("viewpoints")
class Viewpoints(Sampler):
    """Places made of images that look at one point from different positions in a street.

    The places of a batch are classes of one of EigenPlaces' groups, none of which are neighbours.
    MegaLoc trains on both sides at once, each in its own sub-batch.
    """

    regroups: ClassVar[bool] = True
    side: Literal["lateral", "frontal"] = "lateral"
    """Where the point is: "lateral" is across the street, "frontal" along it."""
    cell: PositiveFloat = 15.0
    """Width of a square cell in metres; its images make at most one class of each `side`."""
    spacing: PositiveInt = 3
    """Smallest distance in cells between the cells of two classes in a batch."""
    focal_distance: PositiveFloat = 10.0
    """Metres from the mean of a cell's positions to the point."""
    view_angle: PositiveFloat = 45.0
    """Largest angle in degrees between an image's heading and the direction to the point."""

    def check(self, places: Places) -> None:
        """Require positions and headings of all images.

        Raises:
            InputError: some images have no position or no heading.
        """
        known_views(places, f"sampler {self.part_name}", headings=True)

    def apply(self, places: Places, draw: Draw) -> Int[np.ndarray, "steps places images"]:
        """Return batches that use each class once, except for the remainder of each group."""
        groups: dict[int, list[np.ndarray]] = collections.defaultdict(list)
        for each in self._classes(places, draw.images_per_place):
            groups[each.group].append(each.images)
        size, count = (draw.places_per_batch, draw.images_per_place)
        batches = [
            [draw.generator.choice(members[number], count, replace=False) for number in batch]
            for members in groups.values()
            for batch in draw.generator.permutation(len(members))[
                : len(members) // size * size
            ].reshape(-1, size)
        ]
        return draw.generator.permutation(np.array(batches, np.int64).reshape(-1, size, count))

    def _classes(self, places: Places, min_images: int) -> Sequence[Class]:
        """Find the classes of a side."""
        config = ClassesConfig(
            kind="viewpoints",
            cell=self.cell,
            spacing=self.spacing,
            focal_distance=self.focal_distance,
            view_angle=self.view_angle,
        )
        return _found(places, config, min_images)[_SIDES.index(self.side)]


@functools.lru_cache(maxsize=4)
def _found(places: Places, config: ClassesConfig, min_images: int) -> Sequence[Sequence[Class]]:
    """Find the classes of both sides (cached: an epoch may draw from them several times)."""
    return find_classes(places, config, min_images)
