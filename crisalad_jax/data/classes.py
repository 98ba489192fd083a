"""Groups of classes, to train a descriptor by classification: CosPlace's and EigenPlaces'.

No two classes of a group are neighbours, so that images of one spot are never of two classes. A
group is a training set of its own (`Places`) whose places are the classes.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from crisalad_jax.config import LargeMarginCosineConfig
from crisalad_jax.data.places import Places
from crisalad_jax.data.views import Views, views_of
from crisalad_jax.errors import InputError

_ADVICE = "; --loss.large-margin-cosine.classes places takes its places for classes"
_ONE_SPOT = 1e-3
"""Metres: where images of a cell spread less, no line of theirs tells the direction of a street."""


class Classes(NamedTuple):
    """Which images are of which class; an image may be of none."""

    images: Int64[np.ndarray, " images"]
    """Class after class."""
    start: Int64[np.ndarray, " classes+1"]
    """Class c owns `images[start[c] : start[c + 1]]`."""
    group: Int64[np.ndarray, " classes"]
    """A number for each class; classes of one are no neighbours."""


def class_groups(
    places: Places, config: LargeMarginCosineConfig, *, min_images: int, places_per_batch: int
) -> tuple[Places, ...]:
    """The groups that epochs train in turn, as sets whose places are classes.

    Of more than `config.groups` the ones with the most classes are taken. Viewpoints make twice as
    many: lateral and frontal ones alternate.

    Args:
        places: all images; where they are regrouped, read with `min_images=1`.
        config: what makes a class.
        min_images: classes with fewer are left out.
        places_per_batch: so many classes a group must have.

    Raises:
        InputError: positions are asked for and missing, no class has enough images, or a group has
            fewer classes than a batch asks for.
    """
    if config.classes == "places":
        sets = [_place_classes(places, config, min_images)]
    else:
        views = views_of(places)
        if not views.known.all():
            city = places.cities[int(np.argmin(views.known))]
            raise InputError(
                f"{places.root}: found one position (lat, lon) for all images of {city}, expected "
                f"where each was taken, which loss.large_margin_cosine.classes {config.classes!r} "
                f"asks for{_ADVICE}"
            )
        city = places.place_city[places.image_place]
        if config.classes == "cells":
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
                "(--loss.large-margin-cosine.groups) have more"
            )
    return tuple(
        _regrouped(places, classes, group)
        for turn in zip(*chosen)  # noqa: B905, for as many of each set
        for classes, group in zip(sets, turn, strict=True)
    )


def cell_classes(
    views: Views,
    city: Int64[np.ndarray, " images"],
    config: LargeMarginCosineConfig,
    *,
    min_images: int,
) -> Classes:
    """CosPlace's: a square cell and a sector of headings (Berton et al. 2022, section 3).

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
    config: LargeMarginCosineConfig,
    *,
    min_images: int,
) -> list[Classes]:
    """EigenPlaces': lateral and frontal classes of square cells (Berton et al. 2023, section 3).

    The first principal direction of a cell's positions is that of its street. A class looks at one
    focal point, `focal_distance` from the cell's mean: across the street, or along it. The paper
    cuts each image out of a panorama; a photograph has its heading, and is of the class if that is
    within `view_angle` of the direction from where it was taken to the focal point. Of the two
    focal points on a line, the one that more images look at is taken.
    """
    keys = np.column_stack([city, *_cells(views, config)])
    whole = _by_key(keys, _cell_group(keys, config), min_images)
    found: list[list[tuple[np.ndarray, int]]] = [[], []]
    for number, group in enumerate(whole.group):
        images = whole.images[whole.start[number] : whole.start[number + 1]]
        for side, looking in enumerate(_looking(views, images, config)):
            if looking.sum() >= min_images:
                found[side].append((images[looking], int(group)))
    return [_joined(classes) for classes in found]


def focal_points(
    positions: Float64[np.ndarray, "images 2"], distance: float
) -> Float64[np.ndarray, "side sign 2"] | None:
    """Focal points of a cell: lateral and frontal, both ways; None if all stand on one spot."""
    mean = positions.mean(axis=0)
    _, spread, directions = np.linalg.svd(positions - mean, full_matrices=False)
    if spread[0] < _ONE_SPOT:
        return None
    # What SVD leaves open: each direction's larger part is made positive.
    directions = (
        directions * np.sign(directions[[0, 1], np.abs(directions).argmax(axis=1)])[:, None]
    )
    ways = np.array([1.0, -1.0])
    return mean + distance * ways[None, :, None] * directions[::-1, None]


def _looking(
    views: Views, images: Int64[np.ndarray, " images"], config: LargeMarginCosineConfig
) -> Iterator[Bool[np.ndarray, " images"]]:
    """Which images look at the lateral focal point, and which at the frontal one."""
    positions = np.column_stack([views.east[images], views.north[images]])
    points = focal_points(positions, config.focal_distance)
    if points is None:
        return
    east, north = np.moveaxis(points[:, :, None] - positions, -1, 0)
    turn = np.rad2deg(np.arctan2(east, north)) - views.heading[images]
    looks = np.abs((turn + 180) % 360 - 180) <= config.view_angle
    for side in looks:
        yield side[side.sum(axis=1).argmax()]


