"""Adaptation to a map's place: what is held out, what is trained, and when the map changes."""

import dataclasses
import json
import os
import pathlib
import shutil

import cv2
import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.load import load
from crisalad_jax.checkpoints.weights import model_hash, save_weights
from crisalad_jax.cli import main
from crisalad_jax.data.images import read_image
from crisalad_jax.data.positions import AXES, Positions
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import ImageSource, open_source
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments import adapt as module
from crisalad_jax.experiments.adapt import adapt
from crisalad_jax.experiments.held_out import (
    CHOOSING,
    JUDGING,
    Split,
    held_out_benchmark,
    split_images,
    with_repeats,
)
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.retrieval.maps import file_store, remake
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import existing_metadata
from crisalad_jax.retrieval.maps.remake import check_remakeable, remake_map, source_of_map
from crisalad_jax.training.log import read_metrics
from crisalad_jax.utils import files
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, RECIPE, random_params

QUIET = Reading(quiet=True, batch_size=4)
CONFIG = dataclasses.replace(
    RECIPE, places_per_batch=2, min_images=2, epochs=2, monitor="R@1", patience=None
)


ANOTHER = dataclasses.replace(CONFIG, model=dataclasses.replace(MODEL, cross_image="none"))
OTHER = Model(jax.tree.map(lambda leaf: 1.1 * leaf, random_params(MODEL)), MODEL)


def in_a_row(folder: pathlib.Path, east: list[float]) -> ImageSource:
    names = [f"{number}.png" for number in range(len(east))]
    of = {name: (at, 0.0) for name, at in zip(names, east, strict=True)}
    return ImageSource(folder, [folder / name for name in names], names, Positions(AXES[0], of))


def test_held_out_images_ask_their_neighbours_and_train_nothing(tmp_path) -> None:
    """On a line; every seed holds out a fifth."""
    east = [0, 6, 9, 100, 104, 108, 300, 500, 506, 700]
    source = in_a_row(tmp_path, east)
    seen = set[int]()
    for seed in range(20):
        split = split_images([source], seed, place_radius=10)
        assert len(split.answers) == 2
        seen.update(split.answers)
        trained = {int(file.partition(".")[0]) for file in split.training.files}
        assert trained == set(range(10)) - set(split.answers)
        for image, right in split.answers.items():
            near = {i for i, at in enumerate(east) if i != image and abs(at - east[image]) <= 10}
            near -= set(split.answers)
            assert set(right) == (near or {image})
            assert (image in split.database) == (not near)
        assert set(split.database) >= trained
    assert seen == set(range(10))


def test_frames_in_order_are_neighbours_in_their_own_folder(tmp_path) -> None:
    paths = [tmp_path / folder / f"{number}.png" for folder in "ab" for number in range(5)]
    names = [path.relative_to(tmp_path).as_posix() for path in paths]
    source = ImageSource(tmp_path, paths, names)
    for seed in range(20):
        split = split_images([source], seed, place_frames=3)
        for image, right in split.answers.items():
            same = range(0, 5) if image < 5 else range(5, 10)
            near = [i for i in same if 0 < abs(i - image) < 3 and i not in split.answers]
            assert right == (near or [image])
    alone = split_images([source], 0)
    assert all(right == [image] for image, right in alone.answers.items())
    assert alone.training.image_counts.tolist() == [1] * 8


def test_more_images_train_and_answer_nothing(tmp_path) -> None:
    first, second = in_a_row(tmp_path / "a", [0, 100, 200]), in_a_row(tmp_path / "b", [1, 99])
    split = split_images([first, second], 0, place_radius=5)
    assert [name for name in split.source.names if name.startswith("b/")] == ["b/0.png", "b/1.png"]
    assert {"b/0.png", "b/1.png"} <= set(split.training.files)
    assert max(split.database) < 3


def test_a_place_of_one_image_has_it_twice(tmp_path) -> None:
    source = in_a_row(tmp_path, [0, 1, 2, 300, 600, 900, 1200])
    split = split_images([source], 1, place_radius=5)
    places = split.training
    filled = with_repeats(places, 2)
    for number, name in enumerate(places.names):
        own, full = (
            each.files[each.place_start[number] : each.place_start[number + 1]]
            for each in (places, filled)
        )
        assert filled.names[number] == name
        assert full == (own * 2 if len(own) == 1 else own)
    assert 1 in places.image_counts


