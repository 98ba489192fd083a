"""`crisalad index`, `query` and `info --map`: maps made, grown, asked, refused."""

import json
import pathlib
import shutil

import cv2
import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.tables import fact_lines
from crisalad_jax.data.images import list_images
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.maps.map import Map
from tests.cli.test_cli import fails, files_in, runs, succeeds
from tests.conftest import BATCH, describe_single
from tests.retrieval.maps.test_pairs import brute_force as nearest
from tests.retrieval.maps.test_pairs import by_name
from tests.retrieval.maps.test_stores import brute_force

MILVUS = "milvus:{map}/rows.db"


def index(shared: pathlib.Path, images: pathlib.Path, out: pathlib.Path, *more: object) -> tuple:
    return (
        *("index", "--weights", shared / "weights.safetensors", "--images", images),
        *("--out", out, "--batch-size", BATCH, "--quiet", *more),
    )


def query(folder: pathlib.Path, *more: object) -> tuple:
    return ("query", *more, "--map", folder, "--batch-size", BATCH, "--quiet")


def expected_answers(shared, database, queries, k: int) -> list[list[bytes]]:
    """Pictures, by descriptors of the library and brute force."""
    model = load_weights(shared / "weights.safetensors")
    known, asked = list_images(database), list_images(queries)
    sides = (describe_single(model, known), describe_single(model, asked))
    return pictures(database, [[known[i].name for i in row] for row in brute_force(*sides, k)])


def pictures(database, answers: list[list[str]]) -> list[list[bytes]]:
    """Pictures by name: two of the town are equal, and rounding decides which of them is first."""
    return [[(database / name).read_bytes() for name in names] for names in answers]


@pytest.mark.parametrize("store", ["files", MILVUS])
def test_a_map_is_made_grown_and_asked(shared, database, queries, tmp_path, capfd, store):
    out, part = tmp_path / "map", tmp_path / "part"
    part.mkdir()
    for path in list_images(database)[:2]:
        (part / path.name).symlink_to(path)
    stored = ("--store", store.format(map=out))
    said = succeeds(capfd, *index(shared, part, out, *stored))
    assert f"{out}: 2 images added, 2 with positions; 2 descriptors of 48 dimensions" in said
    said = succeeds(capfd, *index(shared, database, out))
    assert "5 images added, 5 with positions; 2 were there already; 7 descriptors" in said
    assert "7 were there already" in succeeds(capfd, *index(shared, database, out, *stored))
    assert (out / "rows.db").exists() == (store != "files")
    assert any(name.endswith(".npy") for name in files_in(out)) == (store == "files")

    answers = tmp_path / "answers.jsonl"
    said = succeeds(capfd, *query(out, queries, "--k", 3, "--json", answers))
    assert said == f"{answers}: 5 queries in a map of 7 images; by jax"
    lines = [json.loads(line) for line in answers.read_text().splitlines()]
    assert [line["query"] for line in lines] == [p.name for p in list_images(queries)]
    found = [[answer["name"] for answer in line["neighbours"]] for line in lines]
    assert pictures(database, found) == expected_answers(shared, database, queries, 3)
    first = lines[0]["neighbours"]
    assert [answer["rank"] for answer in first] == [1, 2, 3]
    east = float(first[0]["name"].split("@")[1])
    assert first[0]["position"] == {"east": east, "north": 5000000.0}


def test_answers_are_a_table_json_or_a_gallery(folder, queries, tmp_path, capfd):
    one, two = list_images(queries)[:2]
    table = succeeds(capfd, *query(folder, one, two, "--k", 2))
    for word in (one.name, "similarity", "east, north", "7 images", "5000000"):
        assert word in table
    assert table.count("@@@database") == 4

    printed, _ = runs(capfd, *query(folder, one, two, "--k", 2, "--json", "-"))
    lines = [json.loads(line) for line in printed.splitlines()]
    assert [line["query"] for line in lines] == [one.name, two.name]

    picture = tmp_path / "gallery.png"
    said = succeeds(capfd, *query(folder, queries, "--gallery", picture))
    assert said.endswith(f"{picture}: 5 queries in a map of 7 images; by jax")
    assert said.count("@@@database") == 5 * 5  # the table, too
    # A query and five answers, each 204 pixels wide.
    assert cv2.imread(str(picture)).shape[1] > 6 * 204


