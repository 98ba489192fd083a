"""Images into maps: each described alone, in any portions the same."""

import dataclasses
import pathlib
import shutil
import warnings

import numpy as np
import pyproj
import pytest

import crisalad_jax.retrieval.maps.build
from crisalad_jax.data.images import list_images
from crisalad_jax.data.positions import Positions
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.build import Indexed
from crisalad_jax.retrieval.maps.build import index as index_source
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, read_options


@pytest.fixture
def database(town) -> pathlib.Path:
    return town / "images" / "test" / "database"


def index(folder: pathlib.Path, params, images: pathlib.Path, paths=(), **more) -> Indexed:
    """Index a folder of images, or those of its images that are listed."""
    if paths:
        listed = images / "list.txt"
        listed.write_text("".join(f"{path.name}\n" for path in paths))
        images = listed
    return index_source(Model(params, MODEL), images, folder, weights="w", **read_options(more))


def descriptors_of(target: Map) -> np.ndarray:
    return np.concatenate(list(target.descriptors))


@pytest.mark.parametrize("segment", [1, 256])
def test_appended_in_portions_or_at_once_the_bits_are_the_same(
    params, database, tmp_path, monkeypatch, segment
):
    monkeypatch.setattr(crisalad_jax.retrieval.maps.build, "SEGMENT", segment)
    paths = list_images(database)
    whole = index(tmp_path / "whole", params, database)
    assert whole[:5] == (7, 0, 7, 0, [])
    for stop in (3, 4, 7):
        portion = index(tmp_path / "parts", params, database, paths[:stop])
    assert portion[:5] == (3, 4, 3, 0, [])
    segments = {1: 2, 256: 1}[segment]
    assert len(list((tmp_path / "whole" / "segments").glob("*.npy"))) == segments
    with Map.open(tmp_path / "whole") as one, Map.open(tmp_path / "parts") as other:
        np.testing.assert_array_equal(descriptors_of(one), descriptors_of(other))
        assert list(one.images) == list(other.images)
        assert [image.name for image in one.images] == [path.name for path in paths]
        assert [image.position for image in one.images[:2]] == [(0.0, 5e6), (40.0, 5e6)]


def test_an_unreadable_image_ends_it_or_is_left_out(params, database, tmp_path):
    paths = list_images(database)
    paths[5].write_bytes(b"no image")
    with pytest.raises(InputError, match=f"{paths[5].name}: found 8 bytes that do not decode"):
        index(tmp_path / "stopped", params, database)
    result = index(tmp_path / "map", params, database, on_bad_image="skip")
    assert result[:5] == (6, 0, 6, 0, [paths[5].name])
    with Map.open(tmp_path / "map") as found:
        assert len(found) == 6
        assert found.image(paths[5].name) is None
    assert index(tmp_path / "map", params, database, on_bad_image="skip").there == 6


def test_a_missing_image_of_a_list_is_left_out(params, database, tmp_path, shared):
    """And one of the map's that is gone since then is there, as before."""
    names = [path.name for path in list_images(database)]
    table = database / "table.csv"
    table.write_text("name,x,y\n" + "".join(f"{name},1,2\n" for name in ["none.jpg", *names]))
    model, options = Model(params, MODEL), {"weights": shared / "weights.safetensors"}
    out = tmp_path / "map"
    with pytest.raises(InputError, match=r"table.csv: .*none.jpg: found no such file"):
        index_source(model, table, out, **options, **read_options({}))
    assert not out.exists()
    result = index_source(model, table, out, **options, **read_options({"on_bad_image": "skip"}))
    assert (result.added, result.positions, result.unreadable) == (7, 7, ["none.jpg"])
    (database / names[0]).unlink()
    result = index_source(model, table, out, **options, **read_options({"on_bad_image": "skip"}))
    assert (result.added, result.there, result.unreadable) == (0, 7, ["none.jpg"])


def test_another_picture_by_the_same_name_is_refused_before_any_work(params, database, tmp_path):
    index(tmp_path / "map", params, database)
    moved = tmp_path / "moved"
    shutil.copytree(database, moved)
    assert index(tmp_path / "map", params, moved).there == 7
    changed = list_images(moved)[3]
    changed.write_bytes(changed.read_bytes() + b"more")
    with pytest.raises(InputError, match=rf"{changed.name}: found \d+ bytes, but the map has"):
        index(tmp_path / "map", params, moved)


# Whole folders


def index_folder(folder: pathlib.Path, params, images: pathlib.Path, **options) -> Indexed:
    """`index` as Python users call it."""
    model = Model(params, options.pop("config", MODEL))
    options = {"weights": "w.safetensors"} | read_options(options)
    return crisalad_jax.retrieval.maps.build.index(model, images, folder, **options)


