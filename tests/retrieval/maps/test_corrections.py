"""Corrected maps: against brute force over the images that are left, and a model of a list."""

import dataclasses
import json
import os
import pathlib
import random
import shutil
import time

import cv2
import jax
import numpy as np
import pyproj
import pytest

from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import Positions
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps import appending
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.corrections import (
    MapChange,
    merge_maps,
    move_images,
    remove_images,
    replace_images,
)
from crisalad_jax.retrieval.maps.images import NewImages
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.removed import Removed
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import MODEL, describe_single, read_options, write_picture
from tests.killed_appends import append_until, metadata, names, rows
from tests.retrieval.maps.milvus_server import ADDRESS
from tests.retrieval.maps.test_map import files_in, reseal
from tests.retrieval.maps.test_stores import ROUNDING, brute_force
from tests.utils.test_checksums import flips

QUERIES = rows(1000, 5)


@pytest.fixture
def folder(tmp_path) -> pathlib.Path:
    """Of seven images, in segments of one, two and four."""
    append_until(tmp_path / "map", 7)
    return tmp_path / "map"


def names_in(folder: pathlib.Path) -> list[str]:
    with Map.open(folder) as places:
        return [image.name for image in places.images]


def made(folder: pathlib.Path, images: dict[str, int], root="/others", **more) -> pathlib.Path:
    """A map of the descriptors with these numbers, by name."""
    with open_for_appending(folder, metadata("files")) as target:
        found = np.concatenate([rows(number, 1) for number in images.values()])
        target.append(list(images), [7] * len(images), found, root=root, **more)
    return folder


# Rows and numbers


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.95])
def test_rows_that_are_left_are_numbered_in_order(share):
    """By listing them."""
    generator = np.random.default_rng(0)
    gone = np.flatnonzero(generator.random(200) < share)
    left = np.setdiff1d(np.arange(200), gone)
    removed = Removed(gone)
    np.testing.assert_array_equal(removed.rows_of(np.arange(len(left))), left)
    np.testing.assert_array_equal(removed.numbers_of(left), np.arange(len(left)))
    for first, count in ((0, 200), (13, 50), (199, 1)):
        places = removed.left(first, count)
        expected = left[(left >= first) & (left < first + count)] - first
        np.testing.assert_array_equal(np.arange(count) if places is None else places, expected)


# Any sequence of changes, against a list


class Expected:
    """What a map should hold: a list of (name, number of the descriptor, position)."""

    def __init__(self) -> None:
        self.images: list[tuple[str, int, tuple[float, float] | None]] = []

    def check(self, places: Map) -> None:
        assert [image.name for image in places.images] == [name for name, _, _ in self.images]
        assert [image.position for image in places.images] == [at for _, _, at in self.images]
        assert len(places) == len(self.images)
        assert sum(each.images for each in places.additions) == len(places)
        mine = np.concatenate([rows(number, 1) for _, number, _ in self.images])
        if places.metadata.is_bits:
            mine = np.where(mine >= 0, 1, -1) / np.sqrt(np.float32(mine.shape[1]))
        mine = mine.astype(np.float32)
        np.testing.assert_array_equal(np.concatenate(list(places.descriptors)), mine)
        queries = np.sign(QUERIES) / np.sqrt(48) if places.metadata.is_bits else QUERIES
        products = queries.astype(np.float64) @ mine.T.astype(np.float64)
        for k in (1, 3, 2 * len(mine)):
            # Bits have equal similarities, which brute force rounds: their order is by number.
            right = np.argsort(-np.round(products, 6), axis=1, kind="stable")[:, :k]
            found = places.search(QUERIES, k)
            np.testing.assert_array_equal(found.indices, right)
            sorted_ = np.take_along_axis(products, right, axis=1)
            np.testing.assert_allclose(found.similarities, sorted_, atol=ROUNDING)
        np.testing.assert_allclose(places.similarities(QUERIES), products, atol=ROUNDING)


