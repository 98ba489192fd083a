"""Keyframes: which images a map takes, again after kills, and that nothing is described twice."""

import math
import pathlib
from collections.abc import Sequence

import cv2
import numpy as np
import pytest

import crisalad_jax.retrieval.maps.build
import crisalad_jax.retrieval.maps.novelty
from crisalad_jax.data.positions import Positions
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import Reading
from crisalad_jax.retrieval.maps.appending import AppendableMap
from crisalad_jax.retrieval.maps.build import Indexed, index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.novelty import SIMILAR
from tests.conftest import MODEL
from tests.data.bags import BEGIN, SECOND, image, pose, write_bag
from tests.data.benchmarks.trees import refused

DEGREES = [
    0,
    4,
    8,
    12,
    14,
    30,
    30,
    30,
    41,
    40,
    39,
    52,
    52,
    52,
    0,
    3,
    20,
    21,
    22,
    23,
    90,
    90,
    90,
    90,
]
LEAST = 10.0
"""An image is new from there on, in degrees between two descriptors."""
NOVELTY = math.cos(math.radians(LEAST - 0.25))  # between two whole degrees


class Compass:
    """A describer whose descriptor of a grey image points at its level, in degrees."""

    config = MODEL
    preparation = Preparation.of(MODEL)
    digest = "0" * 64
    row_length = 1
    row_dtype = "float32"

    def __init__(self) -> None:
        self.described: list[int] = []

    def tokens(self, batches):
        for batch in batches:
            rows = batch.images.mean(axis=(1, 2, 3), dtype=np.float64)[:, None]
            self.described += np.round(rows[batch.valid, 0]).astype(int).tolist()
            yield rows, batch

    def attend(self, rows, mask):
        angles = np.deg2rad(rows[..., 0])
        found = np.zeros((*angles.shape, MODEL.descriptor_dim), np.float32)
        found[..., 0], found[..., 1] = np.cos(angles), np.sin(angles)
        return found


def write(folder: pathlib.Path, degrees: Sequence[int]) -> pathlib.Path:
    """Two folders, each of which gets every second image."""
    for number, level in enumerate(degrees):
        path = folder / "ab"[number % 2] / f"{number:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((28, 28, 3), level, np.uint8))
    return folder


def by_hand(degrees: Sequence[int]) -> list[str]:
    """The names of the images that are taken, in the order of names."""
    taken = []
    for side in (0, 1):
        last = None
        for number in range(side, len(degrees), 2):
            if last is None or abs(degrees[number] - last) >= LEAST:
                last = degrees[number]
                taken.append(f"{'ab'[side]}/{number:03d}.png")
    return taken


def build(folder: pathlib.Path, images: pathlib.Path, describer=None, **options) -> Indexed:
    options = {"novelty": NOVELTY, "reading": Reading(batch_size=2, quiet=True)} | options
    return index(describer or Compass(), images, folder, weights="w.safetensors", **options)


def names(folder: pathlib.Path) -> list[str]:
    with Map.open(folder) as found:
        return [image.name for image in found.images]


pytestmark = pytest.mark.filterwarnings("ignore:.*a map describes images independently")


@pytest.fixture
def images(tmp_path, monkeypatch) -> pathlib.Path:
    monkeypatch.setattr(crisalad_jax.retrieval.maps.build, "SEGMENT", 4)
    return write(tmp_path / "images", DEGREES)


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_only_new_views_are_taken(images, tmp_path, dtype):
    expected = by_hand(DEGREES)
    assert 4 < len(expected) < len(DEGREES) - 4
    found = build(tmp_path / "map", images, dtype=dtype)
    assert names(tmp_path / "map") == expected
    counts = (found.added, found.similar, found.images)
    assert counts == (len(expected), len(DEGREES) - len(expected), len(expected))


