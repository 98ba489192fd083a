"""Classes of images, in groups, to train a descriptor by classification (CosPlace, EigenPlaces).

Two classes of one group are never neighbours, so images of one spot never belong to two classes of
a group. Each group is a separate training set (`Places`) whose places are the classes.
"""

import collections
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.metres import continuous, to_metres
from crisalad_jax.data.places import Places
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool, Float64, Int32, Int64

_WIDEST = 60.0
"""Widest city in degrees of longitude; a wider plane stretches distances by over 15 %."""
_ADVICE = "; --loss.kind.classes.kind places uses the set's places as classes"
_ONE_SPOT = 1e-3
"""Smallest spread in metres of a cell's images that shows the direction of a street."""


class Views(NamedTuple):
    """City index, position (metres in one UTM zone per city) and heading of every image."""

    city: Int32[np.ndarray, " images"]
    east: Float64[np.ndarray, " images"]
    north: Float64[np.ndarray, " images"]
    """UTM north in metres; negative south of the equator, where maps add 10,000 km."""
    heading: Float64[np.ndarray, " images"]
    """Heading in degrees clockwise from north, 0 to 360; NaN where unknown."""
    known: Bool[np.ndarray, " cities"]
    """Whether a city's positions are real; False if all its images have the same position."""


def views_of(places: Places) -> Views:
    """Return the views of a set's images; a city's UTM zone is that of its median longitude.

    Raises:
        InputError: a city spans more than 60 degrees of longitude, too wide for one plane.
    """
    count = len(places.files)
    latitude, longitude, heading = (
        np.zeros((count, 3)) if places.views is None else places.views
    ).T
    city = places.place_city[places.image_place]
    east, north = np.empty(count), np.empty(count)
    known = np.ones(len(places.cities), bool)
    for number in np.unique(city):
        of = city == number
        here = continuous(longitude[of])
        if (wide := np.ptp(here)) > _WIDEST:
            raise InputError(
                f"{places.root}: found the images of {places.cities[number]} over {wide:.0f} "
                f"degrees of longitude, expected at most {_WIDEST:g}, as cells lie in one plane: "
                "a set of several cities needs a column city, or no columns lat,lon"
            )
        known[number] = np.ptp(latitude[of]) > 0 or np.ptp(here) > 0
        east[of], north[of] = to_metres(latitude[of], here)
    return Views(city, east, north, heading % 360, known)


def known_views(places: Places, what: str, *, headings: bool) -> Views:
    """Return `views_of` a set if all images have a position and, with `headings`, a heading.

    Raises:
        InputError: an image lacks one (the message says `what` needs it), or a city is too wide.
    """
    views = views_of(places)
    needed, column = ("headings, or no positions", ",heading") if headings else ("positions", "")
    require(
        bool(views.known.all() and not (headings and np.isnan(views.heading).any())),
        f"{places.root}: found no {needed}, or one position for all images of a city, expected a "
        f"table name,place,lat,lon{column} or the layout of GSV-Cities, for {what}",
    )
    return views


class Class(NamedTuple):
    """The indices of the images of one class; an image may belong to no class."""

    images: Int64[np.ndarray, " images"]
    group: int
    """Number of its group; classes of one group are not neighbours."""


def class_groups(
    places: Places, config: ClassesConfig, *, min_images: int, places_per_batch: int
) -> tuple[Places, ...]:
    """Make the groups that successive epochs train on, as sets whose places are classes.

    At most `config.groups` groups are used: those with the most classes. The kind "viewpoints"
    gives up to twice as many: lateral and frontal groups alternate.

    Args:
        places: the training set, read with `min_images=1` unless its places are the classes.
        config: how images are grouped into classes.
        min_images: classes with fewer images are left out.
        places_per_batch: smallest number of classes that a group may have.

    Raises:
        InputError: required positions are missing, no class has enough images, or a group has fewer
            classes than a batch needs.
    """
    chosen: list[list[list[Class]]] = []
    for classes in find_classes(places, config, min_images):
        groups: dict[int, list[Class]] = collections.defaultdict(list)
        for each in sorted(classes, key=lambda each: each.group):
            groups[each.group].append(each)
        # The largest first; ties go to the lower number.
        chosen.append(sorted(groups.values(), key=len, reverse=True)[: config.groups])
        fewest = len(chosen[-1][-1]) if groups else 0
        if fewest < places_per_batch:
            raise InputError(
                f"{places.root}: found {fewest} classes of at least {min_images} images in the "
                f"smallest of {len(chosen[-1])} groups, expected places_per_batch "
                f"{places_per_batch}; lower --loss.kind.classes.groups to drop small ones{_ADVICE}"
            )
    turns = zip(*chosen)  # noqa: B905, to take equally many of each set
    return tuple(_regrouped(places, group) for turn in turns for group in turn)


def find_classes(places: Places, config: ClassesConfig, min_images: int) -> list[list[Class]]:
    """Make one set of classes or, for the kind "viewpoints", a lateral and a frontal one."""
    if config.kind == "places":
        return [_place_classes(places, views_of(places), config, min_images)]
    what = f"loss.kind.classes.kind {config.kind!r}{_ADVICE}"
    views = known_views(places, what, headings=True)
    if config.kind == "cells":
        return [cell_classes(views, config, min_images)]
    return focal_classes(views, config, min_images)