def change_at_random(folder: pathlib.Path, expected: Expected, draw: random.Random, free) -> str:
    """Make one change, to the map and to what is expected of it."""
    images = expected.images
    verb = draw.choice(["append", "remove", "replace", "move", "merge"])
    some = draw.sample(range(len(images)), draw.randint(1, max(1, len(images) // 2)))
    if verb == "remove":
        remove_images(folder, [images[number][0] for number in some])
        expected.images = [image for number, image in enumerate(images) if number not in some]
    elif verb == "move":
        of = {images[number][0]: (draw.uniform(-9, 9), draw.uniform(-9, 9)) for number in some}
        move_images(folder, Positions(("x", "y"), of))
        expected.images = [(name, number, of.get(name, at)) for name, number, at in images]
    elif verb == "replace":
        with Map.open(folder) as places:
            known = places.metadata
        new = [(images[i][0], next(free), images[i][2]) for i in some]
        parts = [
            NewImages(
                [name],
                [9],
                rows(number, 1),
                "/new",
                None if at is None else Positions(("x", "y"), {name: at}),
            )
            for name, number, at in new
        ]
        with open_for_appending(folder, known) as target:
            target.change("replace", added=parts)
        gone = {images[i][0] for i in some}
        expected.images = [image for image in images if image[0] not in gone] + new
    else:
        count = draw.randint(1, 4)
        numbers = [next(free) for _ in range(count)]
        named = {f"{number}.png": number for number in numbers}
        at = {name: (float(number), 0.5) for name, number in named.items() if number % 2}
        where = Positions(("x", "y"), at)
        if verb == "append":
            with Map.open(folder) as places:
                known = places.metadata
            with open_for_appending(folder, known) as target:
                all_rows = np.concatenate([rows(number, 1) for number in numbers])
                target.append(list(named), [7] * count, all_rows, root="/more", positions=where)
        else:
            other = folder.with_name(f"other{numbers[0]}")
            with Map.open(folder) as places:
                known = dataclasses.replace(places.metadata, store="files")
            with open_for_appending(other, known) as target:
                for name, number in named.items():
                    target.append([name], [7], rows(number, 1), root="/b", positions=where)
            merge_maps(folder, other)
        expected.images = images + [(name, n, at.get(name)) for name, n in named.items()]
    return verb


@pytest.mark.parametrize(
    ("store", "dtype", "seeds"),
    [
        ("files", "float32", range(4)),
        ("files", "bits", range(4, 6)),
        ("milvus:rows.db", "float32", [6]),
        pytest.param(f"milvus:{ADDRESS}", "float32", [7, 8], marks=pytest.mark.slow),
    ],
)
def test_a_map_after_any_changes_is_that_of_the_images_that_are_left(
    tmp_path, store, dtype, seeds, request
):
    if ADDRESS in store:
        request.getfixturevalue("milvus_server")
    seen = set()
    for seed in seeds:
        draw, free = random.Random(seed), iter(range(100, 10_000))
        folder, expected = tmp_path / str(seed) / "map", Expected()
        known = dataclasses.replace(metadata(store), dtype=dtype)
        with open_for_appending(folder, known) as target:
            target.append(names(0, 9), [7] * 9, rows(0, 9), root="/images")
        expected.images = [(name, number, None) for number, name in enumerate(names(0, 9))]
        before = None
        for _ in range(12):
            seen.add(change_at_random(folder, expected, draw, free))
            with Map.open(folder) as places:
                expected.check(places)
                places.verify()
            if before is not None:  # milvus-lite lets one at a time open its file
                before[1].check(before[0])
                before[0].close()
                before = None
            elif store == "files":
                before = Map.open(folder), Expected()
                before[1].images = expected.images
    assert seen >= {"append", "remove", "replace", "merge"}


# Removing


def test_images_are_removed_by_name_pattern_day_and_addition(tmp_path, monkeypatch):
    days = iter(["2026-05-01", "2026-05-02", "2026-05-02"])
    monkeypatch.setattr(appending, "_now", lambda: f"{next(days)}T10:00:00+00:00")
    folder = tmp_path / "map"
    with open_for_appending(folder, metadata("files")) as target:
        for first, root in ((0, "/a"), (3, "/a"), (6, "/b")):
            named = [f"{root[1:]}/{number}[x].png" for number in range(first, first + 3)]
            target.append(named, [7] * 3, rows(first, 3), root=root)
    monkeypatch.undo()
    for given, options, right in (
        (["a/0[x].png"], {}, ["a/0[x].png"]),  # the name, not the pattern that it is too
        (["a/?[[]x].png"], {"day": "2026-05-02"}, [f"a/{n}[x].png" for n in (3, 4, 5)]),
        (["a/1*"], {"addition": 1}, ["a/1[x].png"]),
        ([], {"addition": 3}, [f"b/{n}[x].png" for n in (6, 7, 8)]),
    ):
        assert remove_images(folder, given, **options).names == right
        again = remove_images(folder, given, **options)
        assert again.names == []
        assert again.there >= (len(right) if given else 0)
    assert names_in(folder) == ["a/2[x].png"]
    with Map.open(folder) as places:
        assert [each.images for each in places.additions] == [1, 0, 0]
        assert places.summary()["removed"] == 8


@pytest.mark.parametrize(
    ("given", "options", "words"),
    [
        (["33.jpg"], {}, "map: found no image '33.jpg'; did you mean 3.jpg or"),
        (["monday/*"], {}, "map: found no image 'monday/*'; see `crisalad map list`"),
        (["*"], {}, "map: found all its 7 images to be removed, expected at least one to stay"),
        ([], {}, "names: found none, expected names or patterns, an addition or a day"),
        ([], {"addition": 2}, "addition: found 2, expected 1 to 1"),
        ([], {"day": "2020-01-01"}, "day: found 2020-01-01, expected one of 20"),
    ],
)
def test_what_cannot_be_removed_changes_nothing(folder, given, options, words):
    before = files_in(folder)
    with pytest.raises(InputError) as error:
        remove_images(folder, given, **options)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert files_in(folder) == before


@pytest.mark.parametrize("change", [remove_images, move_images])
def test_what_is_no_map_is_not_changed(tmp_path, change):
    with pytest.raises(InputError, match=r"^.*nothing: found no map, expected a folder that"):
        change(tmp_path / "nothing", {"remove_images": ["a"]}.get(change.__name__, "t.csv"))
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_was_removed_may_come_back(folder):
    remove_images(folder, ["2.jpg"])
    with open_for_appending(folder, metadata("files")) as target:
        assert target.was_removed("2.jpg")
        assert target.was_removed("2.jpg", 7)
        assert not target.was_removed("2.jpg", 8)
        target.append(["2.jpg"], [7], rows(2, 1), root="/images")
        assert not target.was_removed("2.jpg")
    assert names_in(folder) == [f"{n}.jpg" for n in (0, 1, 3, 4, 5, 6, 2)]


@pytest.mark.parametrize("share", [0.01, 0.5, 0.9])
def test_an_approximate_search_finds_what_is_left(tmp_path, share):
    """Of 600 descriptors; a graph that is told what is left misses none here."""
    folder = tmp_path / "map"
    with open_for_appending(folder, metadata("files")) as target:
        target.append(names(0, 600), [7] * 600, rows(0, 600), root="/images")
        target.build_search("hnsw")
    gone = np.random.default_rng(0).choice(600, int(600 * share), replace=False)
    change = remove_images(folder, [f"{number}.jpg" for number in gone])
    assert change.stale_search is None
    left = np.setdiff1d(np.arange(600), gone)
    with Map.open(folder) as places:
        assert places.search_kind == "hnsw"
        for k in (1, 5, 60):
            found, exact = places.search(QUERIES, k), places.search(QUERIES, k, exact=True)
            if k < 60:  # beyond, some similarities are equal as float32
                right = brute_force(rows(0, 600)[left], QUERIES, k)
                np.testing.assert_array_equal(exact.indices, right)
            np.testing.assert_array_equal(found.indices, exact.indices)
            np.testing.assert_array_equal(found.similarities, exact.similarities)


def test_a_calibration_of_other_images_is_noted(folder):
    from tests.retrieval.maps.test_calibration import remembered

    remembered(folder, created="2020-01-01T00:00:00+00:00")
    move_images(folder, Positions(("x", "y"), {"1.jpg": (1.0, 2.0)}))
    Map.open(folder).close()  # without a note: warnings are errors
    remove_images(folder, ["2.jpg"])
    with pytest.warns(Note, match="changed .* since its minimum similarity was measured .2020-01"):
        Map.open(folder).close()
    Map.open(folder, calibrated=False).close()


# Moving


def table(path: pathlib.Path, text: str) -> pathlib.Path:
    path.write_text(text)
    return path


def test_images_move_to_a_table(tmp_path, folder):
    poses = table(tmp_path / "poses.csv", "name,x,y\n1.jpg,1,2\n3.jpg,-4.5,0\nother.jpg,1,1\n")
    assert move_images(folder, poses) == MapChange(["1.jpg", "3.jpg"], 0, 7, ["other.jpg"])
    before = files_in(folder)
    assert move_images(folder, poses) == MapChange([], 2, 7, ["other.jpg"])
    assert files_in(folder) == before
    with Map.open(folder) as places:
        assert places.axes == ("x", "y")
        known = [(image.name, image.position) for image in places.images if image.position]
    assert known == [("1.jpg", (1.0, 2.0)), ("3.jpg", (-4.5, 0.0))]


def test_all_positions_may_get_other_axes_and_some_may_not(tmp_path, folder):
    move_images(folder, Positions(("x", "y"), {"1.jpg": (1.0, 2.0), "2.jpg": (1.0, 3.0)}))
    before = files_in(folder)
    with pytest.raises(InputError, match="map: found positions in lat, lon, expected x, y as in"):
        move_images(folder, Positions(("lat", "lon"), {"1.jpg": (48.0, 2.0)}))
    assert files_in(folder) == before
    move_images(folder, Positions(("lat", "lon"), {"1.jpg": (48.0, 2.0), "2.jpg": (48.0, 2.1)}))
    with Map.open(folder) as places:
        assert places.axes == ("lat", "lon")
        assert places.images[1].position == (48.0, 2.0)
    with open_for_appending(folder, metadata("files")) as target:  # additions have the new axes
        where = Positions(("lat", "lon"), {"7.jpg": (48.5, 2.0)})
        target.append(["7.jpg"], [7], rows(7, 1), root="/images", positions=where)
    assert Map.open(folder).images[7].position == (48.5, 2.0)


def test_positions_of_another_zone_get_the_metres_of_the_map(folder):
    """Against pyproj; zones meet at 6 degrees east."""
    names_ = ["0.jpg", "1.jpg"]
    zone31 = Positions(("east", "north"), dict.fromkeys(names_, (4e5, 5.4e6)), Zone(31, False))
    move_images(folder, zone31)
    of = {"1.jpg": (2.8e5, 5.32e6)}
    move_images(folder, Positions(("east", "north"), of, Zone(32, False)))
    with Map.open(folder) as places:
        assert places.zone == Zone(31, False)
        found = places.images[1].position
    transform = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:32631", always_xy=True)
    # `fitted` rounds to a tenth of a millimetre; its series is right to far less.
    assert found == pytest.approx(transform.transform(*of["1.jpg"]), abs=2e-4)
    with pytest.raises(InputError, match="degrees of longitude from the middle of zone 31 north"):
        move_images(folder, Positions(("east", "north"), of, Zone(40, False)))


def test_poses_of_no_image_are_refused(tmp_path, folder):
    poses = table(tmp_path / "poses.csv", "name,x,y\na.jpg,1,2\n")
    with pytest.raises(InputError, match=r"poses.csv: found none of the 7 images of .*'0\.jpg'"):
        move_images(folder, poses)


# Merging


def test_maps_are_merged_by_one_change(tmp_path, folder):
    first = made(tmp_path / "a", {"a.jpg": 20, "3.jpg": 3})
    second = made(tmp_path / "b", {"b.jpg": 21, "a.jpg": 20}, root="/b")
    remove_images(folder, ["5.jpg"])
    third = made(tmp_path / "c", {"5.jpg": 5, "c.jpg": 22})
    change = merge_maps(folder, first, second, third)
    assert change == MapChange(["a.jpg", "b.jpg", "c.jpg"], 2, 9, (), (), 1)
    before = files_in(folder)
    assert merge_maps(folder, first, second, third) == MapChange([], 5, 9, (), (), 1)
    assert files_in(folder) == before
    with Map.open(folder) as places:
        roots = {image.name: image.root for image in places.images}
        assert (roots["0.jpg"], roots["a.jpg"], roots["b.jpg"]) == ("/images", "/others", "/b")
        found = places.search(rows(20, 2), 1)
        assert [places.images[i].name for i in found.indices[:, 0]] == ["a.jpg", "b.jpg"]


def test_a_new_map_of_others_has_what_is_left_alone(tmp_path, folder):
    """That is how the room of what was removed is got back."""
    remove_images(folder, [f"{number}.jpg" for number in range(3, 7)])
    other = made(tmp_path / "a", {"a.jpg": 20})
    new = tmp_path / "new"
    merge_maps(new, folder, other)
    assert names_in(new) == ["0.jpg", "1.jpg", "2.jpg", "a.jpg"]
    with Map.open(new) as places, Map.open(folder) as old:
        assert places.summary()["removed"] == 0
        np.testing.assert_array_equal(places.descriptors_of(["0.jpg", "2.jpg"]), rows(0, 3)[::2])
        assert places.additions[0].day == old.additions[0].day
    sizes = [sum(p.stat().st_size for p in each.rglob("*.npy")) for each in (new, folder)]
    assert sizes[0] < sizes[1]
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_new_map_of_nothing_good_is_not_made(tmp_path, folder):
    clash = made(tmp_path / "clash", {"3.jpg": 4})
    for others in ([folder, clash], [folder, tmp_path / "nothing"]):
        with pytest.raises(InputError):
            merge_maps(tmp_path / "new", *others)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clash", "map"]


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_maps_in_files_are_imported_into_milvus(tmp_path, dtype):
    others = [tmp_path / "map0", tmp_path / "map1"]
    for number, each in enumerate(others):
        known = dataclasses.replace(metadata("files"), dtype=dtype)
        with open_for_appending(each, known) as target:
            new = [f"{number}/{name}" for name in names(0, 40)]
            target.append(new, [7] * 40, rows(40 * number, 40), root="/images")
    remove_images(others[0], ["0/3.jpg"])
    store = f"milvus:{tmp_path / 'both' / 'rows.db'}"
    assert merge_maps(tmp_path / "both", *others, store=store).images == 79
    with Map.open(tmp_path / "both") as places:
        assert (places.metadata.store, places.metadata.dtype) == ("milvus:rows.db", "float32")
        found = places.search(rows(0, 80), 1)
        named = [places.images[i].name for i in found.indices[:, 0]]
    expected = [f"{number}/{name}" for number in range(2) for name in names(0, 40)]
    assert (named[:3], named[4:]) == (expected[:3], expected[4:])
    with pytest.raises(InputError, match=r"both: found store files, expected milvus:rows\.db$"):
        merge_maps(tmp_path / "both", others[0], store="files")


def in_x(names_: list[str]) -> Positions:
    return Positions(("x", "y"), dict.fromkeys(names_, (1.0, 2.0)))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda m: reseal(m / "map.json", model="1" * 64),
            "of model 1111.*, expected 0000",
        ),
        (lambda m: reseal(m / "map.json", pca="1" * 64), "components"),
        (lambda m: reseal(m / "map.json", dtype="float16"), "found bytes other than float16"),
        (
            lambda m: made(m, {"3.jpg": 4}),
            r"other: found '3\.jpg', which is another image in .*map, expected other names",
        ),
        (
            lambda m: made(m, {"p.jpg": 9}, positions=in_x(["p.jpg"])),
            "/other: found positions in x, y, expected lat, lon as in the map",
        ),
    ],
)
def test_maps_that_do_not_fit_are_not_merged(tmp_path, folder, spoil, words):
    move_images(folder, Positions(("lat", "lon"), {"1.jpg": (48.0, 2.0)}))
    other = made(tmp_path / "other", {"a.jpg": 20})
    spoil(other)
    before = files_in(folder)
    with pytest.raises(InputError, match=words):
        merge_maps(folder, other)
    assert files_in(folder) == before


