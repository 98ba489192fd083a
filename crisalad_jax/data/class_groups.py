"""Make the groups of classes that train a descriptor by classification (CosPlace, EigenPlaces).

Two classes of one group are never neighbours, so images of one spot are never of two of its
classes. A group is a training set of its own (`Places`) whose places are the classes.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.places import Places
from crisalad_jax.data.views import Views, views_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool, Float64, Int64

_ADVICE = "; --loss.kind.classes.kind places takes its places for classes"
_ONE_SPOT = 1e-3
"""Spread in metres of a cell's images below which they do not show the direction of a street."""


class Classes(NamedTuple):
    """The images of each class; an image may be of no class."""

    images: Int64[np.ndarray, " images"]
    """Image indices, sorted by class."""
    start: Int64[np.ndarray, " classes+1"]
    """Class c owns `images[start[c] : start[c + 1]]`."""
    group: Int64[np.ndarray, " classes"]
    """Group number of each class; classes of one group are no neighbours."""


def class_groups(
    places: Places, config: ClassesConfig, *, min_images: int, places_per_batch: int
) -> tuple[Places, ...]:
    """Make the groups that epochs train in turn, as sets whose places are classes.

    At most `config.groups` groups are taken: those with the most classes. Viewpoints make twice as
    many, of which lateral and frontal groups alternate.

    Args:
        places: all images, read with `min_images=1` for classes other than places.
        config: how images are grouped into classes.
        min_images: classes with fewer are left out.
        places_per_batch: smallest number of classes in a group.

    Raises:
        InputError: positions are asked for and missing, no class has enough images, or a group has
            fewer classes than a batch asks for.
    """
    if config.kind == "places":
        sets = [_place_classes(places, config, min_images)]
    else:
        views = views_of(places)
        _check_own(places, config)
        if not views.known.all():
            city = places.cities[int(np.argmin(views.known))]
            raise InputError(
                f"{places.root}: found one position (lat, lon) for all images of {city}, expected "
                f"where each was taken, which loss.kind.classes.kind {config.kind!r} "
                f"asks for{_ADVICE}"
            )
        city = places.place_city[places.image_place]
        if config.kind == "cells":
            sets = [cell_classes(views, city, config, min_images=min_images)]
        else:
            sets = focal_classes(views, city, config, min_images=min_images)
        for side, classes in enumerate(sets):
            if not len(classes.group):
                raise _no_class(places, views, city, config, min_images, side)
    chosen = [_largest(classes, config.groups) for classes in sets]
    for classes, groups in zip(sets, chosen, strict=True):
        fewest = min(int((classes.group == group).sum()) for group in groups)
        if fewest < places_per_batch:
            raise InputError(
                f"{places.root}: found {fewest} classes in the smallest of {len(groups)} groups, "
                f"expected at least places_per_batch {places_per_batch}; fewer groups "
                "(--loss.kind.classes.groups) have more"
            )
    return tuple(
        _regrouped(places, classes, group)
        for turn in zip(*chosen)  # noqa: B905, for as many of each set
        for classes, group in zip(sets, turn, strict=True)
    )


def _check_own(places: Places, config: ClassesConfig) -> None:
    """Check that a table of one's own has what classes by position ask for.

    Raises:
        InputError: it has no positions or no headings, or the places are folders.
    """
    if places.names is None:
        return
    lacking = "positions (lat,lon)" if places.views is None else "headings (heading)"
    if places.views is None or np.isnan(places.views).any():
        raise InputError(
            f"{places.root}: found no {lacking} of the images, which loss.kind.classes.kind "
            f"{config.kind!r} asks for, expected a table name,place,lat,lon,heading{_ADVICE}"
        )


def cell_classes(
    views: Views,
    city: Int64[np.ndarray, " images"],
    config: ClassesConfig,
    *,
    min_images: int,
) -> Classes:
    """Make CosPlace's classes: a square cell and a sector of headings (Berton et al. 2022, sec. 3).

    Two classes of a group are at least `spacing - 1` cells, or `sector_spacing - 1` sectors, apart.
    """
    cells = _cells(views, config)
    sector = np.floor(views.heading / config.sector).astype(np.int64)
    keys = np.column_stack([city, *cells, sector])
    return _by_key(
        keys,
        _cell_group(keys, config) * config.sector_spacing + sector % config.sector_spacing,
        min_images,
    )


