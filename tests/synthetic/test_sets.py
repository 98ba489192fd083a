"""Rendered sets on disk: the same bits for a seed, whole or not at all, layouts read back."""

import collections
import dataclasses
import itertools
import math
import pathlib
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.places import read_places
from crisalad_jax.synthetic import (
    VARIATIONS,
    SyntheticCityConfig,
    View,
    WorldConfig,
    write_synthetic_city,
    write_world,
)
from crisalad_jax.synthetic import city as city_files
from crisalad_jax.synthetic import world as world_files
from crisalad_jax.synthetic.picture import build_place
from crisalad_jax.synthetic.world import views
from crisalad_jax.utils.errors import InputError

CITY = SyntheticCityConfig(train_places=4, test_places=5, image_size=(42, 56), seed=3)
WORLD = WorldConfig(
    scenes=15, stations=2, images_per_place=2, test_scenes=3, image_size=(30, 40), seed=5
)
IMAGES = {"city": 4 * 4 + 5 * 2, "world": 15 * 2 * 2 + 3 * 2 * 2}


class Written(NamedTuple):
    root: pathlib.Path
    config: Any
    write: Callable[..., None]


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Written]:
    folder = tmp_path_factory.mktemp("sets")
    city = Written(folder / "city", CITY, write_synthetic_city)
    world = Written(folder / "world", WORLD, write_world)
    for each in (city, world):
        each.write(each.root, each.config)
    return {"city": city, "world": world}


@pytest.fixture
def city(sets: dict[str, Written]) -> pathlib.Path:
    return sets["city"].root


@pytest.fixture
def world(sets: dict[str, Written]) -> pathlib.Path:
    return sets["world"].root


@pytest.fixture(params=["city", "world"])
def written(sets: dict[str, Written], request: pytest.FixtureRequest) -> Written:
    return sets[request.param]