def test_a_map_is_not_merged_with_itself(folder):
    with pytest.raises(InputError, match="map: found the map itself, expected others"):
        merge_maps(folder, folder / ".." / "map")
    with pytest.raises(InputError, match="others: found none"):
        merge_maps(folder)


# Replacing, and what `index` then does


@pytest.fixture
def pictures(tmp_path) -> pathlib.Path:
    """Five of them, which are an hour old."""
    for number in range(5):
        path = tmp_path / "pictures" / f"{number}.png"
        write_picture(path, number)
        os.utime(path, (time.time() - 3600,) * 2)
    return tmp_path / "pictures"


def index_pictures(params, shared, pictures, folder, **options):
    weights = shared / "weights.safetensors"
    return index(Model(params, MODEL), pictures, folder, weights=weights, **read_options(options))


def replace(params, shared, pictures, folder, **options) -> MapChange:
    model, weights = Model(params, MODEL), shared / "weights.safetensors"
    return replace_images(model, pictures, folder, weights=weights, **read_options(options))


def test_pictures_that_changed_are_described_again(params, shared, pictures, tmp_path):
    folder, where = tmp_path / "map", Positions(("x", "y"), {"1.png": (1.0, 2.0)})
    index_pictures(params, shared, pictures, folder, positions=where)
    write_picture(pictures / "1.png", 31)
    os.utime(pictures / "1.png", (time.time() - 3600,) * 2)  # its size says it
    same_size = cv2.imread(str(pictures / "3.png"))
    write_picture(pictures / "new.png", 9)
    os.utime(pictures / "3.png", (time.time() + 60,) * 2)  # its time says it
    assert same_size is not None
    assert (pictures / "1.png").stat().st_size != 0
    change = replace(params, shared, pictures, folder)
    assert change.names == ["1.png", "3.png"]
    assert (change.there, change.images, change.unmatched) == (3, 5, ["new.png"])
    with Map.open(folder) as places:
        assert [image.name for image in places.images] == [f"{n}.png" for n in (0, 2, 4, 1, 3)]
        assert places.images[3].position == (1.0, 2.0)
        assert places.images[3].bytes == (pictures / "1.png").stat().st_size
        order = [pictures / image.name for image in places.images]
        mine = describe_single(Model(params, MODEL), order)
        # Batches of other images: rounding of float32 sums.
        np.testing.assert_allclose(np.concatenate(list(places.descriptors)), mine, atol=ROUNDING)
    os.utime(pictures / "3.png", (time.time() - 3600,) * 2)
    before = files_in(folder)
    assert replace(params, shared, pictures, folder).names == []
    assert files_in(folder) == before