def test_a_folder_is_indexed_and_its_map_keeps_its_settings(params, database, tmp_path):
    """At another size than the model's, which belongs to the map from then on."""
    folder, other = tmp_path / "map", MODEL.resized((56, 56))
    paths = list_images(database)
    hidden = paths[-1].rename(tmp_path / paths[-1].name)
    first = index_folder(folder, params, database, config=other, dtype="float16")
    assert first[:5] == (6, 0, 6, 0, [])
    hidden.rename(paths[-1])
    second = index_folder(folder, params, database, config=other)
    assert (second.added, second.there, second.images) == (1, 6, 7)
    metadata = second.metadata
    assert (metadata.config["image_size"], metadata.dtype) == ([56, 56], "float16")
    assert (metadata.weights, metadata.store) == (
        str(pathlib.Path.cwd() / "w.safetensors"),
        "files",
    )
    for options, words in (
        ({"config": MODEL}, "found images at 42 x 56, .*, expected 56 x 56, .* as in the map"),
        (
            {"config": dataclasses.replace(other, compute_dtype="bfloat16")},
            "found compute dtype bfloat16, expected float32",
        ),
        ({"dtype": "float32"}, "found dtype float32, expected float16"),
        ({"store": "redis"}, "store: found 'redis', expected files or milvus:URI"),
    ):
        with pytest.raises(InputError, match=words):
            index_folder(folder, params, database, **{"config": other} | options)


def test_positions_given_in_python(params, database, tmp_path):
    """Of images that are there they stay; of none of them they are refused."""
    name = list_images(database)[0].name
    given = Positions(("lat", "lon"), {name: (1.0, 2.0), "other.jpg": (3.0, 4.0)})
    found = index_folder(tmp_path / "map", params, database, positions=given)
    assert (found.positions, found.unmatched, found.stay) == (1, ["other.jpg"], 0)
    assert index_folder(tmp_path / "map", params, database, positions=given).stay == 1
    strange = Positions(("lat", "lon"), {"other.jpg": (3.0, 4.0)})
    with pytest.raises(InputError, match="positions: found none of the 7 images of"):
        index_folder(tmp_path / "none", params, database, positions=strange)
    assert not (tmp_path / "none").exists()


def test_a_folder_of_unreadable_images_makes_no_map(params, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(b"none")
    with pytest.raises(InputError, match="found 1 images, none of them readable"):
        index_folder(tmp_path / "map", params, tmp_path / "images", on_bad_image="skip")
    assert not (tmp_path / "map").exists()


def test_a_new_map_of_a_model_that_attends_across_images_says_so(params, database, tmp_path):
    """Once: not where it grows, and not of a model that describes images alone."""

    def said(params, images: pathlib.Path, **options: object) -> int:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            index_folder(tmp_path / f"map{len(options)}", params, images, **options)
        words = (
            ": a map describes images independently, and this model attends across them: recalls"
        )
        return sum(words in str(each.message) for each in caught)

    first = list_images(database)[0]
    assert [said(params, images) for images in (first, database)] == [1, 0]
    alone = dataclasses.replace(params, cross_image=None)
    assert said(alone, first, config=dataclasses.replace(MODEL, cross_image="none")) == 0


@pytest.mark.filterwarnings("error:.* several zones")
def test_images_of_several_zones_make_a_map_of_degrees(params, database, tmp_path):
    """Zones 31 and 32 at their edge: both are near 48.85, 6.0, whatever their numbers."""
    names = ("@0719985.00@5415018.00@31@U@.png", "@0280015.00@5415018.00@32@U@.png")
    for name, path in zip(names, list_images(database), strict=False):
        (tmp_path / "images").mkdir(exist_ok=True)
        shutil.copy(path, tmp_path / "images" / name)
    with pytest.warns(UserWarning, match="of several zones of UTM: positions become lat, lon"):
        first = index_folder(tmp_path / "map", params, tmp_path / "images")
    assert (first.added, first.positions) == (2, 2)
    again = index_folder(tmp_path / "map", params, tmp_path / "images")
    assert (again.added, again.there) == (0, 2)
    with Map.open(tmp_path / "map") as places:
        assert places.axes == ("lat", "lon")
        for image in places.images:
            number = 31 if "@31@" in image.name else 32
            into = pyproj.Transformer.from_crs(f"EPSG:326{number}", "EPSG:4326")
            east, north = (float(field) for field in image.name.split("@")[1:3])
            # Rounded to 1e-9 degrees.
            np.testing.assert_allclose(image.position, into.transform(east, north), atol=2e-9)