def focal_classes(
    views: Views,
    city: Int64[np.ndarray, " images"],
    config: ClassesConfig,
    *,
    min_images: int,
) -> list[Classes]:
    """Make EigenPlaces' lateral and frontal classes of square cells (Berton et al. 2023, sec. 3).

    The first principal direction of a cell's positions is the direction of its street. A class
    looks at one focal point, `focal_distance` from the cell's mean: across the street, or along it.
    The paper crops images from panoramas. Here an image belongs to the class if its heading is
    within `view_angle` of the direction from its position to the focal point. Each line has two
    focal points, of which the one that more images look at is taken.
    """
    keys = np.column_stack([city, *_cells(views, config)])
    whole = _by_key(keys, _cell_group(keys, config), min_images)
    sides: list[list[tuple[np.ndarray, int]]] = [[], []]
    for number, group in enumerate(whole.group):
        images = whole.images[whole.start[number] : whole.start[number + 1]]
        for side, looking in enumerate(_looking(views, images, config)):
            if looking.sum() >= min_images:
                sides[side].append((images[looking], int(group)))
    return [_joined(classes) for classes in sides]


def focal_points(
    positions: Float64[np.ndarray, "images 2"], distance: float
) -> Float64[np.ndarray, "side sign 2"] | None:
    """Compute a cell's lateral and frontal focal points, two each; None if all positions agree."""
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


def _looking(
    views: Views, images: Int64[np.ndarray, " images"], config: ClassesConfig
) -> Iterator[Bool[np.ndarray, " images"]]:
    """Mark the images that look at the lateral focal point, then those at the frontal one."""
    positions = np.column_stack([views.east[images], views.north[images]])
    points = focal_points(positions, config.focal_distance)
    if points is None:
        return
    east, north = np.moveaxis(points[:, :, None] - positions, -1, 0)
    turn = np.rad2deg(np.arctan2(east, north)) - views.heading[images]
    looks = np.abs((turn + 180) % 360 - 180) <= config.view_angle
    for side in looks:
        yield side[side.sum(axis=1).argmax()]


def _place_classes(places: Places, config: ClassesConfig, min_images: int) -> Classes:
    """Deal the set's places to groups; where positions are known, no group has two neighbours.

    A place that is a neighbour in every group is of no class.
    """
    large = np.flatnonzero(places.image_counts >= min_images)
    views = views_of(places)
    group = np.full(len(places.place_id), -1)
    for city in range(len(places.cities)):
        here = large[places.place_city[large] == city]
        if places.near is not None:
            _deal(group, here, [places.near[place] for place in here], config)
        elif views.known[city]:
            _deal(group, here, _near(_centres(places, views), here, config), config)
        else:
            group[here] = np.arange(len(here)) % config.groups
    grouped = np.flatnonzero(group >= 0)
    if not len(grouped):
        raise InputError(
            f"{places.root}: found no place with at least {min_images} images; the largest has "
            f"{places.image_counts.max()}"
        )
    bounds = zip(places.place_start[grouped], places.place_start[grouped + 1], strict=True)
    return _joined(
        [
            (np.arange(*ends), int(number))
            for ends, number in zip(bounds, group[grouped], strict=True)
        ]
    )


def _centres(places: Places, views: Views) -> Float64[np.ndarray, "places 2"]:
    positions = np.column_stack([views.east, views.north])
    sums = np.add.reduceat(positions, places.place_start[:-1], axis=0)
    return sums / places.image_counts[:, None]


