"""@UTM names: positives against brute force, and the sets whose coordinates are placeholders."""

from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import read_utm
from tests.data.benchmarks.trees import (
    lists_of,
    refused,
    touch,
    utm_name,
    write_sides,
    write_utm,
)


def coordinates(paths) -> np.ndarray:
    return np.array([[float(text) for text in path.name.split("@")[1:3]] for path in paths])


@pytest.mark.parametrize("scale", [(200, 30), (30, 200), (0, 200)])
def test_utm_positives_equal_brute_force(tmp_path, scale):
    generator = np.random.default_rng(0)
    database = generator.integers(0, 100, (60, 2)) / 100 * scale
    queries = generator.integers(0, 100, (25, 2)) / 100 * scale
    write_utm(tmp_path / "town" / "images" / "test", database, queries)
    benchmark = read_utm(tmp_path / "town", "test", radius=20.0)
    assert benchmark.name == "town/test (@UTM, 20 m)"
    assert "20 m" in benchmark.rule
    assert len(benchmark.database) == 60
    assert list(benchmark.database) == sorted(benchmark.database)
    there, here = coordinates(benchmark.database), coordinates(benchmark.queries)
    sizes = set()
    for query, positives in zip(here, benchmark.positives, strict=True):
        expected = [i for i in range(60) if ((there[i] - query) ** 2).sum() <= 20 * 20]
        assert positives.tolist() == expected
        sizes.add(len(expected))
    assert len(sizes) > 2
    np.testing.assert_array_equal(benchmark.database_positions, there)
    np.testing.assert_array_equal(benchmark.query_positions, here)


def test_utm_finds_its_split(tmp_path):
    root = tmp_path / "town"
    point = np.zeros((1, 2))
    write_utm(root / "images" / "train", point, point)
    with refused(r"splits train, expected images/test"):
        read_utm(root)
    write_utm(root / "images" / "val", point, point)
    assert read_utm(root).name == "town/val (@UTM, 25 m)"
    write_utm(root / "images" / "test", point, point)
    assert read_utm(root).name == "town/test (@UTM, 25 m)"
    assert read_utm(root, "train").name == "town/train (@UTM, 25 m)"
    assert read_utm(root / "images" / "val", radius=7.5).name == "town/val (@UTM, 7.5 m)"
    with refused(r"splits test, val, train, expected images/night"):
        read_utm(root, "night")


def test_utm_bad_folders(tmp_path):
    touch(tmp_path / "images" / "test" / "database" / utm_name("1", "2"))
    with refused("found database/, expected a folder queries"):
        read_utm(tmp_path)


@pytest.mark.parametrize("name", ["street.jpg", "@12.5@.jpg", "@east@2@.jpg", "@1@nan@.jpg"])
def test_utm_names_the_file_without_coordinates(tmp_path, name):
    write_utm(tmp_path, np.zeros((1, 2)), np.zeros((1, 2)))
    touch(tmp_path / "queries" / name)
    with refused(f"queries/{name}: found no coordinates"):
        read_utm(tmp_path)


def cut_decimal(value: float) -> str:
    """As VPR-datasets-downloader writes the northings of Nordland: 00023.8 for 23.8095."""
    whole, _, decimals = f"{value:.9f}".partition(".")
    return f"{int(whole):05d}.{decimals[0]}"


def write_nordland(root: Path, metres: float, database: int, every: int = 1) -> Path:
    names = [utm_name("0", cut_decimal(i * metres), str(i)) for i in range(database)]
    write_sides(root / "images" / "test", names, names[::every])
    return root


def frame(path: Path) -> int:
    return int(path.name.split("@")[7])


@pytest.mark.parametrize(
    ("metres", "radius", "frames", "name"),
    [
        (25 / 10.5, 25, 10, "Nordland, Patch-NetVLAD split (summer database, winter queries)"),
        (25 / 10.5, 5 * 25 / 10.5, 5, "Nordland, Patch-NetVLAD split (summer database,"),
        (25 / 1.5, 25, 1, "Nordland subset of VPR-datasets-downloader (summer database, winter"),
    ],
)
def test_nordland_of_the_downloader(tmp_path, metres, radius, frames, name):
    benchmark = read_utm(write_nordland(tmp_path / "any", metres, 400, every=7), radius=radius)
    assert benchmark.name.startswith(name)
    assert benchmark.name.endswith(f", +-{frames} frame{'s' * (frames > 1)}")
    assert benchmark.rule.startswith(f"at most {frames} frame")
    assert "by eastings of 0 and northings" in benchmark.rule
    assert [frame(path) for path in benchmark.queries] == list(range(0, 400, 7))
    for path, positives in zip(benchmark.queries, benchmark.ground_truth(), strict=True):
        expected = [i for i in range(400) if abs(i - frame(path)) <= frames]
        assert [frame(benchmark.database[i]) for i in positives] == expected
    assert benchmark.database_positions is None
    assert benchmark.query_positions is None


def test_frames_with_a_gap_are_not_called_nordland(tmp_path):
    root = write_nordland(tmp_path / "line", 25 / 10.5, 50)
    (root / "images" / "test" / "database" / utm_name("0", "00047.6", "20")).unlink()
    assert read_utm(root).name == "line/test (@UTM, 25 m)"


@pytest.mark.parametrize(
    ("count", "name"), [(607, "SPED"), (1231, "AmsterTime"), (5, "any/test"), (606, "any/test")]
)
def test_places_without_coordinates(tmp_path, count, name):
    ids = np.random.default_rng(0).permutation(2000)[:count]
    names = [utm_name("0", str(1000 * i), f"{i:07d}") for i in ids]
    write_sides(tmp_path / "any" / "images" / "test", names, names)
    benchmark = read_utm(tmp_path / "any")
    assert benchmark.name == (f"{name} (@UTM placeholders 1 km apart: a place matches itself only)")
    assert (f"by its {count} places as {name}" in benchmark.rule) == (count in (607, 1231))
    for path, positives in zip(benchmark.queries, benchmark.ground_truth(), strict=True):
        assert [benchmark.database[i].name for i in positives] == [path.name]
    assert benchmark.database_positions is None
    # At a kilometre they would match each other: then they are coordinates like any.
    assert read_utm(tmp_path / "any", radius=1000).name == "any/test (@UTM, 1000 m)"


def write_msls(root: Path, notes: list[str]) -> Path:
    names = [
        utm_name(f"{350000 + 40 * i:010.2f}", "6170000.00", str(i), note)
        for i, note in enumerate(notes)
    ]
    write_sides(root / "images" / "val", names, names)
    return root


@pytest.mark.parametrize(
    ("notes", "name"),
    [
        (
            ["day_forward_cph", "night_sideways_sf", "day_backward_sf"],
            "MSLS val, downloader style, 3 queries, 25 m",
        ),
        (["day_forward_sf"] * 2, "MSLS of sf, downloader style, 2 queries, 25 m"),
        (["day_forward_goa", "day_forward_sf"], "MSLS of goa, sf, downloader style, 2 queries"),
        (["day_forward_cph", "", "day_forward_sf"], "any/val (@UTM, 25 m)"),
    ],
)
def test_msls_of_the_downloader_is_told_by_its_notes(tmp_path, notes, name):
    benchmark = read_utm(write_msls(tmp_path / "any", notes))
    assert benchmark.name.startswith(name)
    assert ("by the notes in the names as MSLS" in benchmark.rule) == name.startswith("MSLS")
    assert lists_of(benchmark.positives) == [[i] for i in range(len(notes))]
    assert benchmark.database_positions is not None
