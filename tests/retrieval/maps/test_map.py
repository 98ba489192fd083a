"""Maps: what they say of themselves, what they refuse, and that a kill leaves them whole."""

import dataclasses
import datetime
import functools
import json
import math
import os
import pathlib
import socket
import subprocess
import sys

import numpy as np
import pymilvus
import pyproj
import pytest

import crisalad_jax.retrieval.maps.appending
from crisalad_jax.data.positions import Positions, utm_positions
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.corrections import merge_maps
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import check_model, new_metadata, read_metadata
from crisalad_jax.retrieval.segments import write_record
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.output import Note
from tests import killed_appends
from tests.conftest import MODEL, random_params
from tests.killed_appends import append_until, metadata, names, rows
from tests.utils.test_checksums import flips

ROOT = pathlib.Path(__file__).parents[3]
LENGTH = killed_appends.LENGTH
DESCRIBER = describer_of(Model(random_params(MODEL), MODEL))


def killed(how: str, folder: pathlib.Path, store: str = "files", kills: int = 0, longest=0.0):
    """Run tests/killed_appends.py; what it printed."""
    program = [sys.executable, "-m", "tests.killed_appends", how, folder, store, kills, longest]
    done = subprocess.run(list(map(str, program)), cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()


@pytest.fixture
def folder(tmp_path) -> pathlib.Path:
    """Of seven images, in segments of one, two and four."""
    append_until(tmp_path / "map", 7)
    return tmp_path / "map"


def unsealed(path: pathlib.Path, **changes) -> None:
    value = json.loads(path.read_text()) | changes
    del value["checksum"]
    path.write_text(json.dumps(value) + "\n")


def reseal(path: pathlib.Path, **changes) -> None:
    """With the checksum of what is written: what is found wrong is the value."""
    unsealed(path, **changes)
    write_record(path, json.loads(path.read_text()))


@pytest.mark.parametrize(
    "name",
    [
        *("segments", "segments/0000000000.npy", "added", "added/a", "approximate", "similar"),
        *("calibration.json", "calibration-verified.json"),
    ],
)
def test_a_link_in_a_map_is_neither_read_nor_written_through(tmp_path, folder, name):
    outside, link = tmp_path / "outside", folder / name
    if link.exists():
        link.rename(outside)
    else:
        link.parent.mkdir(exist_ok=True)
        outside.mkdir()
        (outside / "0000000009.npy").write_text("mine")
    link.symlink_to(outside)
    before = sorted(outside.rglob("*"))
    for enter in (Map.open, lambda path: open_for_appending(path, metadata("files")).__enter__()):
        with pytest.raises(InputError, match=f"^{link}: found a link, expected the file or folder"):
            enter(folder)
    assert sorted(outside.rglob("*")) == before
    assert not (folder / ".crisalad-lock").exists()


# What is in it


def test_a_map_lists_its_folders_additions_and_extent(tmp_path, monkeypatch):
    """By hand; additions that follow each other on a day, from one folder, are one."""
    days = iter(["2025-06-11", "2025-06-12", "2025-06-12", "2025-06-12", "2025-06-13"])

    class Clock(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls.fromisoformat(f"{next(days)}T10:00:00+00:00")

    monkeypatch.setattr(crisalad_jax.retrieval.maps.appending.datetime, "datetime", Clock)
    # 2014-12-12 10:56:38 UTC, by `date -u -d @1418381798`.
    parts = [
        ("/days", ["monday/1418381798.png", "monday/1418381861.png"]),
        ("/days", ["tuesday/0.png", "tuesday/1418381798.png"]),
        ("/days", ["tuesday/2.png"]),
        ("/videos", ["walk.mp4#t=0.500", "walk.mp4#t=12.250"]),
        ("/videos", ["@3@4@32@N@.jpg", "@1@5@32@N@.jpg"]),
    ]
    with open_for_appending(tmp_path / "map", metadata("files")) as target:
        for root, new in parts:
            first = len(target)
            where = utm_positions(new)
            target.append(new, [1] * len(new), rows(first, len(new)), root=root, positions=where)
        grown = target.additions
    with Map.open(tmp_path / "map") as found:
        assert found.additions == grown
        assert grown == [
            ("2025-06-11", "/days", 2),
            ("2025-06-12", "/days", 3),
            ("2025-06-12", "/videos", 2),
            ("2025-06-13", "/videos", 2),
        ]
        summary = found.summary()
    utc = ("2014-12-12T10:56:38Z", "2014-12-12T10:57:41Z")
    assert summary["folders"] == [
        {"folder": "monday", "images": 2, "first": utc[0], "last": utc[1]},
        {"folder": "tuesday", "images": 3},  # not all of its names say times
        {"folder": "walk.mp4", "images": 2, "first": 0.5, "last": 12.25},
        {"folder": ".", "images": 2},
    ]
    assert summary["extent"] == {"east": [1.0, 3.0], "north": [4.0, 5.0]}


# Killed


@pytest.mark.parametrize("kills", [3, pytest.param(50, marks=pytest.mark.slow)])
def test_a_map_killed_at_random_moments_is_whole_and_goes_on(tmp_path, kills):
    assert killed("random", tmp_path, kills=kills, longest=0.15) == [str(kills)]


@pytest.mark.slow
def test_a_map_in_milvus_that_is_killed_is_whole_and_goes_on(tmp_path):
    assert killed("random", tmp_path, "milvus:rows.db", kills=8, longest=6.0) == ["8"]


def test_a_map_killed_at_any_step_of_an_append_is_whole_and_goes_on(tmp_path):
    """Also half-way through a file. So many steps there are, or the test has missed some."""
    steps = [int(line) for line in killed("steps", tmp_path)]
    # A file: a write, two fsyncs and a rename; of the new map three appends of two files each.
    assert steps[0] >= 4 * (1 + 3 * 2)
    assert steps[1] >= 4 * 2


@pytest.mark.slow  # the next one kills an append
def test_a_map_killed_at_any_step_of_a_change_is_as_before_or_after(tmp_path):
    steps = list(map(int, killed("changes", tmp_path)))
    assert len(steps) == 5
    # Of remove, replace, move, merge, and a merge into a new map: to write, sync and rename one
    # file, and a folder to sync, are four calls already.
    assert min(steps) >= 4


@pytest.mark.parametrize("kills", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_a_map_killed_at_random_moments_of_a_change_is_as_before_or_after(tmp_path, kills):
    found = killed("random changes", tmp_path, kills=kills, longest=0.05)
    assert found == [str(kills)] * 5


def test_a_full_disk_is_one_line_and_leaves_the_map_as_it_was(tmp_path):
    lines = killed("disk", tmp_path)
    expected = ("map.json", "0000000003.npy", "0000000003.npy")
    assert len(lines) == len(expected)
    for line, name in zip(lines, expected, strict=True):
        assert line.endswith(f"{name}: cannot be written: File too large")


# A lost record


def files_in(folder: pathlib.Path) -> dict[pathlib.Path, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path: path.read_bytes() for path in files if path.name != ".crisalad-lock"}


def test_descriptors_without_a_record_are_removed_with_a_note(folder):
    (folder / "segments" / "0000000003.json").unlink()
    with pytest.warns(Note, match=r"0000000003\.npy: removed descriptors without a rec"):
        append_until(folder, 3)
    assert not (folder / "segments" / "0000000003.npy").exists()
    assert killed_appends.check(folder) == 3


GRAPH = "approximate/hnsw-0123456789abcdef.index"


@pytest.mark.parametrize(
    ("told", "value", "images", "words"),
    [
        ("calibration.json", {}, 1, "found it in a map with records of only 0 images"),
        ("calibration-verified.json", {}, 1, "found it in a map with records of only 0 images"),
        (GRAPH, {"images": 7}, 7, "found it in a map with records of only 3 images, expected the"),
    ],
)
def test_a_map_that_lost_its_last_record_is_refused_where_more_tells_of_it(
    tmp_path, told, value, images, words
):
    folder = tmp_path / "map"
    append_until(folder, images)
    (folder / told).parent.mkdir(exist_ok=True)
    (folder / told).write_bytes(b"")
    write_json((folder / told).with_suffix(".json"), value)
    max((folder / "segments").glob("*.json")).unlink()
    before = files_in(folder)
    with pytest.raises(InputError, match=f"{told}: {words}"):
        append_until(folder, 9)
    assert files_in(folder) == before


# What a map knows


def test_what_was_appended_is_there_by_number_name_and_position(tmp_path):
    where = Positions(("lat", "lon"), {"a.jpg": (1.25, -2.5), "c.jpg": (3.0, 4.0)})
    with open_for_appending(tmp_path / "map", metadata("files")) as target:
        target.append(["a.jpg", "b.jpg"], [10, 20], rows(0, 2), root="/x", positions=where)
        assert len(target) == 2
        target.append(["c.jpg"], [30], rows(2, 1), root="/y", positions=where)
    with Map.open(tmp_path / "map") as found:
        assert [tuple(image) for image in found.images] == [
            ("a.jpg", 10, (1.25, -2.5), "/x"),
            ("b.jpg", 20, None, "/x"),
            ("c.jpg", 30, (3.0, 4.0), "/y"),
        ]
        assert found.axes == ("lat", "lon")
        assert found.image("b.jpg") == found.images[1]
        assert found.image("d.jpg") is None
        np.testing.assert_array_equal(np.concatenate(list(found.descriptors)), rows(0, 3))
        assert found.metadata == metadata("files")


def test_a_reader_sees_the_map_as_it_was_opened(folder):
    with Map.open(folder) as before:
        append_until(folder, 20)
        assert len(before) == 7
        found = before.search(rows(15, 1), 7)
        assert set(found.indices[0].tolist()) == set(range(7))
    with Map.open(folder) as after:
        assert after.search(rows(15, 1), 1).indices.tolist() == [[15]]


def test_verify_names_the_descriptors_that_changed(folder):
    path = folder / "segments" / "0000000003.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    words = r"0000000003: .*3 to 6 have"
    with pytest.raises(InputError, match=words), Map.open(folder):
        pass
    with Map.open(folder, verify=False) as found:
        assert len(found) == 7
        for read in (found.verify, lambda: found.summary(verify=True)):
            with pytest.raises(InputError, match=words):
                read()


@pytest.mark.parametrize(
    "name", ["map.json", "segments/0000000001.json", "segments/0000000003.npy"]
)
def test_one_other_byte_anywhere_in_a_map_is_refused(folder, name):
    path = folder / name
    whole = path.read_bytes()
    tried = 0
    for place, data in flips(whole, 60):
        path.write_bytes(data)
        with pytest.raises(InputError) as error, Map.open(folder):
            pass
        words = str(error.value)
        # Descriptors are named by their numbers.
        assert str(folder / name.removesuffix(".npy")) in words, (place, words)
        assert "\n" not in words
        tried += 1
    assert tried == 60
    path.write_bytes(whole)
    assert killed_appends.check(folder) == 7


# Checksums and forgeries


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"names": ["/etc/passwd"]}, "found name '/etc/passwd', expected one below the folder"),
        ({"names": ["a/../../b.jpg"]}, "found name 'a/../../b.jpg', expected one below"),
        ({"root": 3}, "found root 3 and added"),
        ({"bytes": [math.inf]}, "cannot convert float infinity"),
    ],
)
def test_a_record_of_no_images_below_its_folder_is_refused(folder, fields, words):
    """With the right checksum: who forges a record can forge that too."""
    reseal(folder / "segments/0000000000.json", **fields)
    with pytest.raises(InputError, match=rf"0000000000\.json: not a whole record .*{words}"):
        Map.open(folder)


