"""Raw MSLS: positives, headings and panoramas against brute force."""

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyproj
import pytest

from crisalad_jax.data.benchmarks import open_benchmark, read_msls
from crisalad_jax.data.class_groups import views_of
from crisalad_jax.data.places import read_places
from tests.data.benchmarks.trees import lists_of, refused, touch_all


class Image(NamedTuple):
    key: str
    east: float
    north: float
    heading: float
    pano: bool = False
    all: bool = True
    cluster: int = 3


def write_table(path: Path, columns: list[str], rows: list[list[object]]) -> None:
    """As pandas writes them: numbered, the numbers without a name."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["", *columns])
        writer.writerows([i, *row] for i, row in enumerate(rows))


ZONES = {"cph": 33, "sf": 10, "tokyo": 54, "goa": 43}


def earth_of(city: str, image: Image) -> tuple[float, ...]:
    """Its point in metres from the Earth's centre."""
    into = pyproj.Transformer.from_crs(f"EPSG:326{ZONES[city]}", "EPSG:4978")
    return into.transform(image.east, image.north, 0)


def write_side(folder: Path, images: list[Image]) -> None:
    touch_all(folder / "images", [f"{image.key}.jpg" for image in images])
    columns = ["key", "lon", "lat", "ca", "captured_at", "pano"]
    zone = f"EPSG:326{ZONES[folder.parent.name]}"
    into = pyproj.Transformer.from_crs(zone, "EPSG:4326", always_xy=True)
    rows = [
        [i.key, *into.transform(i.east, i.north), i.heading, "2017-05-01", i.pano] for i in images
    ]
    write_table(folder / "raw.csv", columns, rows)
    columns = ["key", "easting", "northing", "unique_cluster", "control_panel", "night"]
    rows = [[i.key, i.east, i.north, i.cluster, False, False, "Forward"] for i in images]
    write_table(folder / "postprocessed.csv", [*columns, "view_direction"], rows)
    columns = ["key", "all", "s2w", "w2s", "o2n", "n2o", "d2n", "n2d"]
    rows = [[i.key, i.all, *[False] * 6] for i in images]
    write_table(folder / "subtask_index.csv", columns, rows)


def some_images(seed: int, count: int) -> list[Image]:
    """On a few streets; headings that go past 360 and below 0 too."""
    draw = np.random.default_rng(seed)
    return [
        Image(
            f"{'ab'[seed % 2]}{seed}_{i}",
            *(draw.integers(0, 160_000, 2) / 1000 + [345000, 6174000]).tolist(),
            float(draw.integers(-100, 500)),
            pano=bool(draw.random() < 0.2),
            all=bool(draw.random() < 0.6),
        )
        for i in range(count)
    ]


CITIES = {
    # The same coordinates in both: they are of different zones.
    city: {"database": some_images(seed, 30), "query": some_images(seed + 1, 20)}
    for city, seed in (("sf", 2), ("cph", 4))
}


def write_msls(root: Path, cities: dict[str, dict[str, list[Image]]] = CITIES) -> Path:
    for city, sides in cities.items():
        for part, images in sides.items():
            write_side(root / "train_val" / city / part, images)
    return root


def distance(first: Image, second: Image) -> float:
    return math.hypot(first.east - second.east, first.north - second.north)


def turn(first: float, second: float) -> float:
    """The angle between two directions, by their dot product."""
    cosine = math.cos(math.radians(first - second))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def keys(paths) -> list[str]:
    return [path.stem for path in paths]


def brute_force(*, radius: float = 25, degrees: float | None = None, subtask: bool = False):
    """Keys of the database, of the queries, and of the matches of each."""
    kept = {
        (city, part): [i for i in images if not i.pano and (i.all or not subtask)]
        for city in ("cph", "sf")
        for part, images in CITIES[city].items()
    }
    database, queries, matches = [], [], []
    for city in ("cph", "sf"):
        there = kept[city, "database"]
        database += [image.key for image in there]
        for query in kept[city, "query"]:
            near = [image for image in there if distance(image, query) <= radius]
            if subtask and not near:
                continue
            queries.append(query.key)
            # No angle of these whole numbers lies within rounding of a limit but on it.
            limit = 180 if degrees is None else degrees
            matches.append([i.key for i in near if turn(i.heading, query.heading) <= limit + 1e-6])
    return database, queries, matches


@pytest.mark.parametrize(
    ("radius", "degrees", "subtask"),
    [(25.0, None, False), (12.0, None, True), (25.0, 40.0, True), (12.0, 0.0, False)],
)
def test_positives_equal_brute_force(tmp_path, radius, degrees, subtask):
    root = write_msls(tmp_path)
    benchmark = read_msls(root, radius=radius, max_heading_difference=degrees, subtask=subtask)
    database, queries, matches = brute_force(radius=radius, degrees=degrees, subtask=subtask)
    assert keys(benchmark.database) == database
    assert keys(benchmark.queries) == queries
    assert all(path.is_file() for path in (*benchmark.database, *benchmark.queries))
    found = [[database[i] for i in positives] for positives in lists_of(benchmark.positives)]
    assert found == matches
    angle = "" if degrees is None else f" and {degrees:g} degrees"
    kind = "raw, subtask all" if subtask else "raw"
    assert benchmark.name == f"MSLS val, {kind}, {len(queries)} queries, {radius:g} m{angle}"
    assert ("compass angles" in benchmark.rule) == (degrees is not None)
    assert "no panoramas" in benchmark.rule
    assert ("subtask all" in benchmark.rule) == subtask
    # Of several cities, whose numbers are of different zones, they are points in space.
    places = {
        image.key: earth_of(city, image)
        for city, sides in CITIES.items()
        for images in sides.values()
        for image in images
    }
    assert benchmark.database_positions is not None
    assert benchmark.query_positions is not None
    # The series: 0.1 mm.
    for found, expected in (
        (benchmark.database_positions, database),
        (benchmark.query_positions, queries),
    ):
        np.testing.assert_allclose(found, [places[key] for key in expected], atol=1e-3)


