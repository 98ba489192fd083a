"""Pictures of places: they depend on place and view alone, and what a view does to them."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from crisalad_jax.synthetic import SCENERIES, SEASONS, View, render
from crisalad_jax.synthetic.picture import build_place
from crisalad_jax.utils.errors import InputError

PLACES = range(12)


def mean_colour(view: View, scenery: str = "street") -> np.ndarray:
    pictures = [render(place, view, (63, 84), scenery) for place in PLACES]  # type: ignore[arg-type]
    return np.mean(pictures, axis=(0, 1, 2))


@pytest.mark.parametrize("scenery", SCENERIES)
def test_pictures_depend_on_place_and_view_alone(scenery):
    view, size = View(weather="rain", occluders=3, noise=2.0, seed=4), (60, 80)
    first = render(7, view, size, scenery)
    assert first.shape == (60, 80, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(render(7, view, size, scenery), first)
    assert (render(8, view, size, scenery) != first).mean() > 0.3
    changes = {"lateral": 0.3, "forward": 1.0, "heading": 4.0, "height": 1.0, "pitch": 3.0}
    changes |= {"field": 60.0, "repaint": 0.3, "occluders": None, "time": "night"}
    changes |= {"exposure": 0.5, "noise": 4.0, "seed": 1}
    # Indoors neither season nor weather is seen.
    unseen = {"season": "autumn", "weather": "haze"}
    for name, value in (changes | unseen).items():
        changed = render(7, dataclasses.replace(view, **{name: value}), size, scenery)
        same = scenery in ("corridor", "room") and name in unseen
        assert np.array_equal(changed, first) == same, name


def test_sceneries_are_other_places_of_one_seed():
    pictures = [render(1, View(), (60, 80), scenery) for scenery in SCENERIES]
    for first, second in itertools.combinations(pictures, 2):
        assert (first != second).mean() > 0.3


def test_night_is_darker_than_dusk_and_dusk_than_noon():
    noon, dusk, night = (mean_colour(View(time=time)).mean() for time in ("noon", "dusk", "night"))
    # Means over 12 places of about 97, 76 and 54 grey levels: half of each gap must remain.
    assert noon > dusk + 10
    assert dusk > night + 10


def test_seasons_colour_the_city():
    views = {season: View(season=season, weather="overcast") for season in SEASONS}
    spring, summer, autumn, winter = (mean_colour(views[season]) for season in SEASONS)
    # Red over green tells leaves that turn (measured: +1.9 against -2.8 levels), brightness tells
    # snow (measured: 16 levels): the bounds are a fraction of both.
    assert autumn[0] - autumn[1] > summer[0] - summer[1] + 0.5
    assert winter.mean() > max(spring.mean(), summer.mean(), autumn.mean()) + 5


def test_winter_covers_the_country():
    """Snow is brighter than grass; means of twelve places, half of the smallest gap."""
    summer, winter = (mean_colour(View(season=s), "country").mean() for s in ("summer", "winter"))
    assert winter > summer + 15


def test_lit_windows_shine_at_night():
    view = View(time="night")
    pictures = [render(place, view) for place in PLACES]
    assert np.median([np.percentile(picture, 99) for picture in pictures]) > 150
    assert np.median([np.median(picture) for picture in pictures]) < 90


def test_passers_change_the_street_and_nothing_above_it():
    for place in PLACES:
        empty = render(place, View())
        changed = np.any(empty != render(place, View(occluders=place)), axis=-1)
        # At most 0.15 was measured over 100 places.
        assert 0 < changed.mean() < 0.35
        # The tallest, a bus of 3 m seen from 2.4 m, hardly reaches over the horizon: row 77 of 126.
        assert not changed[:60].any()


@pytest.mark.parametrize("scenery", SCENERIES)
def test_a_crowd_hides_more_of_a_place(scenery):
    """Twenty people change some pixels, and leave most as they were."""
    for place in PLACES[:4]:
        few, many = (render(place, View(occluders=1, crowd=n), (60, 80), scenery) for n in (0, 20))
        # At most 0.143 was measured over 100 places of each kind.
        assert 0.01 < np.any(few != many, axis=-1).mean() < 0.3


def test_a_step_to_the_right_moves_near_fronts_more_than_far_ones():
    # A pinhole moves a point at depth z by f t / z: the picture is no flat board that slides.
    moved = []
    for place in PLACES:
        a, b = (render(place, View(lateral=x)).astype(int) for x in (0.0, 0.6))
        difference = np.abs(a - b).mean(axis=(0, 2))
        moved.append(
            (difference[:20].mean() + difference[-20:].mean(), difference[64:104].mean() * 2)
        )
    near, far = np.mean(moved, axis=0)
    assert near > far


def test_exposure_is_in_stops():
    # On a picture far from saturation: one stop less halves it, to the rounding of a level.
    view = View(time="night", exposure=-1.0)
    a = render(2, view).astype(float)
    b = render(2, dataclasses.replace(view, exposure=-2.0)).astype(float)
    unsaturated = a < 250
    assert np.abs(a / 2 - b)[unsaturated].max() <= 1.0


def test_stations_of_a_scene_follow_each_other():
    for scenery in SCENERIES:
        reach = build_place(3, scenery).reach
        # Views of two stations never overlap in where they stand.
        assert 0 < 2 * reach.forward < reach.step
        assert 0 < reach.height[0] < reach.height[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: View(season="monsoon"), "season: found 'monsoon', expected one of autumn, spring"),  # type: ignore[arg-type]
        (lambda: View(noise=math.nan), "View.noise: found nan, expected 0 to 255"),
        (lambda: View(repaint=math.inf), "View.repaint: found inf, expected 0 to 3"),
        (lambda: render(-1, View()), "place_seed: found -1, expected at least 0"),
        (lambda: render(1, View(), (8, 8)), "image_size: found 8, expected 16 to 2048"),
    ],
)
def test_bad_arguments_are_named_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