def test_held_out_copies_are_the_runs_augmentation(shared, tmp_path) -> None:
    source = open_source(shared / "town" / "images" / "test" / "database")
    split = split_images([source], 0)
    found = held_out_benchmark(CONFIG, split, tmp_path / "held-out", CHOOSING)
    count = len(CHOOSING)
    assert len(found.queries) == count * len(split.answers)
    (image, *_) = split.answers
    pixels = cv2.resize(read_image(source.paths[image]), MODEL.input_size[::-1])
    pictures = [read_image(path) for path in found.queries[:count]]
    assert len({picture.tobytes() for picture in pictures}) == count
    for picture in pictures:
        assert picture.shape == pixels.shape
        assert 0 < np.abs(picture.astype(int) - pixels).mean() < 60
    asked = [image for image in split.answers for _ in CHOOSING]
    for query, image, right in zip(found.queries, asked, found.positives, strict=True):
        assert query.name.startswith(f"{image:06d}-")
        paths = [found.database[number] for number in right]
        assert paths == [source.paths[number] for number in split.answers[image]]
    bits = [path.read_bytes() for path in found.queries]
    found.queries[0].write_bytes(b"of another run")
    again = held_out_benchmark(CONFIG, split, tmp_path / "held-out", CHOOSING)
    assert [path.read_bytes() for path in again.queries] == bits
    others = held_out_benchmark(CONFIG, split, tmp_path / "held-out", JUDGING)
    assert not {path.read_bytes() for path in others.queries} & set(bits)
    assert [path.read_bytes() for path in again.queries] == bits


def test_an_unreadable_held_out_image_asks_nothing(shared, tmp_path) -> None:
    shutil.copytree(shared / "city" / "Images", tmp_path / "images")
    split = split_images([open_source(tmp_path / "images")], 0)
    (broken, *_) = split.answers
    split.source.paths[broken].write_bytes(b"no picture")
    how = CONFIG, split, tmp_path / "held-out", JUDGING
    with pytest.raises(InputError, match=split.source.paths[broken].name):
        held_out_benchmark(*how)
    found = held_out_benchmark(*how, "skip")
    asked = {int(query.name[:6]) for query in found.queries}
    assert asked == split.answers.keys() - {broken}
    assert len(found.positives or ()) == len(found.queries)


@pytest.fixture
def folder(shared, tmp_path) -> pathlib.Path:
    """A map of images without positions, which the test may change."""
    work = tmp_path / "images"
    shutil.copytree(shared / "city" / "Images", work)
    weights = shared / "weights.safetensors"
    index(load(weights), work, tmp_path / "map", weights=weights, reading=QUIET)
    return tmp_path / "map"


def forced(monkeypatch: pytest.MonkeyPatch, before: float) -> None:
    """Let held-out frames recall so much before, whatever they do, and as they do after."""
    measure, told = module._recall, iter([before])
    monkeypatch.setattr(module, "_recall", lambda *given: next(told, None) or measure(*given))


def test_what_gains_makes_the_map_anew(shared, folder, tmp_path, monkeypatch) -> None:
    forced(monkeypatch, -1.0)
    said: list[str] = []
    out = tmp_path / "out"
    how = {"place_frames": 3, "watch": [shared / "town"], "most_lost": 1.0, "replace": True}
    with Map.open(folder) as old:
        names, before = [image.name for image in old.images], old.metadata
        split = split_images([source_of_map(old)], CONFIG.seed, place_frames=3)
    result = adapt(CONFIG, folder, out, **how, reading=QUIET, say=said.append)
    assert result.weights == out / "adapted.safetensors"
    assert result.replaced
    new = load(result.weights)
    lines = read_metrics(out / "run" / "metrics.jsonl")
    assert result.steps == len([line for line in lines if "loss" in line])
    judges = held_out_benchmark(CONFIG, split, out / "held-out", JUDGING)
    (judged,) = evaluate(new, judges, groupings=["single"], reading=QUIET)
    after = judged.recalls[1]
    assert result.held_out == (-1.0, after)
    ((name, (recall, change)),) = result.others.items()
    assert name in said[-1]
    assert 0 <= recall <= 1
    assert -1 <= change.mean <= 1
    found = json.loads((out / "adapted.json").read_text())
    assert found["held_out"] == {"before": -1.0, "after": after}
    with Map.open(folder) as places:
        assert [image.name for image in places.images] == names
        assert places.metadata.model == model_hash(*new) != before.model
        picture = pathlib.Path(places.images[3].root) / names[3]
        assert places.locate(picture, k=1)[0].image.name == names[3]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "map", "out"]


def test_the_map_stays_where_nothing_is_gained_or_others_lose(
    shared, folder, tmp_path, monkeypatch
) -> None:
    before = (folder / "map.json").read_bytes()
    forced(monkeypatch, 2.0)
    result = adapt(CONFIG, folder, tmp_path / "a", replace=True, reading=QUIET)
    assert (result.weights, result.replaced) == (None, False)
    assert not (tmp_path / "a" / "adapted.safetensors").exists()
    forced(monkeypatch, -1.0)
    (start, *_) = jax.tree.leaves(load(shared / "weights.safetensors").params)

    def firsts(model: Model, *_: object) -> np.ndarray:
        """All right before, and one of four wrong after."""
        is_start = np.array_equal(jax.tree.leaves(model.params)[0], start)
        return np.array([[True, True, True, is_start]])

    monkeypatch.setattr(module, "_firsts", firsts)
    lost = {"watch": [shared / "town"], "most_lost": 0.24}
    result = adapt(CONFIG, folder, tmp_path / "a", replace=True, **lost, reading=QUIET)
    ((recall, change),) = result.others.values()
    assert (recall, change.mean) == (1, -0.25)
    assert result.weights is not None
    assert not result.replaced
    assert (folder / "map.json").read_bytes() == before


