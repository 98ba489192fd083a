"""Tracks, keyframes and addresses on the command line: `index`, `query` and `extract`."""

import json

import fsspec
import numpy as np
import pytest
from PIL import Image

from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.maps.map import Map
from tests.cli.test_cli import fails, runs
from tests.cli.test_index import index, query
from tests.conftest import write_picture
from tests.data.test_tracks import POINTS, SECONDS, gpx


@pytest.fixture
def photos(tmp_path):
    """Photographs of a camera whose clock shows local time, every five seconds of the track."""
    folder = tmp_path / "photos"
    for number in range(13):
        path = folder / f"{number:02d}.jpg"
        write_picture(path, number)
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = f"2026:05:01 12:{number // 12:02d}:{5 * number % 60:02d}"
        with Image.open(path) as image:
            image.save(path, exif=exif)
    (tmp_path / "walk.gpx").write_text(gpx())
    return folder


def place(seconds: float) -> list[float]:
    return [float(np.interp(seconds, SECONDS, axis)) for axis in np.transpose(POINTS)]


def test_from_photographs_and_a_track_to_a_map_with_positions(shared, photos, tmp_path, capfd):
    given = index(shared, photos, tmp_path / "map", "--positions", tmp_path / "walk.gpx")
    fails(capfd, *given, words=("found a track from 2026-05-01T10:00:00Z", "--time-offset"))
    assert not (tmp_path / "map").exists()
    shift = ("--time-offset", -7200, "--every-metres", 50)
    said, notes = runs(capfd, *given, *shift, "--json", tmp_path / "done.json")
    assert "13 of 13 images on the track" in notes
    assert "the largest gap is 45 s, between 2026-05-01T10:00:15Z and 2026-05-01T10:01:00Z" in notes
    done = json.loads((tmp_path / "done.json").read_text())
    assert (done["added"] + done["near"], done["positions"]) == (13, done["added"])
    assert f"{done['near']} nearer than --every-metres left out" in said
    with Map.open(tmp_path / "map") as found:
        for image in found.images:
            # Longitudes are rounded to 1e-9 degrees, a tenth of a millimetre.
            assert image.position == pytest.approx(place(5 * int(image.name[:2])), abs=1e-9)
    said, _ = runs(capfd, *given, *shift)
    assert "0 images added" in said

    out = tmp_path / "some.npy"
    more = ("--positions", tmp_path / "walk.gpx", *shift, "--out", out, "--quiet")
    weights = ("--weights", shared / "weights.safetensors")
    runs(capfd, "extract", *weights, "--images", photos, *more)
    with Map.open(tmp_path / "map") as found:
        assert read_descriptors(out)[0] == [image.name for image in found.images]


def test_images_at_addresses_make_a_map_that_answers(shared, photos, tmp_path, capfd):
    files = fsspec.filesystem("memory")
    files.put(str(photos), "/town", recursive=True)
    try:
        said, _ = runs(capfd, *index(shared, "memory://town", tmp_path / "map"))
        assert "13 images added" in said
        with Map.open(tmp_path / "map") as found:
            assert {image.root for image in found.images} == {"memory://town"}
            assert [image.bytes for image in found.images] == [
                path.stat().st_size for path in sorted(photos.iterdir())
            ]
        said, _ = runs(capfd, *query(tmp_path / "map", "memory://town/07.jpg", "--k", 1))
        assert "07.jpg" in said.splitlines()[-1]
        assert "13 were there" in runs(capfd, *index(shared, "memory://town", tmp_path / "map"))[0]
    finally:
        files.rm("/town", recursive=True)


def test_flags_without_what_they_need(shared, photos, tmp_path, capfd):
    given = index(shared, photos, tmp_path / "map")
    fails(capfd, *given, "--time-offset", 1, words=("--time-offset: found without --positions",))
    fails(capfd, *given, "--start-time", "noon", words=("--start-time: found without",))
    fails(capfd, *given, "--every-metres", 1, words=("--every-metres: found no position of the",))
    more = ("--positions", tmp_path / "walk.gpx")
    fails(capfd, *given, *more, "--start-time", "noon", words=("--start-time: found 'noon'",))
    out = (
        "--weights",
        shared / "weights.safetensors",
        "--images",
        photos,
        "--out",
        tmp_path / "a.npy",
    )
    fails(capfd, "extract", *out, *more, words=("--positions: found without --every-metres",))