def test_answers_are_of_the_images_that_conditions_take(folder, queries, capfd):
    """The whole map's answers without the others; what cannot be meant is one line."""
    one = list_images(queries)[0]

    def answers(*more):
        printed, _ = runs(capfd, *query(folder, one, "--k", 9, "--json", "-", *more))
        found = json.loads(printed)["neighbours"]
        return [(answer["name"], answer["similarity"]) for answer in found]

    whole = answers()
    east = sorted(float(name.split("@")[1]) for name, _ in whole)[3]
    some = answers("--where", "added>=2020-01-01", "--where", f"box={east},0,9e9,9e9")
    assert some == [pair for pair in whole if float(pair[0].split("@")[1]) >= east]
    assert 0 < len(some) < len(whole)
    for text, words in (
        ("colour=red", "where: found 'colour=red', expected folder="),
        ("folder=nowhere", "where: found none of 7 images (0 by folder), expected at least one"),
    ):
        fails(capfd, *query(folder, one, "--where", text), words=(words,))
    both = query(folder, one, "--where", "folder=a", "--sequence", "bayes")
    fails(capfd, *both, words=("--where: found with --sequence",))


def test_answers_are_positions_of_a_new_map(shared, folder, queries, tmp_path, capfd):
    """What `query --out` writes, `index --positions` reads; GeoJSON has the same in degrees."""
    table, layer = tmp_path / "a.csv", tmp_path / "a.geojson"
    said = succeeds(capfd, *query(folder, queries, "--k", 1, "--out", table))
    assert said.endswith(f"{table}: 5 queries in a map of 7 images; by jax")
    succeeds(capfd, *index(shared, queries, tmp_path / "new", "--positions", table))
    lines, _ = runs(capfd, *query(folder, queries, "--json", "-", "--out", layer))
    best = {row["query"]: row["neighbours"][0] for row in map(json.loads, lines.splitlines())}
    with Map.open(tmp_path / "new") as found:
        for image in found.images:
            assert image.position == tuple(best[image.name]["position"].values())
    features = json.loads(layer.read_text())["features"]
    assert [each["properties"]["query"] for each in features] == list(best)
    assert all(len(each["geometry"]["coordinates"]) == 2 for each in features)
    # Between two queries, where similarities are farthest apart.
    likeness = np.sort([answer["similarity"] for answer in best.values()])
    unknown = int(np.diff(likeness).argmax()) + 1
    least = likeness[unknown - 1 : unknown + 1].mean()
    said = succeeds(capfd, *query(folder, queries, "--out", table, "--min-similarity", least))
    words = f"{5 - unknown} of 5 queries in a map of 7 images; by jax; {unknown} of 5 unknown"
    assert f"{table}: {words}" in said


def test_a_gallery_shows_so_much_and_says_of_how_much(
    folder, queries, tmp_path, capfd, monkeypatch
):
    monkeypatch.setattr("crisalad_jax.cli.query._ROWS", 2)
    monkeypatch.setattr("crisalad_jax.cli.query._COLUMNS", 3)
    picture, answers = tmp_path / "g.png", tmp_path / "a.jsonl"
    asked = ("--k", 7, "--gallery", picture, "--json", answers)
    said = succeeds(capfd, *query(folder, queries, *asked))
    assert f"{picture}: 2 of 5 queries in a map of 7 images" in said
    assert f"{answers}: 5 queries in a map of 7 images" in said
    # A query and three answers of 1.7 inches at 120 dots; the next would be beyond 1,000.
    assert 4 * 204 < cv2.imread(str(picture)).shape[1] < 1000
    assert len(json.loads(answers.read_text().splitlines()[0])["neighbours"]) == 7


def test_a_map_moved_without_its_weights_and_images_is_told_where_they_are(
    shared, database, queries, tmp_path, capfd
):
    weights = pathlib.Path(shutil.copy(shared / "weights.safetensors", tmp_path))
    images = shutil.copytree(database, tmp_path / "images")
    made = ("index", "--weights", weights, "--images", images, "--out", tmp_path / "map")
    succeeds(capfd, *made, "--batch-size", BATCH, "--quiet")
    folder = (tmp_path / "map").rename(tmp_path / "moved")
    weights.unlink()
    images.rename(tmp_path / "elsewhere")
    asked = query(folder, queries, "--gallery", tmp_path / "g.png")
    fails(capfd, *asked, words=(f"found no {weights}, which made this map", "--weights"))
    asked = (*asked, "--weights", shared / "weights.safetensors")
    _, error = runs(capfd, *asked)
    assert error.startswith(f"crisalad: note: 7 pictures shown as a grey box (first: {images}/")
    succeeds(capfd, *asked, "--map-images", tmp_path / "elsewhere")
    assert files_in(tmp_path / "moved") == {
        *("map.json", "segments/0000000000.json", "segments/0000000000.npy")
    }


