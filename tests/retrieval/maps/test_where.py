"""Searches of some of a map's images against the same conditions in plain Python."""

import dataclasses
import datetime
import pathlib
import uuid
from typing import Any

import numpy as np
import pytest

from crisalad_jax.data.positions import Positions
from crisalad_jax.retrieval.maps import appending
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.approximate import Approximate
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import MapMetadata
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.utils.errors import InputError
from tests.killed_appends import metadata, rows
from tests.retrieval.maps.milvus_server import ADDRESS

UTC = datetime.UTC
DAYS = ("2026-04-30", "2026-05-01", "2026-05-02")
FOLDERS = ("monday", "monday2", "monday/left", "walk.mp4", "bag.mcap#/camera")


def at(text: str) -> float:
    return datetime.datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()


def name_of(number: int) -> str:
    folder = FOLDERS[number % len(FOLDERS)]
    seconds = f"{int(at('2026-05-01')) - 20 + number}"
    return f"{folder}#t={seconds}.500" if "." in folder else f"{folder}/{number}.jpg"


def position_of(number: int) -> tuple[float, float] | None:
    return None if number % 7 == 0 else (float(number % 10), float(number))


@dataclasses.dataclass
class Made:
    folder: pathlib.Path
    days: dict[str, str]
    """When each image was added."""


SERVER = pytest.param(f"milvus:{ADDRESS}", marks=pytest.mark.slow)
STORES = ["files", "milvus:rows.db", SERVER]


def about(kind: str, request: pytest.FixtureRequest) -> MapMetadata:
    """Of a map with a type, an approximate search or a store."""
    if kind == f"milvus:{ADDRESS}":
        request.getfixturevalue("milvus_server")
    made = metadata(kind if ":" in kind else "files", f"crisalad_{uuid.uuid4().hex}")
    return dataclasses.replace(made, dtype=kind) if kind in ("float16", "bits") else made


@pytest.fixture(params=["float16", "bits", "hnsw", *STORES])
def made(tmp_path, monkeypatch, request) -> Made:
    """Sixty images, added on three days, of which every eleventh was removed."""
    days = {}
    with open_for_appending(tmp_path / "map", about(request.param, request)) as target:
        for first, day in zip(range(0, 60, 20), DAYS, strict=True):
            monkeypatch.setattr(appending, "_now", lambda day=day: f"{day}T10:00:00+00:00")
            names = [name_of(number) for number in range(first, first + 20)]
            known = {name_of(n): position_of(n) for n in range(first, first + 20)}
            of = {name: spot for name, spot in known.items() if spot}
            positions = Positions(("lat", "lon"), of)
            new = rows(first, 20)
            target.append(names, [7] * 20, new, root="/images", positions=positions)
            days |= dict.fromkeys(names, day)
        target.change("remove", removed=range(0, 60, 11))
        if request.param == "hnsw":
            target.build_search("hnsw")
    return Made(tmp_path / "map", days)


CONDITIONS = {
    "folder=monday": lambda image, day, when: image.name.startswith("monday/"),
    "folder=monday/left/": lambda image, day, when: image.name.startswith("monday/left/"),
    "folder=monday*": lambda image, day, when: image.name.startswith("monday"),
    "folder=walk.mp4": lambda image, day, when: image.name.startswith("walk.mp4#"),
    "folder=bag.mcap": lambda image, day, when: image.name.startswith("bag.mcap#/camera"),
    "added>=2026-05-01": lambda image, day, when: day >= "2026-05-01",
    "added>2026-05-01": lambda image, day, when: day > "2026-05-01",
    "added<=2026-05-01": lambda image, day, when: day <= "2026-05-01",
    "added<2026-05-01T10:00": lambda image, day, when: day < "2026-05-01",
    "added=2026-05-01": lambda image, day, when: day == "2026-05-01",
    "added>=2026-04-30, added<2026-05-02": lambda image, day, when: day < "2026-05-02",
    "time>=2026-05-01": lambda image, day, when: when is not None and when >= at("2026-05-01"),
    "time<2026-05-01T02:00:10+02:00": lambda image, day, when: (
        when is not None and when < at("2026-05-01T00:00:10")
    ),
    "box=10,2,40,8.5": lambda image, day, when: (
        image.position is not None
        and 2 <= image.position[0] <= 8.5
        and 10 <= image.position[1] <= 40
    ),
    "box=50,0,20,9": lambda image, day, when: (
        image.position is not None and (image.position[1] >= 50 or image.position[1] <= 20)
    ),
    " folder = monday ,added>=2026-05-01,box=0,0,50,9": lambda image, day, when: (
        image.name.startswith("monday/")
        and day >= "2026-05-01"
        and image.position is not None
        and image.position[1] <= 50
    ),
}