def test_what_cannot_be_read_is_not_replaced(params, shared, pictures, tmp_path):
    folder = tmp_path / "map"
    index_pictures(params, shared, pictures, folder)
    before = files_in(folder)
    (pictures / "2.png").write_text("no picture")
    for how, words in (("stop", "2.png: "), ("skip", "pictures: found 1 images, none of them")):
        with pytest.raises(InputError, match=words):
            replace(params, shared, pictures, folder, on_bad_image=how)
        assert files_in(folder) == before
    write_picture(pictures / "1.png", 31)
    os.utime(pictures / "1.png", (time.time() + 60,) * 2)
    change = replace(params, shared, pictures, folder, on_bad_image="skip")
    assert (change.names, change.unreadable) == (["1.png"], ["2.png"])
    assert sorted(names_in(folder)) == [f"{n}.png" for n in range(5)]
    shutil.move(pictures / "3.png", pictures / "other.png")
    with pytest.raises(
        InputError, match=r"found none of the 5 images of .*map, expected names such"
    ):
        replace(params, shared, pictures / "other.png", folder)
    with pytest.raises(InputError, match="found a map made by model"):
        replace(jax.tree.map(lambda leaf: leaf + 1e-3, params), shared, pictures, folder)


def test_index_does_not_bring_back_what_was_removed(params, shared, pictures, tmp_path):
    folder = tmp_path / "map"
    index_pictures(params, shared, pictures, folder)
    remove_images(folder, ["1.png", "2.png", "3.png"])
    result = index_pictures(params, shared, pictures, folder)
    assert (result.added, result.there, result.removed, result.images) == (0, 2, 3, 2)
    (pictures / "2.png").write_bytes((pictures / "2.png").read_bytes() + b"more")
    result = index_pictures(params, shared, pictures, folder)  # it is another picture now
    assert (result.added, result.removed, result.images) == (1, 2, 3)
    result = index_pictures(params, shared, pictures, folder, again=True)
    assert (result.added, result.removed, result.images) == (2, 0, 5)
    assert names_in(folder) == [f"{n}.png" for n in (0, 4, 2, 1, 3)]