def contents(root: pathlib.Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def test_the_same_seed_writes_the_same_bits_and_another_seed_others(written, tmp_path):
    (tmp_path / "again").mkdir()  # an empty folder is used
    assert written.write(tmp_path / "again", written.config, quiet=True)
    assert contents(tmp_path / "again") == contents(written.root)
    images = IMAGES[written.root.name]
    assert written.config.images == images
    written.write(tmp_path / "other", dataclasses.replace(written.config, seed=6))
    pictures, others = (
        {data for name, data in contents(root).items() if name.endswith(".jpg")}
        for root in (written.root, tmp_path / "other")
    )
    assert len(pictures) == images
    assert not pictures & others


def test_a_set_that_is_there_is_kept_and_another_is_not_written_over(written, tmp_path):
    before = contents(written.root)
    assert not written.write(written.root, written.config)
    words = "found a rendered set of another configuration (seed: "
    with pytest.raises(InputError, match=re.escape(words)):
        written.write(written.root, dataclasses.replace(written.config, seed=9))
    assert contents(written.root) == before

    (tmp_path / "beach.txt").write_text("sand")
    for root, words in (
        (tmp_path, "found a folder with files in it"),
        (tmp_path / "beach.txt", "found a file"),
        (tmp_path / "beach.txt" / "set", "cannot be made: found "),
    ):
        with pytest.raises(InputError, match=words):
            written.write(root, written.config)
    assert contents(tmp_path) == {"beach.txt": b"sand"}


@pytest.mark.parametrize("at", [3, IMAGES["city"]])
def test_a_failure_midway_is_passed_on_and_leaves_nothing(tmp_path, monkeypatch, at):
    calls = itertools.count(1)

    def fail(_: np.ndarray) -> bytes:
        if next(calls) == at:
            raise RuntimeError("stopped")
        return b""

    monkeypatch.setattr(city_files, "jpeg", fail)
    with pytest.raises(RuntimeError, match="stopped"):
        write_synthetic_city(tmp_path / "city", CITY, quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_to_write_midway_is_named_and_leaves_nothing(tmp_path, monkeypatch):
    def block(_: np.ndarray) -> bytes:
        # A file where the folder of the evaluation images is to be made.
        (folder,) = tmp_path.iterdir()
        (folder / "test").write_text("")
        return b""

    monkeypatch.setattr(city_files, "jpeg", block)
    with pytest.raises(InputError, match="city: cannot be written: Not a dir"):
        write_synthetic_city(tmp_path / "city", CITY, quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_the_city_reads_as_gsv_cities(city):
    """A place meets every season; its images lie together, and places apart."""
    places = read_places(city / "train", min_images=4)
    assert (len(places.cities), places.image_counts.tolist()) == (2, [4] * 4)
    assert set(map(places.path, range(16))) == set((city / "train" / "Images").rglob("*.jpg"))
    months = {
        (place, file.split("_")[3])
        for place, file in zip(places.image_place, places.files, strict=True)
    }
    assert months == set(itertools.product(range(4), ("01", "04", "07", "10")))
    for a, b in itertools.combinations(range(16), 2):
        (lat, lon, _), (other, far, _) = places.views[[a, b]]
        north, east = math.radians(lat - other), math.radians(lon - far)
        metres = 6_371_000 * math.hypot(north, east * math.cos(math.radians(lat)))
        same = places.image_place[a] == places.image_place[b]
        if places.place_city[places.image_place[a]] == places.place_city[places.image_place[b]]:
            assert metres < 10 if same else metres > 60


def test_the_city_s_evaluation_reads_as_utm_layout(city):
    folder = city / "test" / "images" / "test"
    seasons, hours = [], []
    for side in ("database", "queries"):
        fields = [path.name.split("@") for path in (folder / side).iterdir()]
        # An empty field before the first @, 14 fields of the format, and the suffix.
        assert {(len(each), each[0], each[-1]) for each in fields} == {(16, "", ".jpg")}
        assert all(0 <= float(each[9]) < 360 for each in fields)
        seasons.append({each[14].split("_")[0] for each in fields})
        hours.append({each[14].split("_")[1] for each in fields})
    # Queries and database never share a season, and queries come at all hours.
    assert not seasons[0] & seasons[1]
    assert hours[0] == {"noon"}
    assert len(hours[1]) > 1
    assert {read_image(path).shape for path in city.rglob("*.jpg")} == {(42, 56, 3)}


@pytest.mark.parametrize(
    ("module", "write", "config", "places"),
    [(city_files, write_synthetic_city, CITY, 4 + 5), (world_files, write_world, WORLD, 15 + 3)],
)
def test_no_place_is_in_both_splits_or_twice(tmp_path, monkeypatch, module, write, config, places):
    """Of a world, no scene is."""
    seeds = set()

    def rendered(seed: int, view: View, size: tuple[int, int], *_: str) -> np.ndarray:
        seeds.add(seed)
        return np.zeros((*size, 3), np.uint8)

    monkeypatch.setattr(module, "render", rendered)
    write(tmp_path / "set", config, quiet=True)
    assert len(seeds) == places


def test_the_world_reads_as_a_training_set_of_one_scenery_a_city(world):
    places = read_places(world / "train", min_images=2)
    # Twelve scenes fill a city; the kinds take turns.
    assert places.cities == ("corridor0001", "street0000")
    assert sorted(np.bincount(places.place_city)) == [3 * 2, 12 * 2]
    assert (places.image_counts == 2).all()


@pytest.mark.parametrize(("name", "count"), [("city", 5), ("world", 6)])
def test_each_question_has_one_answer(sets, name, count):
    """Within 10 m, and no other within 60 m."""
    for metres in (10.0, 60.0):
        benchmark = open_benchmark(sets[name].root / "test", "test", metres)
        assert (len(benchmark.queries), len(benchmark.database)) == (count, count)
        truth = [list(found) for found in benchmark.ground_truth()]
        assert sorted(truth) == [[i] for i in range(count)]


def test_a_part_of_a_world_is_the_whole_ones(world, tmp_path):
    """A scene depends on its number alone: more scenes leave those before as they are."""
    write_world(tmp_path / "part", dataclasses.replace(WORLD, scenes=12, test_scenes=1))
    part, whole = contents(tmp_path / "part"), contents(world)
    del part["set.json"]
    assert {name: whole[name] for name in part} == part


STAND = {"lateral", "forward", "heading", "height", "pitch", "field"}
VIEWS = {"stand": STAND, "traffic": {"occluders", "crowd"}, "exposure": {"exposure", "noise"}}


@pytest.mark.parametrize("left_out", VARIATIONS)
def test_what_does_not_vary_is_the_same_in_every_view_and_the_rest_as_before(left_out):
    """Sixty views each of two stations of two scenes."""
    whole = dataclasses.replace(WORLD, images_per_place=60)
    less = dataclasses.replace(whole, varied=tuple(v for v in VARIATIONS if v != left_out))
    for seed, station in itertools.product((3, 4), (0, 2)):
        before, after = (
            views(config, seed, "street", station, np.random.default_rng(0))
            for config in (whole, less)
        )
        for name in dataclasses.asdict(before[0]):
            old, new = ([getattr(view, name) for view in each] for each in (before, after))
            if name not in VIEWS.get(left_out, {left_out}):
                assert new == old
                continue
            assert len(set(old)) > 1
            (value,) = set(new)
            if name in ("forward", "height", "pitch", "field"):  # the scene's camera has these
                assert min(old) < value < max(old)
            else:
                assert value == getattr(View(), name)


def test_hard_images_are_a_share_seen_from_farther_aside_or_through_a_crowd():
    """Of 400 views about 120 stand elsewhere, and the others are bit for bit those of `hard` 0."""
    with_hard = dataclasses.replace(WORLD, images_per_place=400, hard=0.3)
    easy, hard = (
        views(config, 3, "street", 1, np.random.default_rng(0))
        for config in (dataclasses.replace(with_hard, hard=0.0), with_hard)
    )
    moved = [(a, b) for a, b in zip(easy, hard, strict=True) if a != b]
    assert 80 < len(moved) < 160  # 120 by a binomial whose deviation is 9
    reach = build_place(3, "street").reach
    assert max(abs(view.lateral) for view in easy) <= reach.lateral
    assert 1.5 * reach.lateral < max(abs(b.lateral) for _, b in moved) <= 2.2 * reach.lateral
    assert 15 < max(abs(b.heading) for _, b in moved) <= 22
    crowded = sum(b.crowd > 0 for _, b in moved)
    assert 20 < crowded < 60
    assert not any(view.crowd for view in easy)
    # Season, hour and weather are not touched.
    assert all((a.season, a.time, a.weather) == (b.season, b.time, b.weather) for a, b in moved)


def test_test_images_vary_in_everything(world, tmp_path):
    write_world(tmp_path / "less", dataclasses.replace(WORLD, varied=("season",), scenes=1))
    found, whole = contents(tmp_path / "less"), contents(world)
    tests = {name for name in whole if name.startswith("test/")}
    assert tests
    assert {name: found[name] for name in tests} == {name: whole[name] for name in tests}
    assert any(found[name] != whole[name] for name in found if name.startswith("train/Images/"))


def test_views_vary_within_the_place(world):
    """Months in the table are seasons: of 60 views all four come, and two come to most places."""
    places = read_places(world / "train", min_images=2)
    months = collections.defaultdict(set)
    for place, file in zip(places.image_place, places.files, strict=True):
        months[place].add(file.split("_")[3])
    assert set().union(*months.values()) == {"04", "07", "10", "01"}
    # Of two images of a place, three in four are of two seasons.
    assert sum(len(found) == 2 for found in months.values()) > len(months) / 2


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        (SyntheticCityConfig, {"train_places": 1}, "train_places: found 1, expected at least 2"),
        (SyntheticCityConfig, {"seed": -1}, "seed: found -1, expected at least 0"),
        (
            WorldConfig,
            {"stations": -1},
            "WorldConfig.stations: found -1, expected a whole number of at least 1",
        ),
        (WorldConfig, {"hard": 1.5}, "WorldConfig.hard: found 1.5, expected 0 to 1"),
        (WorldConfig, {"repaint": -0.5}, "WorldConfig.repaint: found -0.5, expected 0 to 3"),
        (WorldConfig, {"varied": ("sun",)}, "WorldConfig.varied: found ('sun',), expected a tuple"),
        (WorldConfig, {"sceneries": ()}, "WorldConfig.sceneries: found none, expected at least"),
    ],
)
def test_bad_sizes_are_named_in_one_line(kind, changes, words):
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        kind(**changes)
    assert "\n" not in str(caught.value)