@pytest.mark.slow  # trains for one number; the others train, too
def test_the_recall_before_is_that_of_the_maps_model(folder, tmp_path) -> None:
    """And a run that goes on ends as it did."""
    config = dataclasses.replace(
        CONFIG, optimiser=dataclasses.replace(CONFIG.optimiser, learning_rate=1e-12)
    )
    result = adapt(config, folder, tmp_path / "out", place_frames=3, reading=QUIET)
    assert result.held_out[0] == result.held_out[1]  # steps of 1e-12 change no ranking
    assert result.weights is None
    assert adapt(config, folder, tmp_path / "out", place_frames=3, reading=QUIET) == result


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"weights": "other"}, "found a map made by model"),
        ({"config": ANOTHER}, "the map has another model"),
        ({"gone": "Brill"}, "gone, expected the image of"),
        ({"place_radius": 5.0}, "--place-radius: found 5.0 for a map without positions"),
        ({"most_lost": 1.5}, "--most-lost: found 1.5, expected 0 to 1"),
        ({"inside": True}, "found in the map"),
        ({"place_frames": 1}, "--place-frames: found 1, expected at least 2"),
        ({"one": "Aston", "place_frames": 12}, "found images of 1 place, expected several"),
        ({"place_frames": 3, "watch": ["nowhere"]}, "nowhere"),
    ],
)
def test_what_cannot_be_adapted_is_refused(folder, tmp_path, given, words) -> None:
    given = dict(given)
    config = given.pop("config", CONFIG)
    if given.get("weights"):
        given["weights"] = tmp_path / "other.safetensors"
        save_weights(given["weights"], OTHER)
    if one := given.pop("one", None):
        folder, file = tmp_path / "one", tmp_path / "map" / "map.json"
        weights = json.loads(file.read_text())["weights"]
        index(load(weights), tmp_path / "images" / one, folder, weights=weights, reading=QUIET)
    if gone := given.pop("gone", None):
        shutil.rmtree(tmp_path / "images" / gone)
    out = (folder if given.pop("inside", False) else tmp_path) / "out"
    with pytest.raises(InputError, match=words):
        adapt(config, folder, out, **given, reading=QUIET)
    assert not out.exists()