def _near(
    centres: Float64[np.ndarray, "places 2"],
    here: Int64[np.ndarray, " some"],
    config: ClassesConfig,
) -> list[Int64[np.ndarray, " _"]]:
    """Find the places that are as near each of these as CosPlace forbids."""
    from scipy.spatial import KDTree

    tree = KDTree(centres[here])
    found = tree.query_ball_point(centres[here], config.cell * (config.spacing - 1))
    return [here[others] for others in found]


def _deal(
    group: Int64[np.ndarray, " places"],
    here: Int64[np.ndarray, " some"],
    near: Sequence[Int64[np.ndarray, " _"]],
    config: ClassesConfig,
) -> None:
    """Put each of these places into the smallest group that has none near it, if there is one."""
    sizes = np.zeros(config.groups, np.int64)
    for place, others in zip(here, near, strict=True):
        free = np.setdiff1d(np.arange(config.groups), group[others])
        if len(free):
            group[place] = free[sizes[free].argmin()]
            sizes[group[place]] += 1


def _cells(views: Views, config: ClassesConfig) -> Int64[np.ndarray, "2 images"]:
    return np.floor(np.stack([views.east, views.north]) / config.cell).astype(np.int64)


def _cell_group(
    keys: Int64[np.ndarray, "images key"], config: ClassesConfig
) -> Int64[np.ndarray, " images"]:
    east, north = keys[:, 1] % config.spacing, keys[:, 2] % config.spacing
    return east * config.spacing + north


def _by_key(
    keys: Int64[np.ndarray, "images key"], group: Int64[np.ndarray, " images"], min_images: int
) -> Classes:
    """Make a class of the images of each key, in the order of keys."""
    _, first, number, counts = np.unique(
        keys, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    number = number.reshape(-1)
    large = counts >= min_images
    order = np.argsort(number, kind="stable")
    return Classes(
        order[large[number[order]]],
        np.concatenate([[0], np.cumsum(counts[large])]),
        group[first[large]],
    )


def _joined(classes: Sequence[tuple[Int64[np.ndarray, " images"], int]]) -> Classes:
    images = [images for images, _ in classes]
    return Classes(
        np.concatenate([np.empty(0, np.int64), *images]),
        np.cumsum([0, *map(len, images)]),
        np.array([group for _, group in classes], np.int64),
    )


def _largest(classes: Classes, most: int) -> Int64[np.ndarray, " groups"]:
    """Find the groups with the most classes, the largest first; ties go to the lower number."""
    numbers, counts = np.unique(classes.group, return_counts=True)
    return numbers[np.argsort(-counts, kind="stable")[:most]]


def _no_class(
    places: Places,
    views: Views,
    city: Int64[np.ndarray, " images"],
    config: ClassesConfig,
    min_images: int,
    side: int,
) -> InputError:
    """Make the error that tells how many images the largest class of this set has."""
    if config.kind == "cells":
        classes = cell_classes(views, city, config, min_images=1)
        what = f"in one cell of {config.cell:g} m and {config.sector:g} degrees"
    else:
        classes = focal_classes(views, city, config, min_images=1)[side]
        name = ("lateral", "frontal")[side]
        what = f"that look at the {name} focal point of one cell of {config.cell:g} m"
    largest = np.diff(classes.start).max(initial=0)
    return InputError(
        f"{places.root}: found at most {largest} images {what}, expected classes of at least "
        f"{min_images}{_ADVICE}"
    )


def _regrouped(places: Places, classes: Classes, group: int) -> Places:
    """Return the classes of one group as places, numbered within each city."""
    chosen = np.flatnonzero(classes.group == group)
    counts = np.diff(classes.start)[chosen]
    images = np.concatenate(
        [classes.images[classes.start[number] : classes.start[number + 1]] for number in chosen]
    )
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    old = places.image_place[images[start[:-1]]]
    return dataclasses.replace(
        places,
        files=tuple(places.files[image] for image in images),
        image_place=np.repeat(np.arange(len(chosen), dtype=np.int32), counts),
        place_city=places.place_city[old],
        place_id=places.place_id[old],
        place_start=start,
        names=None if places.names is None else tuple(places.names[place] for place in old),
        near=None,
        views=None if places.views is None else places.views[images],
    )
