"""Pairs to match: against brute force, pycolmap's reader, and a reconstruction of a street."""

import contextlib
import itertools
import pathlib

import cv2
import numpy as np
import pyproj
import pytest

from crisalad_jax.cli import main
from crisalad_jax.data.images import list_images
from crisalad_jax.data.positions import Positions
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps import pairs as module
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.pairs import ImagePairs, image_pairs
from crisalad_jax.synthetic import View, render
from crisalad_jax.utils.errors import InputError
from tests.conftest import describe_single, read_options
from tests.retrieval.maps.test_stores import unit_rows
from tests.retrieval.maps.test_tracking import in_video, made, numbered, since_1970


def brute_force(queries: dict, database: dict, k: int, allowed=lambda query, name: True) -> list:
    """In float64, a Python loop for each pair; names to vectors; of equals the earlier first."""
    found = []
    for query, vector in queries.items():
        others = [name for name in database if name != query and allowed(query, name)]
        closeness = [float(np.dot(np.float64(vector), np.float64(database[n]))) for n in others]
        order = np.argsort(-np.array(closeness), kind="stable")
        found += [(query, others[i]) for i in order[:k]]
    return found


def unordered(pairs) -> set[frozenset]:
    return {frozenset(pair) for pair in pairs}


def by_name(names, rows) -> dict:
    return dict(zip(names, rows, strict=True))


@pytest.mark.parametrize("at_once", [1, 4, 1024])
@pytest.mark.parametrize("k", [1, 3, 50])
def test_the_most_similar_each_pair_once_and_none_with_itself(tmp_path, monkeypatch, k, at_once):
    monkeypatch.setattr(module, "AT_ONCE", at_once)
    names, rows = numbered(range(9)), unit_rows(9)
    found = image_pairs(made(tmp_path, names, rows), k=k)
    named = by_name(names, rows)
    assert unordered(found.pairs) == unordered(brute_force(named, named, k))
    assert len(found.pairs) == len(unordered(found.pairs))
    assert all(first != second for first, second in found.pairs)
    assert str(found.root) == "/images"


def test_min_similarity(tmp_path):
    names, rows = numbered(range(9)), unit_rows(9)
    similarities = rows.astype(np.float64) @ rows.T.astype(np.float64)
    # A similarity that an image has: equal ones count.
    least = float(np.float32(np.sort(similarities[np.triu_indices(9, 1)])[-5]))
    found = image_pairs(made(tmp_path, names, rows), min_similarity=least - 1e-6)
    assert len(found.pairs) == 5
    for first, second in found.pairs:
        assert similarities[names.index(first), names.index(second)] >= least - 1e-6


@pytest.mark.parametrize("name", [in_video, since_1970])
def test_loops_are_apart_in_time(tmp_path, name):
    """Descriptors change slowly, so that the most similar images are all too near."""
    times = np.arange(0, 60, 0.5)
    turn = 2 * np.pi * times / 41.3  # once around in 41.3 seconds: no two are equally similar
    rows = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    names = name(times)
    places = made(tmp_path, names, rows)
    found = image_pairs(places, k=2, min_gap=10).pairs
    when = by_name(names, times)
    named = by_name(names, places_rows(places))

    def apart(query, other):
        return abs(when[query] - when[other]) >= 10

    assert unordered(found) == unordered(brute_force(named, named, 2, apart))
    assert min(abs(when[first] - when[second]) for first, second in found) >= 10


def places_rows(places: Map) -> np.ndarray:
    return np.concatenate(list(places.descriptors))


def test_two_videos_are_apart_in_time(tmp_path):
    names = ["a.mp4#t=1.000", "a.mp4#t=2.000", "b.mp4#t=1.000"]
    found = image_pairs(made(tmp_path, names, unit_rows(3)), k=9, min_gap=30)
    assert unordered(found.pairs) == unordered([(names[0], names[2]), (names[1], names[2])])