def test_training_places_are_clusters_of_both_sides(tmp_path):
    """A cluster's number is of its city; its images are of the database and the queries."""
    tokyo = {
        "database": [Image("a", 500, 9, 30, cluster=7), Image("b", 500, 9, 40, cluster=8)],
        "query": [
            Image("c", 501, 9, 50, cluster=7),
            Image("d", 501, 9, 50, True, cluster=7),
        ],
    }
    goa = {"database": [Image("e", 5, 6, 3, cluster=7)], "query": [Image("f", 5, 6, 3, cluster=8)]}
    root = write_msls(tmp_path, {"tokyo": tokyo, "goa": goa})
    for place in (root, root / "train_val"):
        places = read_places(place, min_images=1)
        found = {
            name: [Path(file).stem for file in places.files[start:end]]
            for name, start, end in zip(
                places.names, places.place_start[:-1], places.place_start[1:], strict=True
            )
        }
        # Without the panorama d.
        assert found == {
            **{"7 of goa": ["e"], "8 of goa": ["f"]},
            **{"7 of tokyo": ["a", "c"], "8 of tokyo": ["b"]},
        }
        assert (places.cities, places.place_city.tolist()) == (("goa", "tokyo"), [0, 0, 1, 1])
        assert all(places.path(image).is_file() for image in range(5))
        assert places.views is not None
        assert places.views[:, 2].tolist() == [3, 3, 30, 50, 40]
        # 1 m between a and c in their zone; here it is the next, turned by convergence.
        views = views_of(places)
        metres = math.hypot(*(each[3] - each[2] for each in (views.east, views.north)))
        assert metres == pytest.approx(1, rel=5e-3)
    assert read_places(root, cities=["goa"], min_images=1).cities == ("goa",)
    with refused("found goa/, tokyo/, expected some of paris/"):
        read_places(root, cities=["paris"])


def test_other_splits(tmp_path):
    images = {"database": [Image("d", 1, 2, 3)], "query": [Image("q", 1, 2, 3)]}
    root = write_msls(tmp_path, {"tokyo": images, "goa": images})
    assert read_msls(root, "train").name == "MSLS of goa, tokyo, raw, 2 queries, 25 m"
    assert lists_of(read_msls(root / "train_val", "train").positives) == [[0], [1]]
    with refused("found goa/, tokyo/, expected some of cph/, sf/"):
        read_msls(root)
    with refused("split: found 'test', expected one of train, val"):
        read_msls(root, "test")


SIDE = {"database": [Image("a", 1.5, 2.5, 30), Image("b", 1, 2, 3)], "query": [Image("q", 1, 2, 3)]}


@pytest.mark.parametrize(
    ("table", "old", "new", "message"),
    [
        ("raw.csv", "pano", "panorama", r"raw.csv: found columns .*; missing pano"),
        ("raw.csv", ",30,", ",north,", r"raw.csv: line 2: ca: found 'north', expected a number"),
        ("postprocessed.csv", "2.5", "inf", r"postprocessed.csv: line 2: northing: found 'inf'"),
        ("postprocessed.csv", "1,b", "1,c", r"postprocessed.csv: found 2 rows, .*the same 2 imag"),
        ("subtask_index.csv", "all", "any", r"subtask_index.csv: found columns .*; missing all"),
    ],
)
def test_bad_tables(tmp_path, table, old, new, message):
    root = write_msls(tmp_path, {"cph": SIDE})
    path = root / "train_val" / "cph" / "database" / table
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with refused(message):
        read_msls(root, max_heading_difference=40, subtask=True)


def test_tables_of_other_lengths_and_missing_files(tmp_path):
    root = write_msls(tmp_path, {"cph": SIDE})
    folder = root / "train_val" / "cph" / "database"
    (folder / "images" / "b.jpg").unlink()
    with refused(r"raw.csv: found 1 of 2 images missing.*b.jpg"):
        read_msls(root)
    for layout in ("msls", "msls-subtask"):
        found = open_benchmark(root, layout=layout, on_bad_image="skip").database
        assert folder / "images" / "b.jpg" in found
    table = folder / "postprocessed.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    with refused(r"postprocessed.csv: found 1 rows, expected the same 2"):
        read_msls(root)
    table.unlink()
    with refused(r"postprocessed.csv: found no such file"):
        read_msls(root)


def test_a_subtask_without_keys_goes_by_its_rows(tmp_path):
    root = write_msls(tmp_path, {"cph": SIDE})
    table = root / "train_val" / "cph" / "database" / "subtask_index.csv"
    table.write_text(",all\n0,False\n1,True\n")
    assert keys(read_msls(root, subtask=True).database) == ["b"]


@pytest.mark.parametrize(
    ("query", "given", "words"),
    [
        ([Image("q", 1, 2, 3, pano=True)], {}, "query: found 1 images, expected some that are no"),
        ([Image("q", 100, 2, 3)], {"subtask": True}, "found no query within 25 m of the database"),
        (SIDE["query"], {"max_heading_difference": 181.0}, "difference: found 181.0, expected"),
    ],
)
def test_what_cannot_be_read(tmp_path, query, given, words):
    root = write_msls(tmp_path, {"cph": SIDE | {"query": query}})
    with refused(words):
        read_msls(root, **given)
