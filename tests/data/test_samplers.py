"""Samplers: what the built-in ones draw, by its definition, and what another one may return."""

import dataclasses
import pathlib
from typing import Any, Literal

import numpy as np
import pytest

from crisalad_jax.data.class_groups import focal_points, views_of
from crisalad_jax.data.places import Places
from crisalad_jax.data.samplers import SAMPLERS, Sampler
from crisalad_jax.data.samplers.base import epoch_batches, labels_of
from crisalad_jax.data.samplers.cliques import Cliques, GeoVisual
from crisalad_jax.data.samplers.hard import HardNegatives
from crisalad_jax.data.samplers.viewpoints import Viewpoints
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.utils.errors import InputError
from tests.data.test_class_groups import METRES, places_of


def draw(places: Places, sampler: Sampler | str, **changes: Any) -> np.ndarray:
    sizes = {"places_per_batch": 4, "images_per_place": 3, "seed": 0, "epoch": 0} | changes
    return epoch_batches(places, sampler=sampler, **sizes)


def some_places(count: int, images: int = 4) -> Places:
    return places_of(np.zeros((count * images, 3)), [images] * count)


@dataclasses.dataclass(frozen=True)
class Fixed(Sampler):
    """Returns what it is given, so it is no part of a registry's list."""

    answer: Any = None

    def apply(self, places, draw):
        return self.answer


Fixed.part_name = "fixed"


def descriptors_of(values: np.ndarray, seen: list | None = None):
    """Describes image i of `some_places` by the vector of its place."""

    def describe(paths: list[pathlib.Path]) -> np.ndarray:
        images = np.array([int(path.stem) for path in paths])
        if seen is not None:
            seen.append(images)
        return values[images // 4]

    return describe


def test_hard_negatives_are_the_nearest_of_those_that_are_left():
    """On a circle: by similarity, what is nearest is what has the nearest angle."""
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, 13)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    places, seen = some_places(13), []
    batches = draw(places, "hard-negatives", describe=descriptors_of(circle, seen), epoch=3)
    assert batches.shape == (3, 4, 3)
    left = set(range(13))
    for first, *others in places.image_place[batches[..., 0]].tolist():
        left.remove(first)
        apart = {each: abs(np.angle(np.exp(1j * (angles[each] - angles[first])))) for each in left}
        assert others == sorted(apart, key=apart.get)[:3]
        left -= set(others)
    # One image of each place, another one in another epoch.
    assert (places.image_place[seen[0]] == np.arange(13)).all()
    draw(places, "hard-negatives", describe=descriptors_of(circle, seen), epoch=4)
    assert (seen[0] != seen[1]).any()


def test_a_place_whose_image_cannot_be_read_is_no_hard_negative():
    circle = np.column_stack([np.cos(np.arange(9.0)), np.sin(np.arange(9.0))])
    circle[5] = np.nan
    for seed in range(20):
        batches = draw(some_places(9), HardNegatives(), describe=descriptors_of(circle), seed=seed)
        drawn = batches[..., 0] // 4
        assert len(drawn) == 2
        assert not (drawn[:, 1:] == 5).any() or (drawn[:, 0] == 5).any()


def cloud(seed: int, counts: list[int], *, width: float, cities: int = 1) -> Places:
    """Images at random in squares of so many metres, one square a place, side by side."""
    generator = np.random.default_rng(seed)
    place = np.repeat(np.arange(len(counts)), counts)
    metres = generator.uniform(0, width, (len(place), 2))
    metres[:, 0] += width * place
    views = np.column_stack([0.001 + metres[:, 1] / METRES, -40.5 + metres[:, 0] / METRES])
    return places_of(np.column_stack([views, np.zeros(len(place))]), counts, cities)


def same(paths: list[pathlib.Path]) -> np.ndarray:
    return np.ones((len(paths), 2), np.float32)