def test_the_next_ones_of_a_folder_or_a_video(tmp_path):
    names = ["l/1.jpg", "r/1.jpg", "l/2.jpg", "r/2.jpg", "l/3.jpg", "v.mp4#t=1.000"]
    names += ["w.mp4#t=1.000", "v.mp4#t=2.000"]
    places = made(tmp_path, names, unit_rows(len(names)))
    one = [("l/1.jpg", "l/2.jpg"), ("l/2.jpg", "l/3.jpg"), ("r/1.jpg", "r/2.jpg")]
    one += [("v.mp4#t=1.000", "v.mp4#t=2.000")]
    assert sorted(image_pairs(places, k=0, overlap=1).pairs) == one
    two = image_pairs(places, k=0, overlap=2).pairs
    assert sorted(two) == sorted([*one, ("l/1.jpg", "l/3.jpg")])
    # A pair that two rules give is there once.
    both = image_pairs(places, k=50, overlap=2).pairs
    assert len(both) == len(unordered(both)) == 8 * 7 // 2


@pytest.mark.parametrize("axes", [("east", "north"), ("lat", "lon")])
def test_images_that_were_taken_near_each_other(tmp_path, axes):
    """Against pyproj's distances on the ellipsoid; one image has no position."""
    generator = np.random.default_rng(4)
    metres = 500_000 + generator.uniform(0, 60, 12), 5_400_000 + generator.uniform(0, 60, 12)
    points = np.stack(metres, axis=1)
    lon, lat = pyproj.Transformer.from_crs(32631, 4326, always_xy=True).transform(*points.T)
    given = points if axes[0] == "east" else np.stack([lat, lon], axis=1)
    names = numbered(range(13))
    positions = Positions(axes, {names[i]: tuple(given[i].tolist()) for i in range(12)})
    places = made(tmp_path, names, unit_rows(13), positions)
    geod = pyproj.Geod(ellps="WGS84")
    expected = set()
    for i, j in itertools.combinations(range(12), 2):
        _, _, distance = geod.inv(lon[i], lat[i], lon[j], lat[j])
        # UTM's plane is 0.4 per mille small in the middle of a zone: 8 mm of 20 m.
        assert abs(distance - 20) > 0.01
        if distance < 20:
            expected.add(frozenset((names[i], names[j])))
    assert expected
    assert unordered(image_pairs(places, k=0, within=20).pairs) == expected


def test_other_images_with_those_of_a_map(town_map, params, sides):
    """Names are relative to the folder that holds both; against brute force."""
    with Map.open(town_map) as places:
        model = Model(params, places.config)
        options = read_options({"model": model, "k": 3})
        found = image_pairs(places, sides[1], **options)
        again = image_pairs(places, sides[1], root=sides[0].parents[1], **options)
        rows = describe_single(model, list_images(sides[1]))
        queries = by_name([f"queries/{path.name}" for path in list_images(sides[1])], rows)
        names = [f"database/{image.name}" for image in places.images]
        database = by_name(names, places_rows(places))
    assert found.root == sides[0].parent.resolve()
    assert found.pairs == brute_force(queries, database, 3)
    assert again.pairs == [(f"test/{first}", f"test/{second}") for first, second in found.pairs]


def test_an_image_of_the_map_is_not_its_own_pair(town_map, params, sides):
    with Map.open(town_map) as places:
        options = read_options({"model": Model(params, places.config), "k": 6})
        found = image_pairs(places, sides[0], **options).pairs
    assert len(found) == len(set(found)) == 7 * 6
    assert all(first != second for first, second in found)


def test_unreadable_images_have_no_pairs(town_map, params, tmp_path, sides):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "bad.jpg").write_bytes(b"no image")
    good = tmp_path / "in" / "good.jpg"
    good.write_bytes(list_images(sides[1])[0].read_bytes())
    with Map.open(town_map) as places:
        options = {"model": Model(params, places.config), "k": 1, "on_bad_image": "skip"}
        found = image_pairs(places, tmp_path / "in", **read_options(options))
    (bad,) = found.unreadable
    assert bad.endswith("in/bad.jpg")
    assert len(found.pairs) == 1
    assert found.pairs[0][0].endswith("in/good.jpg")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"k": -1}, "k: found -1, expected at least 0"),
        ({"k": 0}, "k: found 0, expected some rule"),
        ({"overlap": -1}, "overlap: found -1, expected at least 0"),
        ({"within": 0}, "within: found 0, expected more than 0"),
        ({"within": float("nan")}, "within: found nan, expected more than 0"),
        ({"within": 5}, "within: found no positions in"),
        ({"k": 0, "overlap": 1, "min_gap": 5}, "min gap: found without similar images"),
        ({"min_gap": 5}, r"min gap: found '0000.jpg' without a time \(3 such of 3\)"),
        ({"min_similarity": 2}, "min_similarity: found similarity 2"),
        ({"images": "/images", "overlap": 1}, "overlap and within: found with other images"),
        ({"root": "/elsewhere"}, "root: found /elsewhere, expected a folder that holds"),
    ],
)
def test_what_is_refused(tmp_path, options, words):
    places = made(tmp_path, numbered(range(3)), unit_rows(3))
    with pytest.raises(InputError, match=words):
        image_pairs(places, **options)