def test_who_edits_the_description_removes_its_checksum(folder):
    unsealed(folder / "map.json")
    with Map.open(folder) as places:
        assert len(places)


# The model


def test_a_description_is_read_as_it_was_written(tmp_path):
    made = new_metadata(DESCRIBER, tmp_path / "w.safetensors", tmp_path / "map")
    with open_for_appending(tmp_path / "map", made) as target:
        assert target.metadata == made
        assert read_metadata(tmp_path / "map") is None  # without images it is no map
        row = np.eye(made.descriptor_length, dtype=np.float32)[:1]
        target.append(["a.jpg"], [7], row, root="/images")
    found = read_metadata(tmp_path / "map")
    assert found is not None
    assert dataclasses.asdict(found) == dataclasses.asdict(made)
    assert made.descriptor_length == MODEL.descriptor_dim
    assert (made.grouping, made.format, made.store) == ("single", 4, "files")
    other = new_metadata(DESCRIBER, tmp_path / "w", tmp_path / "map")
    assert made.collection != other.collection


def test_another_model_is_refused_by_both_hashes():
    made = dataclasses.replace(metadata("files"), model="a" * 64, weights="/w/old.safetensors")
    check_model(made, "map", "a" * 64, "new")
    words = (
        r"map: found a map made by model a{12} \(/w/old\.safetensors\), but new is model b{12}: "
        r"expected the same \(--weights\), or a new map \(`crisalad index` into a new folder\)$"
    )
    with pytest.raises(InputError, match=words):
        check_model(made, "map", "b" * 64, "new")