def cell_classes(views: Views, config: ClassesConfig, min_images: int) -> list[Class]:
    """Make CosPlace's classes by square cell and sector of headings (Berton et al. 2022, sec. 3).

    Two classes of a group are at least `spacing - 1` cells, or `sector_spacing - 1` sectors, apart.
    """
    sector = np.floor(views.heading / config.sector).astype(np.int64)
    group, keys = _cells(views, config)
    group = group * config.sector_spacing + sector % config.sector_spacing
    return _by_key(np.column_stack([keys, sector]), group, min_images)


def focal_classes(views: Views, config: ClassesConfig, min_images: int) -> list[list[Class]]:
    """Make EigenPlaces' lateral and frontal classes of square cells (Berton et al. 2023, sec. 3).

    The first principal direction of a cell's positions is the direction of its street. A class
    looks at one focal point, `focal_distance` from the mean position: across the street (lateral)
    or along it (frontal). The paper crops images from panoramas. Here an image belongs to the class
    if its heading is within `view_angle` of the direction from its position to the focal point. Of
    the two focal points on each line, the one that more images look at is used.
    """
    group, keys = _cells(views, config)
    sides: list[list[Class]] = [[], []]
    for cell in _by_key(keys, group, min_images):
        positions = np.column_stack([views.east[cell.images], views.north[cell.images]])
        points = focal_points(positions, config.focal_distance)
        if points is None:
            continue
        east, north = np.moveaxis(points[:, :, None] - positions, -1, 0)
        turn = np.rad2deg(np.arctan2(east, north)) - views.heading[cell.images]
        looks = np.abs((turn + 180) % 360 - 180) <= config.view_angle
        for side, of_signs in zip(sides, looks, strict=True):
            looking = of_signs[of_signs.sum(axis=1).argmax()]
            if looking.sum() >= min_images:
                side.append(Class(cell.images[looking], cell.group))
    return sides


def focal_points(
    positions: Float64[np.ndarray, "images 2"], distance: float
) -> Float64[np.ndarray, "side sign 2"] | None:
    """Compute a cell's lateral and frontal focal points, two each; None if positions coincide."""
    mean = positions.mean(axis=0)
    _, spread, directions = np.linalg.svd(positions - mean, full_matrices=False)
    if spread[0] < _ONE_SPOT:
        return None
    # SVD leaves the signs open: make each direction's larger component positive.
    directions = (
        directions * np.sign(directions[[0, 1], np.abs(directions).argmax(axis=1)])[:, None]
    )
    ways = np.array([1.0, -1.0])
    return mean + distance * ways[None, :, None] * directions[::-1, None]


def _place_classes(
    places: Places, views: Views, config: ClassesConfig, min_images: int
) -> list[Class]:
    """Assign the set's places to groups; if positions are known, no group has two neighbours.

    A place that has a neighbour in every group gets no class.
    """
    from scipy.spatial import KDTree  # the import takes a fifth of a second

    group = np.full(len(places.names), -1)
    is_large = places.image_counts >= min_images
    start = places.place_start
    points = np.column_stack([views.east, views.north])
    centres = np.add.reduceat(points, start[:-1], axis=0) / places.image_counts[:, None]
    for city, known in enumerate(views.known):
        here = np.flatnonzero(is_large & (places.place_city == city))
        near: Sequence[Any] = [[]] * len(here)
        if places.near is not None:
            near = [places.near[place] for place in here]
        elif known and len(here):
            tree = KDTree(centres[here])
            found = tree.query_ball_point(centres[here], config.cell * (config.spacing - 1))
            near = [here[others] for others in found]
        sizes = np.zeros(config.groups, np.int64)
        for place, others in zip(here, near, strict=True):
            free = np.setdiff1d(np.arange(config.groups), group[others])
            if len(free):
                group[place] = free[sizes[free].argmin()]
                sizes[group[place]] += 1
    return [
        Class(np.arange(start[place], start[place + 1]), int(group[place]))
        for place in np.flatnonzero(group >= 0)
    ]


def _cells(
    views: Views, config: ClassesConfig
) -> tuple[Int64[np.ndarray, " images"], Int64[np.ndarray, "images 3"]]:
    """Return the group of each image, and its city and cell."""
    cells = np.floor(np.stack([views.east, views.north]) / config.cell).astype(np.int64)
    east, north = cells % config.spacing
    return east * config.spacing + north, np.column_stack([views.city, *cells])


def _by_key(
    keys: Int64[np.ndarray, "images key"], group: Int64[np.ndarray, " images"], min_images: int
) -> list[Class]:
    """Make one class from the images of each key, ordered by key."""
    _, number, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(number.reshape(-1), kind="stable")
    members = np.split(order, np.cumsum(counts)[:-1])
    return [Class(each, int(group[each[0]])) for each in members if len(each) >= min_images]


def _regrouped(places: Places, classes: Sequence[Class]) -> Places:
    """Return the classes of one group as places, numbered within each city."""
    counts = [len(each.images) for each in classes]
    images = np.concatenate([each.images for each in classes])
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    old = places.image_place[images[start[:-1]]]
    return dataclasses.replace(
        places,
        files=tuple(places.files[image] for image in images),
        place_start=start,
        place_city=places.place_city[old],
        names=tuple(places.names[place] for place in old),
        views=None if places.views is None else places.views[images],
        near=None,
    )