@pytest.mark.parametrize("name", ["a b.jpg", "a\tb.jpg", "#a.jpg"])
def test_a_name_that_a_line_cannot_hold_is_an_error(tmp_path, name):
    places = made(tmp_path, ["fine.jpg", "nested/é#.jpg", name], unit_rows(3))
    with pytest.raises(InputError, match=r"pairs: found the image name .* expected names with"):
        image_pairs(places)


# pycolmap


def matched_by_pycolmap(folder: pathlib.Path, names, pairs: pathlib.Path) -> set[frozenset]:
    """Which pairs pycolmap looks at: matches of any kind are in its database."""
    pycolmap = pytest.importorskip("pycolmap")
    with contextlib.closing(pycolmap.Database.open(folder / "d.db")) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100, 100, 100)
        number = database.write_camera(camera)
        ids = {}
        for name in names:
            image = pycolmap.Image(name=name, camera_id=number)
            ids[database.write_image(image)] = name
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = pairs
        found = pycolmap.ImportedPairGenerator(options, database).all_pairs()
    return {frozenset((ids[first], ids[second])) for first, second in found}


def test_pycolmap_reads_the_file(tmp_path):
    names = ["a/é.jpg", "b#.jpg", "c.png", "d.mp4#t=1.000"]
    wanted = [tuple(names[:2]), tuple(names[2:]), (names[3], names[0])]
    ImagePairs(wanted, pathlib.Path("/"), []).write(tmp_path / "pairs.txt")
    lines = (tmp_path / "pairs.txt").read_text(encoding="utf-8").splitlines()
    assert lines == [" ".join(pair) for pair in wanted]  # hloc: query, one space, image
    assert matched_by_pycolmap(tmp_path, names, tmp_path / "pairs.txt") == unordered(wanted)


def registered(work: pathlib.Path, images: pathlib.Path, pairs: pathlib.Path) -> int:
    """Reconstruct by SIFT on a CPU; how many images the largest model has."""
    import pycolmap

    work.mkdir()
    database, cpu = work / "d.db", pycolmap.Device.cpu
    pycolmap.set_random_seed(0)
    features = pycolmap.FeatureExtractionOptions()
    features.sift.max_num_features = 1200
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, images, camera_mode=mode, extraction_options=features, device=cpu
    )
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = pairs
    pycolmap.match_image_pairs(database, pairing_options=options, device=cpu)
    found = pycolmap.incremental_mapping(database, images, work)
    return max((each.num_reg_images() for each in found.values()), default=0)


@pytest.mark.slow
def test_a_street_is_reconstructed_from_a_tenth_of_the_pairs(tmp_path):
    """All images, and so as many as from all pairs: two walks down a rendered street."""
    pytest.importorskip("pycolmap")
    images, pairs, count = tmp_path / "images", tmp_path / "pairs.txt", 20
    images.mkdir()
    for walk, lateral in (("there", -1.0), ("again", 1.0)):
        for number in range(count):
            heading = 6 * np.sin(number / 3 + lateral)
            view = View(lateral=lateral, forward=0.8 * number, heading=heading)
            picture = render(2, view, (480, 640))
            cv2.imwrite(str(images / f"{walk}{number:02d}.png"), picture[:, :, ::-1])
    given = ("pairs", "--images", images, "--out", pairs, "--k", 3, "--quiet")
    assert main(list(map(str, given))) == 0
    every = 2 * count * (2 * count - 1) // 2
    assert len(pairs.read_text().splitlines()) <= every / 10
    assert registered(tmp_path / "ours", images, pairs) == 2 * count
