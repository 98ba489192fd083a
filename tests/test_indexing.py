"""Images into maps: each described alone, in any portions the same."""

import pathlib
import shutil

import numpy as np
import pytest

import crisalad_jax.indexing
from crisalad_jax.data.images import list_images
from crisalad_jax.data.positions import utm_positions
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import group, read_tokens
from crisalad_jax.indexing import Indexed, describe_alone, index_images
from crisalad_jax.map_description import describe_map
from crisalad_jax.maps import Map, open_for_appending, open_map
from tests.conftest import BATCH, MODEL


@pytest.fixture
def database(town) -> pathlib.Path:
    return town / "images" / "test" / "database"


def index(folder: pathlib.Path, params, images: pathlib.Path, paths=None, **more) -> Indexed:
    description = describe_map(params, MODEL, folder / "weights", folder)
    with open_map_or_new(folder, description) as target:
        paths = list_images(images) if paths is None else paths
        where = utm_positions([path.name for path in paths])
        return index_images(
            target,
            params,
            images,
            paths,
            positions=where,
            **({"batch_size": BATCH, "quiet": True} | more),
        )


def open_map_or_new(folder: pathlib.Path, description):
    if (folder / "map.json").exists():
        with open_map(folder) as found:
            description = found.description
    return open_for_appending(folder, description)


def descriptors_of(target: Map) -> np.ndarray:
    return np.concatenate(list(target.descriptors))


def test_each_image_is_described_alone(params, database):
    paths = list_images(database)
    assert len(paths) % BATCH
    parts = list(describe_alone(params, MODEL, paths, batch_size=BATCH))
    assert [part.indices.tolist() for part in parts] == [[0, 1, 2, 3], [4, 5, 6]]
    found = np.concatenate([part.descriptors for part in parts])
    # Which test_evaluation compares with batches of one.
    tokens = read_tokens(params, MODEL, paths, batch_size=BATCH, label="", quiet=True)
    expected = group(params, MODEL, tokens, "single", batch_size=BATCH)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("segment", [1, 256])
def test_appended_in_portions_or_at_once_the_bits_are_the_same(
    params, database, tmp_path, monkeypatch, segment
):
    monkeypatch.setattr(crisalad_jax.indexing, "SEGMENT", segment)
    paths = list_images(database)
    whole = index(tmp_path / "whole", params, database)
    assert whole == Indexed(added=7, there=0, positions=7, stay=0, unreadable=[])
    for stop in (3, 4, 7):
        portion = index(tmp_path / "parts", params, database, paths[:stop])
    assert portion == Indexed(added=3, there=4, positions=3, stay=4, unreadable=[])
    segments = {1: 2, 256: 1}[segment]
    assert len(list((tmp_path / "whole" / "segments").glob("*.npy"))) == segments
    with open_map(tmp_path / "whole") as one, open_map(tmp_path / "parts") as other:
        np.testing.assert_array_equal(descriptors_of(one), descriptors_of(other))
        assert one.images == other.images
        assert [image.name for image in one.images] == [path.name for path in paths]
        assert [image.position for image in one.images[:2]] == [(0.0, 5e6), (40.0, 5e6)]


def test_an_unreadable_image_ends_it_or_is_left_out(params, database, tmp_path):
    paths = list_images(database)
    paths[5].write_bytes(b"no image")
    with pytest.raises(InputError, match=f"{paths[5].name}: found 8 bytes that do not decode"):
        index(tmp_path / "stopped", params, database)
    result = index(tmp_path / "map", params, database, on_bad_image="skip")
    assert result == Indexed(added=6, there=0, positions=6, stay=0, unreadable=[paths[5].name])
    with open_map(tmp_path / "map") as found:
        assert len(found) == 6
        assert found.image(paths[5].name) is None
    assert index(tmp_path / "map", params, database, on_bad_image="skip").there == 6


def test_another_picture_by_the_same_name_is_refused_before_any_work(params, database, tmp_path):
    index(tmp_path / "map", params, database)
    moved = tmp_path / "moved"
    shutil.copytree(database, moved)
    assert index(tmp_path / "map", params, moved).there == 7
    changed = list_images(moved)[3]
    changed.write_bytes(changed.read_bytes() + b"more")
    with pytest.raises(InputError, match=rf"{changed.name}: found \d+ bytes, but the map has"):
        index(tmp_path / "map", params, moved)
