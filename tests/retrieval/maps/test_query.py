"""Questions to a map in Python: answers that outlive it, in any portions the same."""

import json
import math
import pathlib
import shutil

import cv2
import jax
import numpy as np
import pytest

import crisalad_jax.retrieval.maps.query
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.cli.query import answer_lines
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.live import FolderWatch, Frame
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.answer_files import format_answers
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.live import query_live
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answers, json_lines, query
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, random_params, read_options
from tests.retrieval.maps.conftest import ask
from tests.retrieval.maps.test_stores import ROUNDING


@pytest.fixture(scope="module")
def answers(town_map, params, sides) -> Answers:
    return ask(town_map, params, sides[1], k=3)


def test_answers_after_the_map_is_closed(town_map, answers, sides):
    assert answers.queries == list_images(sides[1])
    assert answers.neighbours.indices.shape == (5, 3)
    rows = list(answers.rows())
    assert [path for path, _ in rows] == answers.queries
    for (_, found), indices in zip(rows, answers.neighbours.indices, strict=True):
        assert [answer.rank for answer in found] == [1, 2, 3]
        assert [answer.image for answer in found] == [answers.images[i] for i in indices]
        similarities = [answer.similarity for answer in found]
        assert similarities == sorted(similarities, reverse=True)
    image = rows[0][1][0].image
    east = float(image.name.split("@")[1])
    assert answers.position(image) == {"east": east, "north": 5e6}
    assert answers.position(image._replace(position=None)) is None


def test_a_file_a_folder_or_a_list_of_both(town_map, params, sides, answers):
    one = answers.queries[0]
    assert ask(town_map, params, one).queries == [one]
    assert ask(town_map, params, [one, sides[1]]).queries == [one, *answers.queries]
    # Fewer in the map than asked for: all of them.
    assert ask(town_map, params, str(one), k=99).neighbours.indices.shape == (1, 7)


def test_in_portions_all_the_same(town_map, params, sides, answers, monkeypatch):
    monkeypatch.setattr(crisalad_jax.retrieval.maps.query, "AT_ONCE", 1)
    found = ask(town_map, params, sides[1], k=3)
    np.testing.assert_array_equal(found.neighbours.indices, answers.neighbours.indices)
    np.testing.assert_allclose(
        found.neighbours.similarities, answers.neighbours.similarities, atol=ROUNDING, rtol=0
    )


def test_lines_of_json(answers):
    lines = format_answers("a.jsonl", answers)[0].splitlines()
    assert lines == list(json_lines(answers))
    assert json.loads(format_answers("a.json", answers)[0]) == list(map(json.loads, lines))
    first = json.loads(lines[0])
    ((path, found), *_) = answers.rows()
    assert first["query"] == path.name  # the source is its folder
    assert first["zone"] == "10 south"  # of names with @10@S@, and too far north for band S
    assert first["neighbours"][1] == {
        "rank": 2,
        "name": found[1].image.name,
        "similarity": round(found[1].similarity, 6),
        "position": answers.position(found[1].image),
    }


def test_names_of_queries_are_relative_to_their_source(town_map, params, sides, monkeypatch):
    """Of several sources, to the folder that holds all, so that no two images have one name."""
    database, queries = sides
    one = list_images(queries)[0]
    assert ask(town_map, params, one).names == [one.name]
    assert ask(town_map, params, [one, one]).names == [one.name] * 2
    found = ask(town_map, params, [queries, database])
    expected = [f"{s.name}/{each.name}" for s in (queries, database) for each in list_images(s)]
    assert found.names == expected
    monkeypatch.chdir(queries)
    assert ask(town_map, params, [pathlib.Path(one.name), database]).names == [
        f"{queries.name}/{one.name}",
        *(f"{database.name}/{each.name}" for each in list_images(database)),
    ]