# Seen by those who have the map open


def test_a_map_is_as_it_was_opened_until_it_is_refreshed(folder):
    with Map.open(folder) as places:
        assert places.refreshed() is places
        remove_images(folder, ["2.jpg"])
        merged = made(folder.with_name("other"), {"a.jpg": 20})
        assert places.search(rows(2, 1), 1).indices.tolist() == [[2]]
        now = places.refreshed()
        assert now is not places
        assert (len(now), now.image("2.jpg")) == (6, None)
        merge_maps(folder, merged)
        assert len(now) == 6
        assert len(now.refreshed()) == 7
        folder.rename(folder.with_name("elsewhere"))
        assert now.refreshed() is now


# Damage


CHANGE = "segments/change-0000000001.json"


@pytest.fixture
def changed(tmp_path, folder) -> pathlib.Path:
    """A map of three changes, the last of which has two segments."""
    remove_images(folder, ["2.jpg"])
    move_images(folder, Positions(("x", "y"), {"1.jpg": (1.0, 2.0)}))
    other = made(tmp_path / "other", {"a.jpg": 20})
    with open_for_appending(other, metadata("files")) as target:
        target.append(["b.jpg"], [7], rows(21, 1), root="/b")
    merge_maps(folder, other)
    return folder


@pytest.mark.parametrize("name", [CHANGE, "segments/0000000007.0000000002.json"])
def test_one_other_byte_in_a_record_of_a_change_is_refused(changed, name):
    whole = (changed / name).read_bytes()
    for place, data in flips(whole, 40):
        (changed / name).write_bytes(data)
        with pytest.raises(InputError) as error, Map.open(changed):
            pass
        assert name in str(error.value), place
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("write", [False, True])
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: (m / CHANGE).unlink(), "change-0000000002.json: expected change-0000000001.jso"),
        (
            lambda m: (m / "segments/0000000008.0000000002.json").unlink(),
            "change-0000000002.json: found a change of 9 rows, expected at most 8",
        ),
        (lambda m: reseal(m / CHANGE, moved=[9]), f"{CHANGE}: not a whole record of a change: Val"),
        (lambda m: reseal(m / CHANGE, moved=["1"]), f"{CHANGE}: not a whole record of a change: V"),
        (lambda m: reseal(m / CHANGE, positions=[]), f"{CHANGE}: not a whole record of a change: "),
        (lambda m: reseal(m / CHANGE, axes=["x"]), f"{CHANGE}: not a whole record of a change: "),
        (lambda m: reseal(m / CHANGE, positions=[[1e99, 0]]), f"{CHANGE}: not a whole record of a"),
        (lambda m: reseal(m / CHANGE, rows="x"), f"{CHANGE}: found a change of x rows"),
        (lambda m: reseal(m / CHANGE, changed=1), f"{CHANGE}: not a whole record of a change: Typ"),
        (
            lambda m: reseal(m / "segments/0000000008.0000000002.json", names=["0.jpg"]),
            "0000000008.0000000002.json: not a whole record of images: a name occurs twice",
        ),
    ],
)
def test_a_damaged_change_is_one_line(changed, spoil, words, write):
    spoil(changed)
    with (
        pytest.raises(InputError) as error,
        open_for_appending(changed, metadata("files")) if write else Map.open(changed),
    ):
        pass
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_change_without_its_record_is_removed_with_a_note(changed):
    """That is what a kill before the last rename leaves."""
    (changed / "segments/change-0000000002.json").unlink()
    left = [f"{n}.jpg" for n in (0, 1, 3, 4, 5, 6)]
    assert names_in(changed) == left
    with (
        pytest.warns(Note, match="map: 2 additions of an unfinished change removed"),
        open_for_appending(changed, metadata("files")) as target,
    ):
        assert [image.name for image in target.images] == left
    assert not list((changed / "segments").glob("000000000[78]*"))
    with open_for_appending(changed, metadata("files")) as target:
        target.append(["c.jpg"], [7], rows(9, 1), root="/c")
    assert names_in(changed) == [*left, "c.jpg"]


