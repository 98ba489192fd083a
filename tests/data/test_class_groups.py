"""Classes and groups against what their definitions ask of every pair, and cells by hand."""

import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.class_groups import (
    Views,
    cell_classes,
    class_groups,
    focal_classes,
    focal_points,
    views_of,
)
from crisalad_jax.data.places import Places
from tests.data.benchmarks.trees import refused

COSPLACE = ClassesConfig(kind="cells")
EIGENPLACES = ClassesConfig(kind="viewpoints", cell=15.0, spacing=3)
METRES = 111_195.0
"""A degree of latitude, to half a percent."""


def street(count: int, side: float, seed: int = 0) -> Views:
    """Images anywhere in a square of two cities, which look anywhere."""
    generator = np.random.default_rng(seed)
    east, north = generator.uniform(-side, side, (2, count))
    heading = generator.uniform(0, 360, count)
    return Views(generator.integers(0, 2, count), east, north, heading, np.ones(2, bool))


def test_cells_are_squares_and_sectors():
    views = street(3000, 40.0)
    classes = cell_classes(views, COSPLACE, 3)

    def key(image: int) -> tuple:
        e, n, h = views.east[image] // 10, views.north[image] // 10, views.heading[image] // 30
        return int(views.city[image]), e, n, h

    counts = Counter(map(key, range(3000)))
    found = {key(images[0]): images for images, _ in classes}
    assert found.keys() == {name for name, count in counts.items() if count >= 3}
    assert 0 < len(found) < len(counts)
    for name, images in found.items():
        assert {key(image) for image in images} == {name}
        assert len(set(images.tolist())) == counts[name]
    assert len(classes) == len(found)
    # The paper's G_uvw: 5 x 5 x 2 groups, of the cells that agree modulo these.
    for images, group in classes:
        _, e, n, h = key(images[0])
        assert group == (e % 5 * 5 + n % 5) * 2 + h % 2
    assert len({each.group for each in classes}) == 50


def test_a_class_looks_at_its_focal_point():
    """A cell whose street runs to the east: who looks south, north, or along it, by hand."""
    # Focal points, 10 m from (7, 7): (7, 17), (7, -3), (17, 7), (-3, 7).
    rows = [
        (2.0, 7.0, 26.5),  # to (7, 17): atan2(5, 10) is 26.6 degrees
        (12.0, 7.0, 350.0),  # 333.4, so 16.6 beside it
        (2.0, 7.0, 71.0),  # 44.4 beside it; along the street 71
        (12.0, 7.0, 200.0),  # to (7, -3): 206.6
        (7.0, 7.0, 271.0),  # to the west, along the street
        (4.0, 7.0, 265.0),  # the same
        (10.0, 7.0, 300.0),  # the same, 30 beside it; 43.3 beside (7, 17), at 343.3
        (7.0, 7.0, 135.5),  # to none: 45.5 beside (17, 7)
    ]
    views = Views(np.zeros(len(rows), int), *np.array(rows).T, np.ones(1, bool))
    lateral, frontal = focal_classes(views, EIGENPLACES, 3)
    assert [(sorted(images.tolist()), group) for images, group in lateral] == [([0, 1, 2, 6], 0)]
    assert [(sorted(images.tolist()), group) for images, group in frontal] == [([4, 5, 6], 0)]
    lateral, frontal = focal_classes(views, EIGENPLACES, 4)
    assert (len(lateral), len(frontal)) == (1, 0)


def test_a_cell_without_a_street_has_no_focal_points():
    assert focal_points(np.full((4, 2), 7.0), 10.0) is None