# Refused


def test_one_process_appends_at_a_time(folder):
    with (
        open_for_appending(folder, metadata("files")),
        pytest.raises(InputError, match="map: found another process that writes here") as error,
        open_for_appending(folder, metadata("files")),
    ):
        pass
    assert f"(process {os.getpid()} on {socket.gethostname()})" in str(error.value)
    assert "\n" not in str(error.value)
    append_until(folder, 8)


RECORD = "segments/0000000001.json"


@pytest.mark.parametrize("write", [False, True])
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: reseal(m / "map.json", format=5), "found 5, expected one of 4 @ config.format"),
        (lambda m: (m / "map.json").write_text('{"model'), "map.json: found no JSON (Unterminated"),
        (lambda m: reseal(m / "map.json", dtype="int3"), "map.json: dtype: found 'int3', expected"),
        (lambda m: reseal(m / "map.json", store="n"), "map.json: store: found 'n', expected files"),
        (lambda m: (m / "map.json").unlink(), "map: found segments and no map.json"),
        (lambda m: (m / RECORD).write_text("[]"), f"{RECORD}: found no checksum, expected a rec"),
        (lambda m: reseal(m / RECORD, bytes=[7]), f"{RECORD}: not a whole record of images"),
        (lambda m: (m / RECORD).unlink(), "0000000003.json: expected 0000000001.json before it"),
        (
            lambda m: (m / RECORD).with_suffix(".npy").unlink(),
            "0000000001.npy: found no such file, expected a file of a map's descriptors",
        ),
    ],
)
def test_a_damaged_map_is_one_line(folder, spoil, words, write):
    spoil(folder)
    with (
        pytest.raises(InputError) as error,
        open_for_appending(folder, metadata("files")) if write else Map.open(folder),
    ):
        pass
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_no_map_is_refused_and_left_alone(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("x")
    append = functools.partial(append_until, total=1)
    for call, name, words in (
        (Map.open, "photos", r"photos: found a\.jpg and no map\.json"),
        (Map.open, "none", "none: found no map"),
        (append, "photos", r"photos: found a\.jpg and no map\.json"),
        (append, "file", "cannot make this folder"),
    ):
        with pytest.raises(InputError, match=words):
            call(tmp_path / name)
    assert os.listdir(tmp_path / "photos") == ["a.jpg"]
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("new", "descriptors", "words"),
    [
        (["7.jpg", "3.jpg"], rows(7, 2), "found 1 of 2 names twice, or in the map already"),
        (["7.jpg"], rows(7, 1)[:, :-1], r"found shape \(1, 47\), expected \(images, 48\)"),
        (
            ["7.jpg"],
            2 * rows(7, 1),
            "descriptors: row 0 is of length 2, expected finite unit vectors",
        ),
        ([], rows(7, 1)[:0], r"found shape \(0, 48\)"),
    ],
)
def test_what_cannot_be_appended_changes_nothing(folder, new, descriptors, words):
    with open_for_appending(folder, metadata("files")) as target:
        with pytest.raises(InputError, match=words):
            target.append(new, [7] * len(new), descriptors, root="/images")
        assert len(target) == 7
    assert killed_appends.check(folder) == 7
    append_until(folder, 12)