def test_the_command(folder, tmp_path, capsys) -> None:
    call = ["adapt", "--map", str(folder), "--out", str(tmp_path / "out"), "--quiet", "--epochs"]
    call += ["1", "--places-per-batch", "2", "--optimiser.learning-rate", "1e-12"]
    assert main([*call, "--place-frames", "3", "--json", str(tmp_path / "found.json")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "images held out" in said
    assert "no better after" in said
    assert json.loads((tmp_path / "found.json").read_text())["weights"] is None
    assert main([*call, "--place-frames", "0"]) == 2
    assert "--place-frames: found 0" in capsys.readouterr().err


@pytest.fixture
def placed(shared, tmp_path) -> pathlib.Path:
    """A map in float16 of two folders, with positions, and a search that is approximate."""
    weights = shared / "weights.safetensors"
    for number, city in enumerate(("Aston", "Brill")):
        images = shutil.copytree(shared / "city" / "Images" / city, tmp_path / city)
        names = [path.name for path in sorted(images.iterdir())]
        of = {name: (float(i), 100.0 * number) for i, name in enumerate(names)}
        given = {"weights": weights, "positions": Positions(AXES[0], of), "dtype": "float16"}
        search = "hnsw" if number else None
        index(load(weights), images, tmp_path / "map", **given, search=search, reading=QUIET)
    return tmp_path / "map"


def test_a_map_is_made_anew_with_all_that_it_had(placed, tmp_path) -> None:
    weights = tmp_path / "other.safetensors"
    save_weights(weights, OTHER)
    with Map.open(placed) as places:
        images, kind = list(places.images), places.search_kind
        days = [part.added for part in places.images.parts]
    (tmp_path / ".map.remake").mkdir()  # of a call that was killed
    before = sorted(path.name for path in tmp_path.iterdir())
    assert remake_map(placed, OTHER, weights=weights, reading=QUIET) == 24
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({*before} - {".map.remake"})
    with Map.open(placed) as places:
        assert list(places.images) == images
        assert [part.added for part in places.images.parts] == days
        assert (places.search_kind, places.metadata.dtype) == (kind, "float16")
        assert places.metadata.model == model_hash(*OTHER)
        found = places.descriptors_of([image.name for image in images])
    paths = [pathlib.Path(image.root) / image.name for image in images]
    _, expected, _ = extract(OTHER, paths, tmp_path / "d.npy", reading=QUIET)
    # Half a unit of float16 in the last place, of numbers up to 1.
    np.testing.assert_allclose(found, expected, atol=2**-11)


def test_an_open_map_never_searches_the_descriptors_of_a_remade_one(
    placed, tmp_path, monkeypatch
) -> None:
    """In blocks, whose files are opened for each search, not in a single one held in memory."""
    monkeypatch.setattr(file_store, "_BLOCK", 1)
    weights = tmp_path / "other.safetensors"
    save_weights(weights, OTHER)
    with Map.open(placed, calibrated=False) as places:
        query = np.eye(1, places.metadata.descriptor_length, dtype=np.float32)
        places.search(query, 1, exact=True)
        remake_map(placed, OTHER, weights=weights, reading=QUIET)
        with pytest.raises(InputError, match="the map was replaced since it was opened"):
            places.search(query, 1, exact=True)


def test_a_map_stays_where_it_cannot_be_made_anew(placed, tmp_path, monkeypatch) -> None:
    weights = tmp_path / "other.safetensors"
    save_weights(weights, OTHER)
    path = tmp_path / "Aston" / sorted(os.listdir(tmp_path / "Aston"))[2]
    whole = path.read_bytes()
    digest = (placed / "map.json").read_bytes()
    before = sorted(each.name for each in tmp_path.iterdir())
    skip = dataclasses.replace(QUIET, on_bad_image="skip")

    def fails(words: str) -> None:
        with pytest.raises(InputError, match=words):
            remake_map(placed, OTHER, weights=weights, reading=skip)
        assert (placed / "map.json").read_bytes() == digest
        assert sorted(each.name for each in tmp_path.iterdir()) == before

    path.write_bytes(b"x" * len(whole))
    fails(path.name)
    path.write_bytes(whole[:-1])
    fails(f"{path.name}: found {len(whole) - 1} bytes, expected the image of {len(whole)}")
    path.write_bytes(whole)
    (placed / "added").mkdir()
    fails("found added in the folder")
    (placed / "added").rmdir()
    for call, why in ((None, "no renameat2"), (lambda *_: -1, "")):
        monkeypatch.setattr(files, "_renameat2", lambda call=call: call)
        fails(f"could not exchange it with .*{why}")
    monkeypatch.undo()
    with (
        open_for_appending(placed, existing_metadata(placed)),
        pytest.raises(InputError, match="another process that writes"),
    ):
        remake_map(placed, OTHER, weights=weights, reading=QUIET)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"store": "milvus:a.db"}, "descriptors in milvus:a.db"), ({"pca": "abc"}, "components")],
)
def test_a_map_of_another_kind_is_refused(folder, monkeypatch, change, words) -> None:
    metadata = dataclasses.replace(check_remakeable(folder), **change)
    monkeypatch.setattr(remake, "existing_metadata", lambda _: metadata)
    with pytest.raises(InputError, match=words):
        check_remakeable(folder)


def test_more_images_are_those_of_the_map_once(placed, tmp_path, monkeypatch) -> None:
    """Also by another name of their folder; with positions of the map's kind."""
    (tmp_path / "link").symlink_to(tmp_path / "Aston")
    (first, *_), (second, *_) = (sorted(os.listdir(tmp_path / city)) for city in ("Aston", "Brill"))
    shutil.copytree(tmp_path / "Brill", tmp_path / "more")
    with pytest.raises(InputError, match="more: found images without positions, expected east, no"):
        adapt(CONFIG, placed, tmp_path / "out", images=tmp_path / "more", reading=QUIET)
    for name, folder, picture in (("one", "link", first), ("two", "more", second)):
        table = tmp_path / folder / f"{name}.csv"
        table.write_text(f"name,east,north\n{picture},50,50\n")
    seen: list[Split] = []

    class Stop(Exception):
        pass

    def split(*arguments: object, **options: object) -> Split:
        seen.append(split_images(*arguments, **options))
        raise Stop

    monkeypatch.setattr(module, "split_images", split)
    tables = [tmp_path / "link" / "one.csv", tmp_path / "more" / "two.csv"]
    with pytest.raises(Stop):
        adapt(CONFIG, placed, tmp_path / "out", images=tables, reading=QUIET)
    source = seen[0].source
    assert len(source.names) == 25
    assert source.positions is not None
    assert source.positions.of[f"more/{second}"] == (50, 50)
    assert source.positions.of[f"Aston/{first}"] == (0, 0)
