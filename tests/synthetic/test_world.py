"""The rendered world: its kinds of places, what repeats, what changes, the files."""

import collections
import csv
import dataclasses
import itertools
import json
import pathlib

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.synthetic import SCENERIES, View, WorldConfig, render, write_world
from crisalad_jax.synthetic.scenes import build_place
from crisalad_jax.synthetic.world import VARIATIONS, views
from crisalad_jax.utils.errors import InputError

SMALL = WorldConfig(
    scenes=15, stations=2, images_per_place=2, test_scenes=3, image_size=(30, 40), seed=5
)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    root = tmp_path_factory.mktemp("world") / "world"
    write_world(root, SMALL)
    return root


def contents(root: pathlib.Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def test_the_same_seed_writes_the_same_bits_and_another_seed_others(world, tmp_path):
    write_world(tmp_path / "again", SMALL)
    assert contents(tmp_path / "again") == contents(world)
    write_world(tmp_path / "other", dataclasses.replace(SMALL, seed=6))
    pictures, others = (
        {data for name, data in contents(root).items() if name.endswith(".jpg")}
        for root in (world, tmp_path / "other")
    )
    assert len(pictures) == 15 * 2 * 2 + 3 * 2 * 2
    assert not pictures & others


def test_it_reads_as_a_training_set_of_one_scenery_a_city(world):
    places = read_places(world / "train", min_images=2)
    # Twelve scenes fill a city; the kinds take turns.
    assert places.cities == ("corridor0001", "street0000")
    assert sorted(np.bincount(places.place_city)) == [3 * 2, 12 * 2]
    assert (places.image_counts == 2).all()


def test_each_question_has_one_answer(world):
    benchmark = open_benchmark(world / "test", "test", 25.0)
    assert (len(benchmark.queries), len(benchmark.database)) == (6, 6)
    assert [list(found) for found in benchmark.ground_truth()] == [[i] for i in range(6)]


def test_a_world_that_is_there_is_kept_and_another_is_not_written_over(world):
    before = contents(world)
    write_world(world, SMALL)
    with pytest.raises(InputError, match="found a rendered world of another configuration"):
        write_world(world, dataclasses.replace(SMALL, scenes=16))
    assert contents(world) == before


def test_a_part_of_a_world_is_the_whole_ones(world, tmp_path):
    """A scene depends on its number alone: more scenes leave those before as they are."""
    write_world(tmp_path / "part", dataclasses.replace(SMALL, scenes=12, test_scenes=1))
    part, whole = contents(tmp_path / "part"), contents(world)
    for name, data in part.items():
        if name != "world.json":
            assert whole[name] == data


VIEWS: dict[str, set[str]] = {
    "stand": {"lateral", "forward", "heading", "height", "pitch", "field"},
    "season": {"season"},
    "time": {"time"},
    "weather": {"weather"},
    "traffic": {"occluders"},
    "exposure": {"exposure", "noise"},
}


@pytest.mark.parametrize("left_out", VARIATIONS)
def test_what_does_not_vary_is_the_same_in_every_view_and_the_rest_as_before(left_out):
    """Twenty views each of two stations of two scenes."""
    others = tuple(name for name in VARIATIONS if name != left_out)
    less = dataclasses.replace(SMALL, varied=others)
    for seed, station in itertools.product((3, 4), (0, 2)):
        drawn = [
            views(config, seed, "street", station, 20, np.random.default_rng(0))
            for config in (SMALL, less)
        ]
        before, after = ([dataclasses.asdict(view) for view in each] for each in drawn)
        for name in before[0]:
            values = {view[name] for view in after}
            if name in VIEWS[left_out]:
                varied = {view[name] for view in before}
                assert len(varied) > 1
                (value,) = values
                if name in ("forward", "height", "pitch", "field"):  # the scene's camera has these
                    assert min(varied) < value < max(varied)
                else:
                    assert value == getattr(View(), name)
            else:
                assert [view[name] for view in after] == [view[name] for view in before]


def test_test_images_vary_in_everything(world, tmp_path):
    less = dataclasses.replace(SMALL, varied=("season",), scenes=1)
    write_world(tmp_path / "less", less)
    found, whole = contents(tmp_path / "less"), contents(world)
    tests = {name for name in whole if name.startswith("test/")}
    assert tests
    assert {name: found[name] for name in tests} == {name: whole[name] for name in tests}
    assert any(found[name] != whole[name] for name in found if name.startswith("train/Images/"))


def test_the_order_of_variations_makes_no_other_world(world):
    assert json.loads((world / "world.json").read_text())["varied"] == list(VARIATIONS)
    write_world(world, dataclasses.replace(SMALL, varied=tuple(reversed(VARIATIONS))))
    with pytest.raises(InputError, match="found a rendered world of another configuration"):
        write_world(world, dataclasses.replace(SMALL, varied=VARIATIONS[1:]))


@pytest.mark.parametrize("scenery", SCENERIES)
def test_pictures_depend_on_place_and_view_alone(scenery):
    view, size = View(occluders=3, noise=2.0, seed=4), (60, 80)
    first = render(7, view, size, scenery)
    np.testing.assert_array_equal(render(7, view, size, scenery), first)
    assert (render(8, view, size, scenery) != first).mean() > 0.3
    for change in (
        {"lateral": 0.3},
        {"forward": 1.0},
        {"heading": 4.0},
        {"height": 1.0},
        {"pitch": 3.0},
        {"field": 60.0},
        {"repaint": 0.3},
        {"occluders": None},
        {"time": "night"},
    ):
        changed = dataclasses.replace(view, **change)
        assert not np.array_equal(render(7, changed, size, scenery), first), change


def test_sceneries_are_other_places_of_one_seed():
    pictures = [render(1, View(), (60, 80), scenery) for scenery in SCENERIES]
    for first, second in itertools.combinations(pictures, 2):
        assert (first != second).mean() > 0.3


def test_indoors_neither_season_nor_weather_is_seen():
    there = render(2, View(), (60, 80), "corridor")
    for change in ({"weather": "haze"}, {"weather": "rain"}, {"season": "autumn"}):
        changed = render(2, dataclasses.replace(View(), **change), (60, 80), "corridor")
        np.testing.assert_array_equal(changed, there)


def test_winter_covers_the_country():
    """Snow is brighter than grass; means of twelve places, half of the smallest gap."""
    means = {
        season: np.mean(
            [render(seed, View(season=season), (60, 80), "country") for seed in range(12)]
        )
        for season in ("summer", "winter")
    }
    assert means["winter"] > means["summer"] + 15


def test_stations_of_a_scene_follow_each_other():
    for scenery in SCENERIES:
        reach = build_place(3, scenery).reach
        # Views of two stations never overlap in where they stand.
        assert 0 < 2 * reach.forward < reach.step
        assert 0 < reach.height[0] < reach.height[1]


def test_views_vary_within_the_place(world):
    """Months in the table are seasons: of 60 views all four come, and two come to most places."""
    months = collections.defaultdict(set)
    for table in (world / "train" / "Dataframes").glob("*.csv"):
        with table.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                months[table, row["place_id"]].add(row["month"])
    assert set().union(*months.values()) == {"4", "7", "10", "1"}
    # Of two images of a place, three in four are of two seasons.
    assert sum(len(found) == 2 for found in months.values()) > len(months) / 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scenes": 0}, "WorldConfig.scenes: found 0, expected at least 1"),
        ({"stations": -1}, "WorldConfig.stations: found -1, expected at least 1"),
        ({"image_size": (8, 8)}, r"WorldConfig.image_size: found \(8, 8\)"),
        ({"seed": -1}, "WorldConfig.seed: found -1"),
        ({"repaint": -0.5}, "WorldConfig.repaint: found -0.5, expected 0 to 3"),
        (
            {"varied": ("sun",)},
            r"WorldConfig.varied: found \('sun',\), expected a tuple",
        ),
        ({"sceneries": ()}, r"WorldConfig.sceneries: found \(\), expected at least one"),
    ],
)
def test_bad_sizes_are_named(changes, words):
    with pytest.raises(InputError, match=words):
        WorldConfig(**changes)