FIRST = "@0499000.00@5411000.00@32@U@@@@@@@@@@@.jpg"
NEXT = "@0939500.00@5420600.00@31@U@@@@@@@@@@@.jpg"


def test_a_map_has_metres_of_one_zone(folder):
    """Images of a neighbouring zone get the numbers that pyproj gives them in the map's."""
    into = pyproj.Transformer.from_crs("EPSG:32631", "EPSG:32632", always_xy=True)
    with open_for_appending(folder, metadata("files")) as target:
        target.append([FIRST], [7], rows(7, 1), root="/", positions=utm_positions([FIRST]))
        target.append([NEXT], [7], rows(8, 1), root="/", positions=utm_positions([NEXT]))
        degrees = Positions(("lat", "lon"), {"a.jpg": (48.85, 9.0)})
        target.append(["a.jpg"], [7], rows(9, 1), root="/", positions=degrees)
        beyond = Positions(("lat", "lon"), {"b.jpg": (48.85, 18.1)})
        with pytest.raises(InputError, match=r"'b.jpg' 9.1 degrees .*, expected at most 9;"):
            target.append(["b.jpg"], [7], rows(10, 1), root="/", positions=beyond)
        target.fitted(["b.jpg"], Positions(("lat", "lon"), {"b.jpg": (48.85, 17.9)}))
        far = FIRST.replace("@32@", "@10@")
        with pytest.raises(
            InputError, match=r"132 degrees of longitude .* of zone 32 north, whose"
        ):
            target.append([far], [7], rows(10, 1), root="/", positions=utm_positions([far]))
    with Map.open(folder) as places:
        first, second, third = (image.position for image in places.images[-3:])
        assert (places.axes, places.zone) == (("east", "north"), (32, False))
        assert places.summary()["zone"] == "32 north"
    merge_maps(folder.parent / "whole", folder)
    with Map.open(folder.parent / "whole") as whole:
        assert (whole.axes, whole.zone) == (("east", "north"), (32, False))
        assert [image.position for image in whole.images[-3:]] == [first, second, third]
    assert first == (499000.0, 5411000.0)
    # Rounded to a tenth of a millimetre; the series is as exact.
    np.testing.assert_allclose(second, into.transform(939500, 5420600), atol=3e-4)
    degrees = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    np.testing.assert_allclose(third, degrees.transform(9.0, 48.85), atol=3e-4)