def test_info_says_what_a_map_is(folder, shared, tmp_path, capfd, weights):
    said = succeeds(capfd, "info", "--map", folder, "--checksums", "--json", tmp_path / "info.json")
    # The town's database: one folder, whose names say where they are.
    places = [image.position for image in Map.open(folder).images]
    east, north = ([min(axis), max(axis)] for axis in zip(*places, strict=True))
    day = json.loads((folder / "segments" / "0000000000.json").read_text())["added"][:10]
    root = (shared / "town" / "images" / "test" / "database").resolve()
    for words in (
        "images 7 removed 0 positions 7 axes east, north",
        f"additions day {day}, root {root}, images 7",
        f"extent east {east[0]:.9g} to {east[1]:.9g}, north {north[0]:.9g} to {north[1]:.9g}",
        "verified yes",
    ):
        assert words in said
    summary = json.loads((tmp_path / "info.json").read_text())
    assert (summary["weights"], summary["verified"]) == (str(weights), True)
    assert summary["extent"] == {"east": east, "north": north}
    path = folder / "segments" / "0000000000.npy"
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    assert "verified" not in succeeds(capfd, "info", "--map", folder)
    fails(capfd, "info", "--map", folder, "--checksums", words=("descriptors 0 to 6 have changed",))
    both = ("info", "--map", folder, "--batch-size", 4)
    fails(capfd, *both, words=("--batch-size: found with --map",))


def test_a_long_fact_is_cut_after_ten_rows():
    lines = list(fact_lines({"folders": [{"folder": str(i)} for i in range(12)], "map": None}))
    assert lines[9:] == ["         folder 9", "         and 2 more", "map      not given"]


def test_positions_come_from_a_table(shared, database, tmp_path, capfd):
    table = tmp_path / "positions.csv"
    name = list_images(database)[1].name
    table.write_text(f"name,lat,lon\n{name},1.5,-2.5\nother.jpg,0,0\n")
    out = tmp_path / "map"
    said = succeeds(capfd, *index(shared, database, out, "--positions", table))
    assert "7 images added, 1 with positions" in said
    assert "1 given positions match no image here, 'other.jpg' the first" in said
    with Map.open(out) as found:
        assert found.axes == ("lat", "lon")
        assert [image.position for image in found.images][:3] == [None, (1.5, -2.5), None]
    table.write_text("name,lat,lon\nother.jpg,0,0\n")
    made = index(shared, database, tmp_path / "none", "--positions", table)
    fails(capfd, *made, words=(table, "found none of the 7 images of", "expected names such as"))
    assert not (tmp_path / "none").exists()


# Refused


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--image-size", 56, 56), "found images at 56 x 56, bilinear"),
        (("--compute-dtype", "bfloat16"), "found compute dtype bfloat16, expected float32"),
        (("--dtype", "float16"), "found dtype float16, expected float32 as in the map"),
        (("--store", "milvus:x.db"), "expected files as in the map"),
        (("--store", "redis"), "store: found 'redis', expected files or milvus:URI"),
        (("--batch-size", 0), "size: found 0, expected at least 1"),
    ],
)
def test_a_map_keeps_its_settings(shared, folder, database, capfd, flags, words):
    fails(capfd, *index(shared, database, folder, *flags), words=(words,))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("{images}", "--k", 0), "k: found 0, expected at least 1"),
        (("{map}/map.json",), "map.json: found"),
        (("{map}/none.jpg",), "none.jpg: found no such file, expected"),
        (("{map}/segments",), "segments: found no image"),
        (("{images}", "--gallery", "{map}"), "map: found a folder, expected a file"),
        (
            ("{images}", "--map-images", "{map}"),
            "--map-images: found without --gallery, --rerun or --verify, expected",
        ),
        (
            ("{images}", "--json", "{map}/x", "--gallery", "{map}/../map/x"),
            "x, as --json, expected two files",
        ),
        (("{images}", "--out", "{map}/x"), "x, expected a name that ends in .csv or .geojson"),
        (("{images}", "--out", "{map}/x.json"), "x.json, expected a name that ends in .csv or"),
        (("{images}", "--map", "{images}"), "and no map.json, expected a map"),
        (("{images}", "--map", "{map}/none"), "none: found no map, expected a folder that"),
    ],
)
def test_bad_questions_are_one_line(folder, queries, capfd, arguments, words):
    filled = [str(part).format(map=folder, images=queries) for part in arguments]
    fails(capfd, *query(folder)[:1], "--map", folder, *filled, "--quiet", words=(words,))


