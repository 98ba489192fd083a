"""CliqueMining, and SAGE's version: groups of images close together, from similar places.

Written from the paper (Izquierdo and Civera, "Close, But Not There: Boosting Geographic Distance
Sensitivity in Visual Place Recognition", ECCV 2024). In the paper, an earlier model describes the
clusters once; here, the model being trained does so when an epoch begins.
"""

import collections
from typing import ClassVar

import numpy as np

from crisalad_jax.config.checks import NonNegativeInt, PositiveFloat, PositiveInt
from crisalad_jax.data.class_groups import Views, known_views, views_of
from crisalad_jax.data.places import Places
from crisalad_jax.data.samplers.base import SAMPLERS, Draw, Sampler
from crisalad_jax.utils.shapes import Float, Int


@SAMPLERS.register("cliques")
class Cliques(Sampler):
    """CliqueMining: groups of images within `radius` of each other and of no other group's images.

    A batch begins with a random place of the set and others of its city; the more similar a place
    looks, the more likely it is drawn. The images of these places are divided into groups. If the
    groups do not fill the batch, it continues with another city.
    """

    describes: ClassVar[bool] = True
    regroups: ClassVar[bool] = True
    radius: PositiveFloat = 25.0
    """Distance in metres: images of one group are closer, images of different groups are not."""
    similar: NonNegativeInt = 15
    """Number of places that are drawn by their similarity to a random place."""

    def check(self, places: Places) -> None:
        """Require positions of all cities.

        Raises:
            InputError: some images have no position, or all images of a city have the same one.
        """
        known_views(places, f"sampler {self.part_name}", headings=False)

    def apply(self, places: Places, draw: Draw) -> Int[np.ndarray, "steps places images"]:
        """Return as many batches as would use every place once; fewer if some cannot be filled."""
        views = views_of(places)
        steps = max(1, len(places.names) // draw.places_per_batch)
        batches = (self._batch(places, views, draw) for _ in range(steps))
        full = [batch for batch in batches if batch is not None]
        size = draw.places_per_batch, draw.images_per_place
        return np.array(full, np.int64).reshape(-1, *size)

    def _batch(
        self, places: Places, views: Views, draw: Draw
    ) -> Int[np.ndarray, "places images"] | None:
        """Draw a batch; None if all places together do not fill one."""
        points = np.column_stack([views.east, views.north])
        left, in_new_city = np.ones((2, len(places.names)), bool)
        groups: list[np.ndarray] = []
        taken: dict[int, list[np.ndarray]] = collections.defaultdict(list)
        """Positions of the groups' images, by city."""
        while left.any():
            some = in_new_city if in_new_city.any() else left
            first = self._first(np.flatnonzero(some), places, draw)
            city = int(places.place_city[first])
            in_city = places.place_city == city
            in_new_city &= ~in_city
            drawn = self._similar(first, np.flatnonzero(left & in_city), draw)
            left[drawn] = False
            starts, ends = places.place_start[drawn], places.place_start[drawn + 1]
            images = np.concatenate(list(map(np.arange, starts, ends)))
            for others in taken[city]:
                apart = _distances(points[images], others) >= self.radius
                images = images[apart.all(axis=1)]
            images = draw.generator.permutation(images)
            for clique in _cliques(points[images], self.radius, draw.images_per_place):
                groups.append(draw.generator.choice(images[clique], draw.images_per_place, False))
                taken[city].append(points[images[clique]])
                if len(groups) == draw.places_per_batch:
                    return np.array(groups)
        return None

    def _first(self, among: Int[np.ndarray, " place"], places: Places, draw: Draw) -> int:
        """Draw the place that a city's part of a batch begins with."""
        return draw.generator.choice(among)

    def _similar(
        self, first: int, others: Int[np.ndarray, " place"], draw: Draw
    ) -> Int[np.ndarray, " place"]:
        """Draw places by how similar their descriptors are to that of `first`, and add `first`."""
        others = others[others != first]
        difference = draw.descriptors[others] - draw.descriptors[first]
        distances = np.sqrt((difference * difference).sum(axis=1))
        # A place whose image cannot be read is as far as the farthest, and so is not drawn.
        farthest = np.nan_to_num(distances).max(initial=0)
        likeness = farthest - np.nan_to_num(distances, nan=farthest)
        if not likeness.any():
            likeness = np.ones(len(others))
        count = min(self.similar, int(np.count_nonzero(likeness)))
        if count == 0:
            return np.array([first])
        shares = likeness / likeness.sum()
        return np.append(draw.generator.choice(others, count, replace=False, p=shares), first)


@SAMPLERS.register("geo-visual")
class GeoVisual(Cliques):
    """Cliques of a neighbourhood that grows greedily from a place that looks like many others.

    Written from the abstract of SAGE (Chen et al., ICLR 2026), whose training code is not
    published: its graph is rebuilt before each epoch from the positions of images and how similar
    they look to the current model; clusters begin at anchors of high affinity, and expand by a
    greedy weighted clique. The default values are ours.
    """

    anchors: PositiveInt = 16
    """Number of random candidates for the first place. The candidate with the largest affinity, a
    sum of similarities to the `similar` most similar places of its city, is taken."""

    def _first(self, among: Int[np.ndarray, " place"], places: Places, draw: Draw) -> int:
        drawn = draw.generator.choice(among, min(self.anchors, len(among)), replace=False)
        affinities = []
        for place in drawn:
            others = np.flatnonzero(places.place_city == places.place_city[place])
            alike = _alike(draw, others[others != place], int(place))
            affinities.append(np.sort(alike)[::-1][: self.similar].sum())
        return int(drawn[np.argmax(affinities)])

    def _similar(
        self, first: int, others: Int[np.ndarray, " place"], draw: Draw
    ) -> Int[np.ndarray, " place"]:
        """Add the place that is most similar to all chosen ones, one at a time."""
        others = others[others != first]
        chosen, total = [first], np.zeros(len(others))
        for _ in range(min(self.similar, len(others))):
            total += _alike(draw, others, chosen[-1])
            chosen.append(int(others[total.argmax()]))
            total[total.argmax()] = -np.inf
        return np.array(chosen)


def _alike(
    draw: Draw, others: Int[np.ndarray, " place"], place: int
) -> Float[np.ndarray, " place"]:
    """Return the similarity of places to one, from -1 to 1; -1 if an image cannot be read."""
    return np.nan_to_num(draw.descriptors[others] @ draw.descriptors[place], nan=-1.0)


def _cliques(
    points: Float[np.ndarray, "image 2"], radius: float, size: int
) -> list[Int[np.ndarray, " clique"]]:
    """Find groups of at least `size` points within a radius of each other, but of no other group.

    A group starts at the first remaining point and adds the nearest point within the radius of all
    its members until it is maximal; then its neighbours are left out.
    """
    distances = _distances(points, points)
    found, left = [], np.ones(len(points), bool)
    for first in range(len(points)):
        clique, fitting = [], left & (distances[first] < radius)
        while left[first] and fitting.any():
            nearest = int(np.where(fitting, distances[first], np.inf).argmin())
            clique.append(nearest)
            fitting &= distances[nearest] < radius
            fitting[nearest] = False
        if len(clique) >= size:
            found.append(np.array(clique))
            left &= (distances[clique] >= radius).all(axis=0)
    return found


def _distances(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "n m"]:
    """Compute distances in metres."""
    return np.linalg.norm(points[:, None] - others, axis=-1)