def test_a_change_that_fails_leaves_the_map_as_it_was(folder):
    def parts():
        yield NewImages(["a.jpg"], [7], rows(8, 1), "/a")
        yield NewImages(["b.jpg"], [7], rows(9, 1), "/a")
        raise KeyboardInterrupt

    before = files_in(folder)
    with open_for_appending(folder, metadata("files")) as target:
        with pytest.raises(KeyboardInterrupt):
            target.change("merge", added=parts())
        assert files_in(folder) == before
        target.append(["c.jpg"], [7], rows(10, 1), root="/c")
        assert target.search(rows(10, 1), 1).indices.tolist() == [[7]]
    assert names_in(folder) == [*names(0, 7), "c.jpg"]


def test_a_change_of_too_many_images_is_refused(folder, monkeypatch):
    monkeypatch.setattr(appending, "MOST_CHANGED", 2)
    before = files_in(folder)
    with pytest.raises(
        InputError, match="found a change of 3 images, expected at most 2 at a time"
    ):
        remove_images(folder, ["[123].jpg"])
    assert files_in(folder) == before


# The command line


def test_the_command_line_corrects_a_map(params, shared, pictures, tmp_path, capfd):
    from tests.cli.test_cli import fails, runs, succeeds

    folder = tmp_path / "map"
    index_pictures(params, shared, pictures, folder)
    assert "3 images removed; 2 images now" in succeeds(
        capfd, "map", "remove", folder, "[12].png", "3.png"
    )
    assert "nothing to do; 3 were removed before; 2 images now" in succeeds(
        capfd, "map", "remove", folder, "[12].png", "3.png"
    )
    said = succeeds(capfd, "index", "--images", pictures, "--out", folder, "--quiet")
    assert "3 were removed from the map and stay out (--again adds them)" in said
    out, _ = runs(capfd, "map", "list", folder, "4*", "--names", "--json", "-")
    found = json.loads(out)
    assert (found["images"], found["removed"], found["names"]) == (1, 3, ["4.png"])
    assert [(each["folder"], each["images"]) for each in found["folders"]] == [(".", 1)]
    assert [(each["addition"], each["images"]) for each in found["additions"]] == [(1, 1)]
    poses = table(tmp_path / "poses.csv", "name,x,y\n4.png,1,2\n9.png,0,0\n")
    said = succeeds(capfd, "map", "move", folder, "--positions", poses)
    assert "1 image moved; 1 are not in the map, '9.png' the first; 2 images now" in said
    write_picture(pictures / "0.png", 77)
    os.utime(pictures / "0.png", (time.time() + 60,) * 2)
    said = succeeds(capfd, "map", "replace", folder, "--images", pictures, "--quiet")
    assert "1 image replaced; 1 have not changed; 3 are not in the map" in said
    new = tmp_path / "new"
    assert "2 images added" in succeeds(capfd, "map", "merge", new, folder, "--quiet")
    fails(capfd, "map", "remove", folder, "--images", "x", words=("--images: found with map remo",))
    fails(capfd, "map", "replace", folder, words=("--images: found none, expected",))
    fails(capfd, "map", "move", folder, words=("--positions: found none, expected",))
    fails(capfd, "map", "move", folder, "x", words=("map move: found",))