def test_positions_of_images_that_are_there_are_said_to_stay(
    shared, folder, database, tmp_path, capfd, monkeypatch
):
    table = tmp_path / "positions.csv"
    known = list_images(database)
    table.write_text(f"name,east,north\n{known[0].name},1,2\n{known[1].name},3,4\nno.jpg,5,6\n")
    made = index(shared, database, folder, "--positions", table)
    assert "2 given positions ignored, as the map has these images" in succeeds(capfd, *made)
    with Map.open(folder) as found:
        assert found.images[0].position not in ((1.0, 2.0), None)
    images = tmp_path / "images"
    images.mkdir()
    (images / "new.png").write_bytes(known[0].read_bytes())
    table.write_text("name,lat,lon\nnew.png,1,2\n")
    monkeypatch.setattr("crisalad_jax.retrieval.on_cluster.described", None)
    words = ("degrees of longitude from the middle of zone 10 south, whose metres",)
    fails(capfd, *index(shared, images, folder, "--positions", table), words=words)


# Pairs


def test_pairs_that_hloc_reads(shared, database, queries, tmp_path, capfd, weights):
    """Of images, of a map, and of other images with it: the same names as in hloc's features."""
    root = shared / "town" / "images" / "test"
    usual = ("--root", root, "--batch-size", BATCH, "--quiet")
    sides = []
    for images in (database, queries):
        out = tmp_path / f"{images.name}.h5"
        given = ("extract", "--weights", weights, "--images", images, "--out", out, *usual)
        succeeds(capfd, *given)
        sides.append(by_name(*read_descriptors(out)))
    succeeds(capfd, *index(shared, database, tmp_path / "map"))
    among, again, between = (tmp_path / f"{name}.txt" for name in ("among", "again", "between"))
    given = ("pairs", *usual, "--images", database, "--weights", weights, "--k", 2)
    said = succeeds(capfd, *given, "--out", among)
    given = ("pairs", *usual, "--map", tmp_path / "map", "--k", 2, "--out", again)
    succeeds(capfd, *given, "--json", tmp_path / "pairs.json")
    assert again.read_text() == among.read_text()
    pairs = read_pairs(among)
    assert said.endswith(f"{among}: {len(pairs)} pairs of 7 images, named relative to {root}")
    assert set(map(frozenset, pairs)) == set(map(frozenset, nearest(sides[0], sides[0], 2)))
    result = json.loads((tmp_path / "pairs.json").read_text())
    assert (result["pairs"], result["root"], result["unreadable"]) == (len(pairs), str(root), [])
    given = ("pairs", "--map", tmp_path / "map", "--images", queries, "--k", 3, *usual)
    succeeds(capfd, *given, "--out", between)
    assert read_pairs(between) == nearest(sides[1], sides[0], 3)


def read_pairs(file: pathlib.Path) -> list[tuple[str, str]]:
    """A pair a line, as hloc reads them: more or fewer than two names is an error."""
    lines = [line.split(" ") for line in file.read_text(encoding="utf-8").splitlines()]
    return [(query, image) for query, image in lines]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ((), "--map: found none, and no --images"),
        (("--images", "{images}", "--k", 0), "k: found 0, expected some rule"),
        (("--map", "{map}", "--images", "{images}", "--overlap", 2), "overlap and within: found"),
        (("--map", "{map}", "--fps", 2), "--fps: found without --images"),
        (("--map", "{map}", "--weights", "salad"), "--weights: found without --images"),
        (("--images", "{images}/none", "--weights", "hog"), "none: found no such file"),
    ],
)
def test_pairs_that_are_refused(folder, queries, tmp_path, capfd, flags, words):
    filled = [str(part).format(map=folder, images=queries) for part in flags]
    fails(capfd, "pairs", *filled, "--out", tmp_path / "pairs.txt", words=(words,))
    assert not (tmp_path / "pairs.txt").exists()