@pytest.mark.parametrize(
    ("queries", "k", "words"),
    [
        (rows(0, 1), 0, "k: found 0, expected at least 1"),
        (3 * rows(0, 1), 1, "queries: row 0 is of length 3"),
    ],
)
def test_queries_that_are_none_are_refused(folder, queries, k, words):
    with Map.open(folder) as found, pytest.raises(InputError, match=words):
        found.search(queries, k)


def test_a_map_that_fails_before_it_has_images_is_removed(tmp_path):
    """Also what was written of a first addition that does not count."""

    def fail() -> None:
        with open_for_appending(tmp_path / "map", metadata("files")) as target:
            target._segments.store.add(0, rows(0, 2), {"names": names(0, 2)})
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert os.listdir(tmp_path) == []


def test_a_map_without_images_is_made_anew_as_another(tmp_path):
    with open_for_appending(tmp_path / "map", metadata("files")):
        pass
    with pytest.raises(InputError, match="map: found no map, expected a folder that"):
        Map.open(tmp_path / "map")
    other = dataclasses.replace(metadata("files"), dtype="float16", model="1" * 64)
    with open_for_appending(tmp_path / "map", other) as target:
        target.append(names(0, 1), [7], rows(0, 1), root="/images")
    assert read_metadata(tmp_path / "map") == other


def test_a_map_in_milvus_that_was_killed_before_it_had_images_goes_on(tmp_path):
    """The file is not there yet; or the collection is, but without its index."""
    for number in range(2):
        made = metadata("milvus:rows.db")
        folder = tmp_path / str(number)
        folder.mkdir()
        write_json(folder / "map.json", dataclasses.asdict(made))
        if number:
            client = pymilvus.MilvusClient(str(folder / "rows.db"))
            schema = client.create_schema(auto_id=False)
            schema.add_field("id", pymilvus.DataType.INT64, is_primary=True)
            schema.add_field("descriptor", pymilvus.DataType.FLOAT_VECTOR, dim=LENGTH)
            client.create_collection(made.collection, schema=schema)
            client.close()
        append_until(folder, 4, made.store)
        assert killed_appends.check(folder) == 4