def test_the_same_call_adds_and_describes_nothing(images, tmp_path):
    first, again = build(tmp_path / "map", images), Compass()
    second = build(tmp_path / "map", images, again)
    assert again.described == []
    assert (second.added, second.there) == (0, first.added)
    assert second.similar == first.similar
    # Records save work alone: without them the same images are left out.
    for path in (tmp_path / "map" / SIMILAR).iterdir():
        path.unlink()
    assert build(tmp_path / "map", images).added == 0
    # Another novelty is another choice, and images of another size are other images.
    assert build(tmp_path / "map", images, novelty=1.0).added > 0


def test_new_images_are_compared_with_the_last_that_the_map_took(images, tmp_path):
    """Appended day after day, the map is that of all days at once."""
    part = write(tmp_path / "part", DEGREES[:9])
    first, later = build(tmp_path / "map", part), Compass()
    build(tmp_path / "map", images, later)
    assert sorted(names(tmp_path / "map")) == sorted(by_hand(DEGREES))
    # Those of the part that were left out are of another folder, and are described once more.
    assert len(later.described) == len(DEGREES) - first.added


class Killed(BaseException):
    pass


@pytest.mark.parametrize("call", range(1, 12))
def test_after_a_kill_the_same_call_makes_the_same_map(images, tmp_path, monkeypatch, call):
    """Killed before or after each write of rows or of what is left out."""
    calls = 0

    def cut(real):
        def written(*given, **options):
            nonlocal calls
            calls += 1
            if calls == call:
                raise Killed
            real(*given, **options)
            calls += 1
            if calls == call:
                raise Killed

        return written

    with monkeypatch.context() as patch:
        for where, name in (
            (AppendableMap, "append"),
            (crisalad_jax.retrieval.maps.novelty.Novelty, "leave_out"),
        ):
            patch.setattr(where, name, cut(getattr(where, name)))
        with pytest.raises(Killed):
            build(tmp_path / "map", images)
    build(tmp_path / "map", images)
    assert names(tmp_path / "map") == by_hand(DEGREES)


def test_bits_are_compared_by_their_signs(images, tmp_path):
    """All descriptors here have the same signs: both numbers are above 0, or rounded to it."""
    found = build(tmp_path / "map", images, dtype="bits", novelty=0.99)
    assert found.added == 2


def test_distance_comes_first_and_gaps_are_counted(images, tmp_path):
    listed = sorted(path.relative_to(images).as_posix() for path in images.rglob("*.png"))
    positions = Positions(("x", "y"), {name: (float(name[2:5]), 0.0) for name in listed})
    given = {"positions": positions, "every_metres": 4.0}
    found = build(tmp_path / "map", images, **given)
    spaced = [name for name in listed if int(name[2:5]) % 4 == (name[0] == "b")]
    assert found.near == len(DEGREES) - len(spaced)
    assert (found.unmatched, found.added + found.similar) == ([], len(spaced))
    again = build(tmp_path / "map", images, **given)
    assert (again.added, again.near, again.similar) == (0, found.near, found.similar)
    with refused("novelty: found similarity 2, expected one from -1 to 1"):
        build(tmp_path / "map", images, novelty=2)


def test_a_log_by_distance(tmp_path):
    """A robot that stands for a second, then drives half a metre each fifth of a second."""
    step, easts = SECOND // 5, [0.0] * 5 + [0.5 * number for number in range(1, 8)]
    messages = [pose(BEGIN + number * step, east, 7.0) for number, east in enumerate(easts)]
    messages += [
        image(BEGIN + number * step, np.full((28, 28, 3), 10 * number, np.uint8))
        for number in range(len(easts))
    ]
    bag = write_bag(tmp_path / "walk.mcap", messages)
    given = {"every_metres": 1.0, "fps": 100.0, "novelty": None}
    found = build(tmp_path / "map", bag, **given)
    with Map.open(tmp_path / "map") as places:
        assert [image.position for image in places.images] == [(east, 7.0) for east in range(4)]
    assert (found.added, found.near) == (4, 8)
    assert build(tmp_path / "map", bag, **given).added == 0