def metres_between(places: Places, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """By the haversine formula, on a sphere whose degree is that of the ellipsoid's equator."""
    first, second = (np.deg2rad(places.views[each, :2]) for each in (one, other))
    dlat, dlon = np.moveaxis(first[:, None] - second, -1, 0)
    inner = np.sin(dlat / 2) ** 2 + np.cos(first[:, None, 0]) * np.cos(second[:, 0]) * (
        np.sin(dlon / 2) ** 2
    )
    return 2 * np.rad2deg(np.arcsin(np.sqrt(inner))) * METRES


@pytest.mark.parametrize("seed", [0, 1])
def test_cliques_are_close_and_apart(seed):
    places = cloud(seed, [9, 30, 1, 25, 40, 2, 17, 33], width=35, cities=2)
    sampler = Cliques(radius=25, similar=2)
    batches = draw(places, sampler, steps=8, seed=seed, describe=same)
    assert batches.shape == (8, 4, 3)
    city = places.place_city[places.image_place]
    for batch in batches:
        assert len(np.unique(batch)) == batch.size
        for number, group in enumerate(batch):
            assert len(set(city[group])) == 1
            # 0.5 % for the projection: UTM's scale is 0.9996, and a degree of latitude is shorter.
            assert metres_between(places, group, group).max() < 25 * 1.005
            for other in batch[number + 1 :]:
                if city[group[0]] == city[other[0]]:
                    assert metres_between(places, group, other).min() > 25 * 0.99
    labels = labels_of(places, sampler, batches)
    assert (labels == np.arange(4)[:, None]).all()
    # Groups are the sampler's own: some are of images of two of the set's places.
    of = places.image_place[batches]
    assert (of != of[..., :1]).any()


def test_cliques_go_on_until_the_batch_is_full_or_nothing_is_left():
    """Of one spot a place: each gives one group, whatever is drawn together."""
    places = cloud(0, [5, 5, 5, 5, 5], width=2)
    spots = dataclasses.replace(
        places, views=places.views + np.repeat(np.arange(5), 5)[:, None] * [0.01, 0, 0]
    )
    batches = draw(spots, Cliques(similar=0), places_per_batch=5, describe=same, steps=3)
    assert (np.sort(spots.image_place[batches[..., 0]], axis=1) == np.arange(5)).all()
    with pytest.raises(InputError, match="5 places of which sampler cliques makes no batch"):
        draw(spots, Cliques(), places_per_batch=6, describe=same)
    with pytest.raises(InputError, match=r"root: found no positions, .* for sampler cliques"):
        draw(some_places(5), Cliques(), describe=same)


def test_cliques_come_from_places_that_look_alike():
    """Of three places, one like the first and one unlike: shares by distance are 1 to 0."""
    places = cloud(1, [4, 4, 4], width=2)
    spread = np.repeat([0, 1, 2], 4)[:, None] * [0.01, 0, 0]
    places = dataclasses.replace(places, views=places.views + spread)
    looks = np.array([[0.0, 1], [0.1, 1], [5.0, 1]])
    together = set()
    for seed in range(20):
        batch = draw(
            places,
            Cliques(similar=1),
            places_per_batch=2,
            seed=seed,
            describe=descriptors_of(looks),
        )[0]
        together.add(frozenset(places.image_place[batch[:, 0]].tolist()))
    # From the third place the second is nearer, and the first the farthest.
    assert together == {frozenset({0, 1}), frozenset({1, 2})}


def test_a_neighbourhood_grows_by_what_is_most_like_all_of_it():
    """Against a greedy choice by the angles of a circle, from each place; and from the anchor."""
    places = cloud(1, [4] * 6, width=2)
    spread = np.repeat(np.arange(6), 4)[:, None] * [0.01, 0, 0]
    places = dataclasses.replace(places, views=places.views + spread)
    angles = np.deg2rad([0.0, 20, -21, 40, 120, 190])
    cosines = np.cos(angles[:, None] - angles)

    def grown(first: int) -> list[int]:
        chosen = [first]
        while len(chosen) < 3:
            rest = [each for each in range(6) if each not in chosen]
            chosen.append(max(rest, key=lambda each: cosines[each, chosen].sum()))
        return chosen

    # From 0 it goes on to 20 degrees, and then to 40, though -21 is nearer to 0.
    assert grown(0) == [0, 1, 3]
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    options = {"places_per_batch": 3, "describe": descriptors_of(circle)}

    def drawn(sampler: Sampler, seed: int) -> set[frozenset[int]]:
        batches = draw(places, sampler, seed=seed, **options)
        return {frozenset(batch[:, 0].tolist()) for batch in batches // 4}

    one, all_of_them = GeoVisual(similar=2, anchors=1), GeoVisual(similar=2, anchors=6)
    found = set().union(*(drawn(one, seed) for seed in range(20)))
    assert found == {frozenset(grown(first)) for first in range(6)}
    # 20 degrees is most like two others: twice cos(20 degrees).
    assert set().union(*(drawn(all_of_them, seed) for seed in range(5))) == {frozenset(grown(1))}


@pytest.mark.parametrize("side", ["lateral", "frontal"])
def test_viewpoints_are_of_one_cell_and_look_at_one_point(side: Literal["lateral", "frontal"]):
    generator = np.random.default_rng(4)
    metres = generator.uniform(0, 90, (1500, 2))
    views = np.column_stack(
        [
            0.001 + metres[:, 1] / METRES,
            -40.5 + metres[:, 0] / METRES,
            generator.uniform(0, 360, 1500),
        ]
    )
    places = places_of(views, [1] * 1500)
    batches = draw(places, Viewpoints(side=side), places_per_batch=3)
    assert len(batches) > 4
    own = views_of(places)
    points = np.column_stack([own.east, own.north])
    cells = np.floor(points / 15).astype(int)
    for batch in batches:
        # Of one of nine groups: classes of a batch are two cells apart, and no neighbours.
        assert len(np.unique(cells[batch.ravel()] % 3, axis=0)) == 1
        assert len(np.unique(cells[batch[:, 0]], axis=0)) == 3
        for group in batch:
            (cell,) = np.unique(cells[group], axis=0)
            within = points[(cells == cell).all(axis=1)]
            looks = []
            for point in focal_points(within, 10.0)[("lateral", "frontal").index(side)]:
                east, north = (point - points[group]).T
                turn = np.rad2deg(np.arctan2(east, north)) - own.heading[group]
                looks.append((np.cos(np.deg2rad(turn)) >= np.sqrt(0.5) - 1e-9).all())
            assert any(looks)
    with pytest.raises(InputError, match=r"found no headings, .* for sampler viewpoints"):
        draw(some_places(5), Viewpoints(side=side))


def test_an_order_may_repeat_places():
    """They have other images then, and never meet in a batch; 8 images are two groups of 4."""
    places = some_places(4, images=8)
    order = np.array([0, 0, 1, 2, 0, 3, 1, 0])
    batches = draw(places, Fixed(order), places_per_batch=2, images_per_place=4)
    drawn = places.image_place[batches[..., 0]]
    assert drawn.tolist() == [[0, 1], [0, 2], [0, 3], [1, 0]]
    first, second = (batches[step, 0] for step in (0, 1))
    assert sorted(np.concatenate([first, second])) == list(range(8))


def test_images_may_be_chosen_one_by_one():
    images = np.arange(24).reshape(2, 3, 4)[..., :2]
    places = some_places(6)
    found = draw(places, Fixed(images), places_per_batch=3, images_per_place=2)
    np.testing.assert_array_equal(found, images)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (np.array([0.0, 1.0]), r"found float64 of shape \(2,\), expected indices of places"),
        (
            np.zeros((2, 3, 2), int),
            r"found int64 of shape \(2, 3, 2\), .* in the shape \(steps, 4, 3\)",
        ),
        (np.array([0, 6, 1, 2]), r"found places \[6\], expected 0 to 5"),
        (np.full((1, 4, 3), -1), r"found images \[-1 -1 -1\], expected 0 to 23"),
        (np.zeros((1, 4, 3), int), r"found an image twice in batch \[0\]"),
        (np.arange(12).reshape(1, 4, 3), "found images of two places in a group of batch"),
    ],
)
def test_what_a_sampler_returns_is_checked(answer, words):
    with pytest.raises(InputError, match=f"sampler fixed: {words}"):
        draw(some_places(6), Fixed(answer))


def test_a_sampler_by_descriptors_needs_them():
    with pytest.raises(InputError, match=r"found hard-negatives, .* and no `describe`"):
        draw(some_places(6), "hard-negatives")
    loss = LossConfig(kind="large-margin-cosine", miner="none")
    for name in ("hard-negatives", "cliques"):
        with pytest.raises(InputError, match=r"sampler: found .*, expected another for loss"):
            TrainConfig(loss=loss, sampler=name)


def test_places_that_a_sampler_regroups_may_be_small():
    assert TrainConfig(sampler="cliques").min_images_of_place == 1
    assert TrainConfig().min_images_of_place == 4
    assert {"cliques", "hard-negatives", "shuffled", "within-city"} <= {*SAMPLERS}