def test_lines_for_people(answers):
    """Names stand whole at the ends of lines, and what has no position has a dash."""
    image = answers.images[0]._replace(name="a[red].jpg", position=None)
    answers = answers._replace(images=[image] * 7)
    head, *lines = answer_lines(answers)
    assert head.split() == ["rank", "similarity", "east,", "north", "(zone", "10", "south)", "name"]
    assert lines[0] == answers.queries[0].name
    best = answers.neighbours.similarities[0, 0]
    assert lines[1].split() == ["1", f"{best:.3f}", "-", "a[red].jpg"]
    assert sum(line.endswith("  a[red].jpg") for line in lines) == 15
    assert len({line.index("a[red]") for line in lines if "a[red]" in line}) == 1


@pytest.mark.parametrize(
    ("images", "options", "words"),
    [
        ([], {}, "images: found none, expected at least one image"),
        (["none.jpg"], {}, "none.jpg: found no such file"),
        (["none.jpg"], {"k": 0}, "k: found 0, expected at least 1"),
    ],
)
def test_what_is_refused(town_map, params, images, options, words):
    with pytest.raises(InputError, match=words):
        ask(town_map, params, images, **options)


def test_the_model_of_a_map(town_map, shared, params, tmp_path):
    with Map.open(town_map) as places:
        found = places.load_model()
        np.testing.assert_array_equal(found.params.backbone.cls_token, params.backbone.cls_token)
        assert found.config == places.config
        other = tmp_path / "other.safetensors"
        changed = random_params(MODEL)
        changed.backbone.__dict__["cls_token"] = changed.backbone.cls_token + 1
        save_weights(other, Model(changed, MODEL))
        with pytest.raises(InputError, match=r"found a map made by model .* is model"):
            places.load_model(other)


def test_a_summary(town_map, shared):
    with Map.open(town_map) as places:
        summary = places.summary(verify=True)
    assert json.loads(json.dumps(summary)) == summary | {"axes": ["east", "north"]}
    assert (summary["images"], summary["positions"], summary["verified"]) == (7, 7, True)
    assert summary["weights"] == str((shared / "weights.safetensors").resolve())


def test_one_picture_is_located_as_by_a_query(town_map, params, answers):
    places = Map.open(town_map)
    for path, ranked in answers.rows():
        for image in (path, str(path), read_image(path)):
            found = places.locate(image, k=3)
            assert [answer.image for answer in found] == [answer.image for answer in ranked]
            # Batches of one and of many round otherwise: cosines of unit vectors in float32.
            np.testing.assert_allclose(
                [answer.similarity for answer in found],
                [answer.similarity for answer in ranked],
                atol=5e-6,
            )
            assert [answer.rank for answer in found] == [1, 2, 3]
    assert len(
        places.locate(answers.queries[0], k=10**6, model=Model(params, places.config))
    ) == len(places)


@pytest.mark.parametrize("last", [(), (1,)], ids=["mono8", "one channel"])
def test_grey_is_located_as_its_three_channels(town_map, answers, last):
    """As cv2.IMREAD_GRAYSCALE and ROS's mono8 have it, and what comes live."""
    grey = cv2.imread(str(answers.queries[0]), cv2.IMREAD_GRAYSCALE)
    picture, repeated = grey.reshape(*grey.shape, *last), np.stack([grey] * 3, axis=-1)
    places = Map.open(town_map)
    assert places.locate(picture, k=3) == places.locate(repeated, k=3)

    class Node:
        size = None

        def frames(self, check=None):
            for each in (picture, repeated):
                yield Frame("camera", 1.5, each, 0.0)

    first, second = query_live(places, Node(), k=3)
    assert list(first.answers.rows()) == list(second.answers.rows())