def test_viewpoints_of_a_city_are_what_their_definition_says():
    views = street(1500, 45.0, seed=2)
    both = focal_classes(views, EIGENPLACES, 3)
    for side, classes in enumerate(both):
        assert len(classes) > 10
        for images, group in classes:
            e, n = views.east[images[0]] // 15, views.north[images[0]] // 15
            assert group == e % 3 * 3 + n % 3
            cell = (
                (views.east // 15 == e)
                & (views.north // 15 == n)
                & (views.city == views.city[images[0]])
            )
            positions = np.column_stack([views.east, views.north])[cell]
            # The principal directions once more, by the eigenvectors of the covariance.
            direction = np.linalg.eigh(np.cov(positions.T))[1][:, side]
            looking = []
            for sign in (1, -1):
                east, north = (positions.mean(0) + sign * 10 * direction - positions).T
                dot = east * np.sin(np.deg2rad(views.heading[cell]))
                dot += north * np.cos(np.deg2rad(views.heading[cell]))
                looking.append(np.flatnonzero(cell)[dot >= np.hypot(east, north) * np.sqrt(0.5)])
            assert set(images.tolist()) in [set(each.tolist()) for each in looking]
            assert len(images) == max(map(len, looking))


def places_of(views: np.ndarray, counts: list[int], cities: int = 1) -> Places:
    """Places of so many images each, with these latitudes, longitudes and headings."""
    return Places(
        root=Path("root"),
        cities=tuple(f"city{i}" for i in range(cities)),
        files=tuple(f"{number}.jpg" for number in range(len(views))),
        place_start=np.concatenate([[0], np.cumsum(counts)]),
        place_city=(np.arange(len(counts)) * cities // len(counts)).astype(np.int32),
        names=tuple(map(str, range(len(counts)))),
        views=np.array(views, np.float64),
    )


def numbers_of(places: Places) -> list[int]:
    """Which of `places_of` these are."""
    return [int(name) for name in places.names]


def city_of(centres: list[tuple[float, float]], counts: list[int], *, cities: int = 1) -> Places:
    """Places at (east, north) metres of a corner on an ocean; images of one are within a metre."""
    views = [
        (0.001 + (north + 0.1 * view) / METRES, -40.5 + (east + 0.1 * view) / METRES, 90)
        for (east, north), count in zip(centres, counts, strict=True)
        for view in range(count)
    ]
    return places_of(np.array(views), counts, cities)


def test_places_are_dealt_to_groups_without_neighbours():
    """Every 15 m along a street, in three groups: at least 40 m apart, as cells are."""
    places = city_of([(15.0 * i, 0.0) for i in range(60)], [4] * 60)
    config = ClassesConfig(groups=3)
    groups = class_groups(places, config, min_images=4, places_per_batch=2)
    views = views_of(places)
    assert len(groups) == 3
    everything = [file for group in groups for file in group.files]
    assert sorted(everything) == sorted(places.files)
    for group in groups:
        numbers = numbers_of(group)
        assert len(numbers) == 20
        for number, place in enumerate(numbers):
            start, end = group.place_start[number : number + 2]
            assert group.files[start:end] == places.files[4 * place : 4 * place + 4]
            assert (group.image_place[start:end] == number).all()
        centres = views.east[4 * np.array(numbers)]
        assert np.diff(np.sort(centres)).min() > 40
    # With fewer groups than a neighbourhood has places some are left out, and never put together.
    (group,) = class_groups(places, ClassesConfig(groups=1), min_images=4, places_per_batch=2)
    assert numbers_of(group) == list(range(0, 60, 3))


def test_without_positions_places_are_dealt_by_number():
    places = city_of([(0.0, 0.0)] * 10, [1] * 10)
    assert not views_of(places).known[0]
    assert not views_of(located((0, 0, 5), (0, 0, 100))).known[0]
    groups = class_groups(places, ClassesConfig(groups=3), min_images=1, places_per_batch=3)
    assert [numbers_of(group) for group in groups] == [[0, 3, 6, 9], [1, 4, 7], [2, 5, 8]]


def test_places_with_too_few_images_are_no_classes():
    places = city_of([(100.0 * i, 0.0) for i in range(6)], [4, 1, 4, 3, 5, 4])
    (group,) = class_groups(places, ClassesConfig(groups=1), min_images=4, places_per_batch=1)
    assert numbers_of(group) == [0, 2, 4, 5]
    assert group.image_counts.tolist() == [4, 4, 5, 4]


def test_the_groups_with_most_classes_are_taken_and_places_may_be_joined():
    """Two places in one cell become one class; 50 m on is the same group, 10 m on another."""
    start = views_of(city_of([(0.0, 0.0)], [2])).east[0]
    east = start // 10 * 10 - start + 2
    places = city_of(
        [(east, 0.0), (east + 3, 0.0), (east + 50, 0.0), (east + 10, 0.0)], [2, 2, 3, 4]
    )
    config = ClassesConfig(kind="cells", groups=1)
    (group,) = class_groups(places, config, min_images=3, places_per_batch=2)
    assert group.image_counts.tolist() == [4, 3]
    assert group.files == places.files[:7]
    config = ClassesConfig(kind="cells", groups=9)
    both = class_groups(places, config, min_images=3, places_per_batch=1)
    assert [each.image_counts.tolist() for each in both] == [[4, 3], [4]]


def test_lateral_and_frontal_groups_take_turns():
    """A street of photographs to the north and to the east, alternately."""
    generator = np.random.default_rng(0)
    spots = generator.uniform(0, 90, (400, 2))
    places = city_of([tuple(spot) for spot in spots], [1] * 400)
    assert places.views is not None
    places.views[:, 2] = 90 * (np.arange(400) % 4)
    config = ClassesConfig(kind="viewpoints", cell=15.0, spacing=3, groups=2)
    groups = class_groups(places, config, min_images=2, places_per_batch=1)
    views = views_of(places)
    sets = focal_classes(views, config, 2)
    assert len(groups) == 4
    for turn, group in enumerate(groups):
        classes = sets[turn % 2]
        possible = {tuple(sorted(places.files[i] for i in images)) for images, _ in classes}
        for a, b in itertools.pairwise(group.place_start):
            assert tuple(sorted(group.files[a:b])) in possible


def located(*views: tuple[float, float, float]) -> Places:
    """One place with an image for each (latitude, longitude, heading)."""
    return places_of(np.array(views), [len(views)])


def test_a_city_has_one_zone_even_across_its_edge_and_across_180_degrees():
    """100 m apart on the ground stay so, to the scale's 0.1 %: zones have other eastings."""
    degrees = 100 / 111_319.49  # along the equator
    for middle in (6.0, 180.0):
        west, east = middle - degrees / 2, middle + degrees / 2
        east = east - 360 if east > 180 else east
        views = views_of(located((0, west, 0), (0, east, 0)))
        assert views.east[1] - views.east[0] == pytest.approx(100, rel=2e-3)


ROW = [(100.0 * i, 0.0) for i in range(9)]


@pytest.mark.parametrize(
    ("places", "config", "words"),
    [
        *(
            (city_of(ROW, [3] * 9), {"kind": kind}, "found 0 classes of at least 4 images")
            for kind in ("cells", "viewpoints", "places")
        ),
        (city_of(ROW, [4] * 9), {"groups": 2}, "found 4 classes of .* places_per_batch 5; lower"),
        (city_of([(0, 0)] * 4, [1] * 4), {"kind": "cells"}, "found .*one position for all images"),
        (located((0, 1, np.nan), (1, 2, np.nan)), {"kind": "cells"}, "found no headings"),
        (located((0, -60, 0), (0, 100, 0)), {}, "found the images of city0 over 160 degrees"),
    ],
)
def test_classes_that_cannot_be_made_are_told(places, config, words):
    with refused(f"root: {words}"):
        class_groups(places, ClassesConfig(**config), min_images=4, places_per_batch=5)
