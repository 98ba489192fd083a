"""The synthetic city: same bits for a seed, layouts read back independently, what views do."""

import collections
import csv
import dataclasses
import hashlib
import itertools
import json
import math
import pathlib
import re

import numpy as np
import pytest
from PIL import Image

from crisalad_jax.synthetic import (
    SEASONS,
    SyntheticCityConfig,
    View,
    render,
    write_synthetic_city,
)
from crisalad_jax.synthetic.city import place_seed
from crisalad_jax.utils.errors import InputError

SMALL = SyntheticCityConfig(
    train_places=4,
    images_per_place=4,
    test_places=5,
    database_per_place=2,
    queries_per_place=1,
    image_size=(42, 56),
    seed=3,
)
TOTAL = 4 * 4 + 5 * (2 + 1)
PLACES = range(12)


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    root = tmp_path_factory.mktemp("synthetic") / "city"
    write_synthetic_city(root, SMALL)
    return root


def hashes(root: pathlib.Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def utm(path: pathlib.Path) -> tuple[float, float]:
    fields = path.name.split("@")
    return float(fields[1]), float(fields[2])


def mean_colour(view: View) -> np.ndarray:
    return np.mean([render(place, view, (63, 84)).mean(axis=(0, 1)) for place in PLACES], axis=0)


def test_the_same_seed_writes_the_same_bits_and_another_seed_others(city, tmp_path):
    write_synthetic_city(tmp_path / "again", SMALL)
    assert hashes(tmp_path / "again") == hashes(city)
    write_synthetic_city(tmp_path / "other", dataclasses.replace(SMALL, seed=4))
    pictures = {v for k, v in hashes(city).items() if k.endswith(".jpg")}
    others = {v for k, v in hashes(tmp_path / "other").items() if k.endswith(".jpg")}
    assert len(pictures) == TOTAL
    assert not pictures & others


def test_train_reads_as_gsv_cities(city):
    images = set((city / "train" / "Images").rglob("*.jpg"))
    name = re.compile(
        r"(?P<city>[A-Za-z]+)_(?P<place>\d{7})_(?P<year>\d{4})_(?P<month>\d\d)_(?P<north>\d{3})"
        r"_(?P<lat>-?\d+\.\d+)_(?P<lon>-?\d+\.\d+)_(?P<panoid>[0-9a-f]+)\.jpg"
    )
    tables = sorted((city / "train" / "Dataframes").glob("*.csv"))
    assert len(tables) == 2
    found = set()
    for table in tables:
        with table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        header = ["place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid"]
        assert list(rows[0]) == header
        places = collections.Counter(row["place_id"] for row in rows)
        assert places == {"1": 4, "2": 4}
        for row in rows:
            place, year, month = int(row["place_id"]), int(row["year"]), int(row["month"])
            stem = (
                f"{row['city_id']}_{place:07d}_{year:04d}_{month:02d}_{int(row['northdeg']):03d}"
                f"_{row['lat']}_{row['lon']}_{row['panoid']}"
            )
            path = city / "train" / "Images" / row["city_id"] / f"{stem}.jpg"
            assert name.fullmatch(path.name)
            assert row["city_id"] == table.stem
            assert 0 <= int(row["northdeg"]) < 360
            found.add(path)
    assert found == images
    assert len(images) == 4 * 4


def test_train_places_lie_apart_and_their_images_together(city):
    def metres(a: tuple[float, float], b: tuple[float, float]) -> float:
        mean = math.radians((a[0] + b[0]) / 2)
        north, east = math.radians(a[0] - b[0]), math.radians(a[1] - b[1]) * math.cos(mean)
        return 6_371_000 * math.hypot(north, east)

    for table in (city / "train" / "Dataframes").glob("*.csv"):
        with table.open(newline="", encoding="utf-8") as file:
            rows = [
                (r["place_id"], (float(r["lat"]), float(r["lon"]))) for r in csv.DictReader(file)
            ]
        for (place, a), (other, b) in itertools.combinations(rows, 2):
            assert metres(a, b) < 10 if place == other else metres(a, b) > 60


def test_evaluation_reads_as_utm_layout_with_25_m_positives(city):
    folder = city / "test" / "images" / "test"
    database = sorted((folder / "database").iterdir())
    queries = sorted((folder / "queries").iterdir())
    assert (len(database), len(queries)) == (10, 5)
    for path in database + queries:
        fields = path.name.split("@")
        # An empty field before the first @, 14 fields of the format, and the suffix.
        assert len(fields) == 16
        assert (fields[0], fields[-1]) == ("", ".jpg")
        assert 0 <= float(fields[9]) < 360
        with Image.open(path) as picture:
            assert (picture.size, picture.mode) == ((56, 42), "RGB")
    claimed = []
    for query in queries:
        distances = [math.dist(utm(query), utm(other)) for other in database]
        positives = [i for i, d in enumerate(distances) if d <= 25]
        assert len(positives) == 2
        assert all(distances[i] < 10 for i in positives)
        assert all(d > 60 for i, d in enumerate(distances) if i not in positives)
        claimed += positives
    assert sorted(claimed) == list(range(10))


def test_queries_and_database_never_share_a_season_and_queries_come_at_all_hours(city):
    folder = city / "test" / "images" / "test"
    notes = {
        side: [path.name.split("@")[14].split("_") for path in (folder / side).iterdir()]
        for side in ("database", "queries")
    }
    seasons, hours = (
        [{note[column] for note in notes[side]} for side in ("database", "queries")]
        for column in (0, 1)
    )
    assert not seasons[0] & seasons[1]
    assert hours[0] == {"noon"}
    assert len(hours[1]) > 1


def test_train_places_meet_every_season(city):
    seasons = collections.defaultdict(set)
    for path in (city / "train" / "Images").rglob("*.jpg"):
        name, place, _, month, *_ = path.name.split("_")
        seasons[name, place].add(month)
    assert set(map(len, seasons.values())) == {4}


def test_no_place_is_in_both_splits_or_twice():
    config = SyntheticCityConfig()
    seeds = [place_seed(config, 0, i) for i in range(config.train_places)]
    seeds += [place_seed(config, 1, i) for i in range(config.test_places)]
    assert len(set(seeds)) == config.train_places + config.test_places
    # And another seed is another place: the same view of each is another picture.
    assert len({render(seed, View(), (42, 56)).tobytes() for seed in seeds[::10]}) == 39


def test_render_is_pure_and_every_part_of_the_view_matters():
    view = View(weather="rain", occluders=1, noise=2.0)
    before = view, render(5, view)
    assert before[1].shape == (126, 168, 3)
    assert before[1].dtype == np.uint8
    for change in (
        {"lateral": 1.0},
        {"forward": 1.0},
        {"heading": 3.0},
        {"season": "autumn"},
        {"time": "night"},
        {"weather": "haze"},
        {"occluders": 2},
        {"exposure": 0.5},
        {"noise": 4.0},
        {"seed": 1},
    ):
        assert not np.array_equal(render(5, dataclasses.replace(view, **change)), before[1]), change
    np.testing.assert_array_equal(render(5, view), before[1])


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


def test_lit_windows_shine_at_night():
    view = View(time="night")
    brightest = [np.percentile(render(place, view), 99) for place in PLACES]
    assert np.median(brightest) > 150
    assert np.median([np.median(render(place, view)) for place in PLACES]) < 90


def test_passers_change_the_street_and_nothing_above_it():
    for place in PLACES:
        empty = render(place, View())
        changed = np.any(empty != render(place, View(occluders=place)), axis=-1)
        # At most 0.15 was measured over 100 places.
        assert 0 < changed.mean() < 0.35
        # The tallest, a bus of 3 m seen from 2.4 m, hardly reaches over the horizon: row 77 of 126.
        assert not changed[:60].any()


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


def test_progress_counts_every_image(tmp_path):
    calls = []
    write_synthetic_city(tmp_path / "city", SMALL, progress=lambda *call: calls.append(call))
    assert calls == [(i, TOTAL) for i in range(1, TOTAL + 1)]


# An error of the system's from the caller's own function must not pass for one of writing.
@pytest.mark.parametrize("error", [RuntimeError("stopped"), OSError(5, "stopped")])
@pytest.mark.parametrize("at", [3, TOTAL])
def test_a_failure_midway_is_passed_on_and_leaves_nothing(tmp_path, at, error):
    def fail(done: int, total: int) -> None:
        if done == at:
            raise error

    with pytest.raises(type(error), match="stopped") as caught:
        write_synthetic_city(tmp_path / "city", SMALL, progress=fail)
    assert caught.value is error
    assert list(tmp_path.iterdir()) == []


def test_a_place_where_nothing_can_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: cannot make this folder"):
        write_synthetic_city(tmp_path / "file" / "city", SMALL)


def test_a_failure_to_write_midway_is_named_and_leaves_nothing(tmp_path):
    def block(done: int, total: int) -> None:
        # A file where the folder of the evaluation images is to be made.
        if done == 1:
            (folder,) = tmp_path.iterdir()
            (folder / "test").write_text("")

    with pytest.raises(InputError, match="city: cannot be written: Not a dir"):
        write_synthetic_city(tmp_path / "city", SMALL, progress=block)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_is_used(tmp_path, city):
    root = tmp_path / "city"
    root.mkdir()
    write_synthetic_city(root, SMALL)
    assert hashes(root) == hashes(city)


def test_a_city_of_the_same_configuration_is_reused(tmp_path):
    write_synthetic_city(tmp_path / "city", SMALL)
    before = hashes(tmp_path / "city")
    marker = next((tmp_path / "city" / "train" / "Images").rglob("*.jpg"))
    marker.write_bytes(b"kept")
    calls = []
    write_synthetic_city(tmp_path / "city", SMALL, progress=lambda *call: calls.append(call))
    assert calls == []
    assert marker.read_bytes() == b"kept"
    assert set(hashes(tmp_path / "city")) == set(before)
    assert json.loads((tmp_path / "city" / "city.json").read_text())["seed"] == 3


def test_refuses_another_configuration_a_foreign_folder_and_a_file(tmp_path, city):
    before = hashes(city)
    with pytest.raises(InputError, match="another configuration"):
        write_synthetic_city(city, dataclasses.replace(SMALL, seed=9))
    assert hashes(city) == before

    foreign = tmp_path / "holiday"
    foreign.mkdir()
    (foreign / "beach.txt").write_text("sand")
    with pytest.raises(InputError, match=r"holiday: found a folder with other content") as caught:
        write_synthetic_city(foreign, SMALL)
    assert "\n" not in str(caught.value)
    assert hashes(foreign).keys() == {"beach.txt"}

    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="found a file"):
        write_synthetic_city(tmp_path / "file", SMALL)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SyntheticCityConfig(train_places=1), "train_places: found 1, expected at least 2"),
        (lambda: SyntheticCityConfig(test_places=0), "test_places: found 0, expected at least 1"),
        (lambda: SyntheticCityConfig(seed=-1), "seed: found -1, expected at least 0"),
        (lambda: SyntheticCityConfig(image_size=(8, 56)), r"image_size: found \(8, 56\)"),
        (lambda: View(season="monsoon"), "season: found 'monsoon', expected one of spring, summer"),  # type: ignore[arg-type]
        (lambda: View(noise=math.nan), "View.noise: found nan, expected 0 to 255 grey levels"),
        (lambda: View(repaint=math.inf), "View.repaint: found inf, expected 0 to 3"),
        (lambda: render(-1, View()), "place_seed: found -1"),
    ],
)
def test_bad_arguments_are_named_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