def test_a_map_of_thermal_images_reads_queries_as_it_was_made(tmp_path, shared, params, sides):
    """16-bit files against 8-bit ones that were stretched by hand, and kept as they are."""
    weights = shared / "weights.safetensors"
    for number, path in enumerate(list_images(sides[0])):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        thermal = 7200 + 6 * grey.astype(np.uint16)
        ranks = [math.ceil(thermal.size * share) - 1 for share in (0.01, 0.99)]
        low, high = np.sort(thermal, axis=None)[ranks].astype(float)
        by_hand = np.rint(255 * np.clip((thermal - low) / (high - low), 0, 1)).astype(np.uint8)
        for name, values in (("thermal", thermal), ("by_hand", by_hand)):
            (tmp_path / name).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), values)
    options = {"weights": weights} | read_options({})
    out = tmp_path / "map"
    stretched = MODEL.resized(None, ["contrast-stretch"])
    index(Model(params, stretched), tmp_path / "thermal", out, **options)
    index(Model(params, MODEL), tmp_path / "by_hand", tmp_path / "map2", **options)
    places, expected = Map.open(out), Map.open(tmp_path / "map2")
    np.testing.assert_array_equal(
        np.concatenate(list(places.descriptors)), np.concatenate(list(expected.descriptors))
    )
    one = tmp_path / "thermal" / "3.png"
    values = cv2.imread(str(one), cv2.IMREAD_UNCHANGED)
    right = expected.locate(tmp_path / "by_hand" / "3.png", k=3)
    for image in (one, values, values.astype(np.float32)):
        found = places.locate(image, k=3)
        assert [(a.image.name, a.similarity) for a in found] == [
            (a.image.name, a.similarity) for a in right
        ]
    watch = FolderWatch(tmp_path)
    shutil.copy(one, tmp_path / "new.png")
    live = next(query_live(places, watch, model=Model(params, places.config), k=3))
    asked = query(places, one, model=Model(params, places.config), k=3, reading=Reading(quiet=True))
    for each in (live.answers, asked):
        ((_, ranked),) = each.rows()
        assert [answer.image.name for answer in ranked] == [answer.image.name for answer in right]
        # Batches of one and of many round otherwise.
        assert ranked[0].similarity == pytest.approx(right[0].similarity, abs=5e-6)
    # More images in another way are refused, as in any map.
    other = MODEL.resized(None, ["high-byte"])
    with pytest.raises(InputError, match=r"expected .*contrast-stretch as in the map"):
        index(Model(params, other), tmp_path / "thermal", out, **options)


def test_one_picture_and_what_comes_live_are_asked_of_some_images(town_map, answers):
    """As a search of the whole map has them, without the others."""
    places = Map.open(town_map)
    east = sorted(image.position[0] for image in places.images if image.position)[3]
    whole = places.locate(answers.queries[0], k=9)
    expected = [each.image for each in whole if each.image.position[0] >= east]
    assert 0 < len(expected) < len(whole)
    where = f"box={east},0,9e9,9e9"
    assert [each.image for each in places.locate(answers.queries[0], 9, where=where)] == expected

    class Node:
        size = None

        def frames(self, check=None):
            yield Frame("camera", 1.5, read_image(answers.queries[0]), 0.0)

    (live,) = query_live(places, Node(), k=9, where=where)
    assert [answer.image for answer in live.ranked] == expected
    for options, words in (
        ({"where": "folder=nowhere"}, "where: found none of 7 images"),
        ({"where": where, "sequence": BayesFilter()}, "with a sequence, expected only one"),
    ):
        with pytest.raises(InputError, match=words):
            query(places, answers.queries, **options)


def test_what_locate_refuses(town_map, params, answers):
    places = Map.open(town_map)
    other = Model(jax.tree.map(lambda leaf: leaf + 1, params), places.config)
    for image, options, words in (
        (answers.queries[0], {"k": 0}, "k: found 0, expected at least 1"),
        ("nowhere.png", {}, r"nowhere\.png"),
        (np.zeros((8, 8, 3)), {}, "image: found float64 of shape"),
        (answers.queries[0], {"model": other}, "found a map made by model"),
    ):
        with pytest.raises(InputError, match=words):
            places.locate(image, **options)


@pytest.mark.parametrize("k", [1.5, 2.0, "3", None, True, np.float32(1)])
def test_a_number_of_answers_is_a_whole_number(town_map, answers, k):
    with Map.open(town_map) as places:
        rows = np.eye(1, places.metadata.descriptor_length, dtype=np.float32)
        for ask_for in (
            lambda: places.locate(answers.queries[0], k=k),
            lambda: places.search(rows, k),
            lambda: query(places, answers.queries, k=k),
            lambda: query_live(places, FolderWatch(town_map), k=k),
        ):
            with pytest.raises(InputError, match=r"k: found .*, expected a whole number"):
                ask_for()
