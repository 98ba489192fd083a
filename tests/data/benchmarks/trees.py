"""Small evaluation sets on disk. Readers look at names alone, so the images are empty files."""

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.utils.errors import InputError


def touch(path: Path) -> Path:
    touch_all(path.parent, [path.name])
    return path


def touch_all(folder: Path, names: Iterable[str]) -> Path:
    """Make empty files, which readers take for images, and return the folder."""
    names = list(names)
    for parent in {folder, *(folder / os.path.dirname(name) for name in names)}:
        parent.mkdir(parents=True, exist_ok=True)
    for name in names:
        # Thousands of them, in a third of pathlib's time.
        os.close(os.open(f"{folder}/{name}", os.O_CREAT))
    return folder


def write_sides(root: Path, database: Iterable[str], queries: Iterable[str]) -> Path:
    touch_all(root / "database", database)
    touch_all(root / "queries", queries)
    return root


@contextlib.contextmanager
def refused(words: str) -> Iterator[None]:
    """Expect an error for the user: one line with these words."""
    with pytest.raises(InputError, match=words) as caught:
        yield
    assert "\n" not in str(caught.value)


def utm_name(east: str, north: str, pano: str = "", note: str = "") -> str:
    """All fifteen fields, those without use empty."""
    return f"@{east}@{north}@@@@@{pano}@@@@@@@{note}@.jpg"


def write_utm(folder: Path, database: np.ndarray, queries: np.ndarray) -> None:
    sides = [
        [
            utm_name(f"{east:.2f}", f"{north:.2f}", f"{part}{number:04d}")
            for number, (east, north) in enumerate(np.reshape(points, (-1, 2)))
        ]
        for part, points in (("database", database), ("queries", queries))
    ]
    write_sides(folder, *sides)


def truth_rows(*rows: Sequence[object]) -> np.ndarray:
    """An array of objects, whatever they are."""
    truth = np.empty((len(rows), len(rows[0])), object)
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            truth[i, j] = value
    return truth


def ragged(*rows: object) -> np.ndarray:
    return truth_rows(*([row] for row in rows))[:, 0]


def write_vpr_bench(root: Path, truth: object, references: int = 4, queries: int = 3) -> Path:
    touch_all(root / "ref", (f"{i:07d}.jpg" for i in range(references)))
    touch_all(root / "query", (f"{i:07d}.jpg" for i in range(queries)))
    np.save(root / "ground_truth_new.npy", np.asarray(truth), allow_pickle=True)
    return root


def every_tenth(queries: int, database: int) -> list[list[int]]:
    """The matches of Nordland*, written out: 0 has no frame before it."""
    matches = [[0, 1]]
    while len(matches) < queries:
        centre = 10 * len(matches)
        matches.append([i for i in (centre - 1, centre, centre + 1) if i < database])
    return matches


def lists_of(positives: Iterable[np.ndarray] | None) -> list[list[int]]:
    assert positives is not None
    found = list(positives)
    assert all(array.dtype == np.int64 for array in found)
    return [array.tolist() for array in found]