def test_a_search_is_of_the_images_that_meet_the_conditions(made):
    """Answers are those among all images, in that order, without the others; also all of them."""
    queries = rows(100, 3)
    with Map.open(made.folder) as places:
        everything = places.search(queries, len(places), exact=True)
        for text, meets in CONDITIONS.items():
            chosen = set()
            for number, image in enumerate(places.images):
                stamp = float(image.name.partition("#t=")[2] or 0)
                # A video's seconds are of the video.
                when = stamp if image.name.startswith("bag.mcap") else None
                if meets(image, made.days[image.name], when):
                    chosen.add(number)
            assert 0 < len(chosen) < len(places), text
            found = places.search(queries, len(places), where=text)
            for query in range(3):
                expected = [
                    (number, similarity)
                    for number, similarity in zip(
                        *(part[query] for part in everything), strict=True
                    )
                    if number in chosen
                ]
                numbers, similarities = zip(*expected, strict=True)
                assert found.indices[query].tolist() == list(numbers), text
                # Files give the same bits; Milvus adds 48 products of float32 in another order.
                rounding = 0 if places.metadata.store == "files" else 2e-6
                np.testing.assert_allclose(found.similarities[query], similarities, 0, rounding)
            first = places.search(queries, 2, where=Where.parse(text))
            np.testing.assert_array_equal(first.indices, found.indices[:, :2])


def test_an_index_is_not_asked_for_a_twentieth_of_a_map(tmp_path):
    """A graph would pass by the few that count; there is none here to be asked."""
    with open_for_appending(tmp_path / "map", metadata("files")) as target:
        names = [f"{'few' if number < 3 else 'many'}/{number}.jpg" for number in range(60)]
        target.append(names, [7] * 60, rows(0, 60), root="/images")
        expected = target.search(rows(100, 2), 9, where="folder=few")
        nobody: Any = None
        target._approximate = Approximate("hnsw", nobody, target._segments.store, 1.0)
        found = target.search(rows(100, 2), 9, where="folder=few")
        np.testing.assert_array_equal(found.indices, expected.indices)
        assert sorted(found.indices[0].tolist()) == [0, 1, 2]


@pytest.mark.parametrize("store", STORES)
def test_conditions_hold_for_what_is_appended_and_moved_later(tmp_path, store, request):
    with open_for_appending(tmp_path / "map", about(store, request)) as target:
        target.append(["a/1.jpg", "b/1.jpg"], [7, 7], rows(0, 2), root="/images")
        assert target.search(rows(1, 1), 5, where="folder=a").indices.tolist() == [[0]]
        target.append(["a/2.jpg"], [7], rows(2, 1), root="/images")
        assert target.search(rows(2, 1), 5, where="folder=a").indices.tolist() == [[2, 0]]
        target.change("move", moved=Positions(("x", "y"), {"b/1.jpg": (1.0, 2.0)}))
        assert target.search(rows(2, 1), 5, where="box=1,2,1,2").indices.tolist() == [[1]]
        target.change("remove", removed=[0])
        assert target.search(rows(0, 1), 5, where="folder=a").indices.tolist() == [[1]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("colour=red", "where: found 'colour=red', expected folder="),
        ("", "where: found '', expected folder="),
        ("folder=", "where: found 'folder=', expected folder="),
        ("folder>a", "where: found 'folder>a', expected folder="),
        ("folder=a, box>=1,2,3,4", "where: found 'box>=1,2,3,4', expected folder="),
        ("added>=2026-13-01", "where: found time '2026-13-01', expected a day"),
        ("time<yesterday", "where: found time 'yesterday', expected a day"),
        ("box=1,2,3", "where: found box '1,2,3', expected four numbers"),
        ("box=1,2,3,inf", "where: found box '1,2,3,inf', expected four numbers"),
        ("box=1,4,3,2", "where: found box '1,4,3,2', expected four numbers"),
        ("folder=a,folder=b", "where: found folder twice, expected it once"),
        ("box=1,2,3,4", "where: found a box, expected none: no image of the map has a position"),
        ("folder=c", r"where: found none of 2 images \(0 by folder\), expected at least one"),
        ("folder=a,added>2026", "where: found time '2026', expected a day"),
        (
            "folder=a,added>2126-01-01",
            r"where: found none of 2 images \(1 by folder, 0 by added\)",
        ),
    ],
)
def test_bad_conditions_are_one_line(tmp_path, text, words):
    with open_for_appending(tmp_path / "map", metadata("files")) as target:
        target.append(["a/1.jpg", "b/1.jpg"], [7, 7], rows(0, 2), root="/images")
        with pytest.raises(InputError, match=words) as error:
            target.search(rows(1, 1), 5, where=text)
        assert "\n" not in str(error.value)


def test_a_box_over_the_antimeridian_is_of_degrees(tmp_path):
    with open_for_appending(tmp_path / "map", metadata("files")) as target:
        positions = Positions(("east", "north"), {"1.jpg": (1.0, 2.0)})
        target.append(["1.jpg"], [7], rows(0, 1), root="/images", positions=positions)
        with pytest.raises(InputError, match="of east, expected west <= east"):
            target.search(rows(1, 1), 5, where="box=3,0,1,9")


def test_a_day_stands_for_all_of_it_and_a_time_for_its_second():
    day = at("2026-05-01")
    assert Where.parse("added=2026-05-01").added == (day, day + 24 * 3600)
    assert Where.parse("time=2026-05-01T00:00:05").time == (day + 5, day + 6)
    assert Where.parse("time>2026-05-01T02:00:05+02:00").time == (day + 6, np.inf)