def _place_classes(places: Places, config: LargeMarginCosineConfig, min_images: int) -> Classes:
    """Its places, dealt to groups; where positions are known, never two neighbours to one.

    A place for which no group is left is of no class.
    """
    large = np.flatnonzero(places.image_counts >= min_images)
    views = views_of(places)
    group = np.full(len(places.place_id), -1)
    for city in range(len(places.cities)):
        here = large[places.place_city[large] == city]
        if views.known[city]:
            group[here] = _apart(_centres(places, views)[here], config)
        else:
            group[here] = np.arange(len(here)) % config.groups
    kept = np.flatnonzero(group >= 0)
    if not len(kept):
        raise InputError(
            f"{places.root}: found no place with at least {min_images} images; the largest has "
            f"{places.image_counts.max()}"
        )
    bounds = zip(places.place_start[kept], places.place_start[kept + 1], strict=True)
    return _joined(
        [(np.arange(*ends), int(number)) for ends, number in zip(bounds, group[kept], strict=True)]
    )


def _centres(places: Places, views: Views) -> Float64[np.ndarray, "places 2"]:
    positions = np.column_stack([views.east, views.north])
    sums = np.add.reduceat(positions, places.place_start[:-1], axis=0)
    return sums / places.image_counts[:, None]


def _apart(
    centres: Float64[np.ndarray, "places 2"], config: LargeMarginCosineConfig
) -> Int64[np.ndarray, " places"]:
    """A group for each place, the smallest that has none nearer than CosPlace's classes are."""
    from scipy.spatial import KDTree

    near = KDTree(centres).query_ball_point(centres, config.cell * (config.spacing - 1))
    group, sizes = np.full(len(centres), -1), np.zeros(config.groups, np.int64)
    for place, others in enumerate(near):
        taken = group[others]
        free = np.setdiff1d(np.arange(config.groups), taken)
        if len(free):
            group[place] = free[sizes[free].argmin()]
            sizes[group[place]] += 1
    return group


def _cells(views: Views, config: LargeMarginCosineConfig) -> Int64[np.ndarray, "2 images"]:
    return np.floor(np.stack([views.east, views.north]) / config.cell).astype(np.int64)


def _cell_group(
    keys: Int64[np.ndarray, "images key"], config: LargeMarginCosineConfig
) -> Int64[np.ndarray, " images"]:
    east, north = keys[:, 1] % config.spacing, keys[:, 2] % config.spacing
    return east * config.spacing + north


def _by_key(
    keys: Int64[np.ndarray, "images key"], group: Int64[np.ndarray, " images"], min_images: int
) -> Classes:
    """Images of one key are a class, in the order of keys."""
    _, first, number, counts = np.unique(
        keys, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    number = number.reshape(-1)
    kept = counts >= min_images
    order = np.argsort(number, kind="stable")
    return Classes(
        order[kept[number[order]]],
        np.concatenate([[0], np.cumsum(counts[kept])]),
        group[first[kept]],
    )


def _joined(classes: Sequence[tuple[Int64[np.ndarray, " images"], int]]) -> Classes:
    images = [images for images, _ in classes]
    return Classes(
        np.concatenate([np.empty(0, np.int64), *images]),
        np.cumsum([0, *map(len, images)]),
        np.array([group for _, group in classes], np.int64),
    )


def _largest(classes: Classes, most: int) -> Int64[np.ndarray, " groups"]:
    """The groups with the most classes, the largest first; of equals the lower numbers."""
    numbers, counts = np.unique(classes.group, return_counts=True)
    return numbers[np.argsort(-counts, kind="stable")[:most]]


def _no_class(
    places: Places,
    views: Views,
    city: Int64[np.ndarray, " images"],
    config: LargeMarginCosineConfig,
    min_images: int,
    side: int,
) -> InputError:
    """How many images a class of this set has at most."""
    if config.classes == "cells":
        found = cell_classes(views, city, config, min_images=1)
        what = f"in one cell of {config.cell:g} m and {config.sector:g} degrees"
    else:
        found = focal_classes(views, city, config, min_images=1)[side]
        name = ("lateral", "frontal")[side]
        what = f"that look at the {name} focal point of one cell of {config.cell:g} m"
    largest = np.diff(found.start).max(initial=0)
    return InputError(
        f"{places.root}: found at most {largest} images {what}, expected classes of at least "
        f"{min_images}{_ADVICE}"
    )


def _regrouped(places: Places, classes: Classes, group: int) -> Places:
    """The classes of one group as places, numbered within each city."""
    chosen = np.flatnonzero(classes.group == group)
    counts = np.diff(classes.start)[chosen]
    images = np.concatenate(
        [classes.images[classes.start[one] : classes.start[one + 1]] for one in chosen]
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
    )
