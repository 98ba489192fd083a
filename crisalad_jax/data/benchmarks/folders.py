"""Read the folders `database/` and `queries/`, and a table of matches or positions if any."""

import os
import pathlib
import re

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import DEFAULT_RADIUS, Benchmark, within
from crisalad_jax.data.benchmarks.on_disk import find_split, list_part
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.positions import AXES, positions_of
from crisalad_jax.data.tables import matched, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import counted
from crisalad_jax.utils.shapes import Float64, Int64

TRUTH = "ground_truth.csv"
_HEADER = ["query", "database"]
_NO_MATCH = -1
_Paths = tuple[pathlib.Path, ...]


def read_folders(
    root: str | os.PathLike[str],
    split: str | None = None,
    radius: float | None = None,
    *,
    frames: int | None = None,
) -> Benchmark:
    """Read an evaluation set from `database/` and `queries/`, whose images may have any names.

    The ground truth comes from `ground_truth.csv` next to the two folders, from `frames`, or from
    positions; otherwise the set has none. `ground_truth.csv` has lines `query,database`, with paths
    relative to the two folders: one line for each match of a query, or the line `query,` for a
    query without a match. Every query has a line.

    Positions are in `positions.csv`, which names images by their path, such as `database/1.jpg`; or
    in `database.csv` and `queries.csv`, which name them by their path in these folders. The columns
    are `name,east,north`, `name,lat,lon` or `name,x,y`. Degrees are projected to UTM if all are in
    one zone, else they become points on the ellipsoid (`metres.comparable`).

    Args:
        root: the folder that holds the two folders, or that has them in `images/{test,val,train}`.
        split: the folder in `images/`; None takes `test` or, if there is no `test`, `val`.
        radius: if positions are the ground truth, metres within which an image is a positive,
            inclusive; None is 25.
        frames: the i-th query matches the database images i - frames to i + frames, for two drives
            whose i-th frames show the same place. Frames are sorted by the numbers in their names,
            so that frame 10 follows frame 9.

    Raises:
        InputError: a folder is missing or has no images; a table is not valid or omits an image;
            `ground_truth.csv` names a missing image or contradicts itself; two of this file,
            `frames` and `radius` are given; `frames` is negative, or given for folders of different
            sizes; `radius` is given without positions; or one folder lacks positions.
    """
    root = pathlib.Path(root)
    folder, name = find_split(root, split)
    database, queries = (list_part(folder / part) for part in ("database", "queries"))
    table = folder / TRUTH
    places, asked = _read_positions(folder, database, queries)
    given = {"--frames": frames is not None, TRUTH: table.exists(), "--radius": radius is not None}
    if sum(given.values()) > 1 or (radius is not None and places is None):
        raise InputError(
            f"{root}: found {' and '.join(each for each, is_given in given.items() if is_given)}, "
            f"expected one of --frames, {TRUTH}, and --radius with positions (positions.csv)"
        )
    if frames is not None:
        return _by_frames(root, name, database, queries, frames)
    radius = DEFAULT_RADIUS if radius is None else radius
    if table.exists():
        positives = _by_table(folder, database, queries)
        truth, rule = TRUTH, f"the database images that {TRUTH} lists"
    elif places is not None and asked is not None:
        positives = within(places, asked, radius)
        truth, rule = f"{radius:g} m", f"a distance of at most {radius:g} m"
    else:
        positives, truth, rule = None, "no ground truth", "none: no ground truth was found"
    name = f"{name} (two folders, {truth})"
    return Benchmark(name, root, database, queries, positives, rule, places, asked, radius)


def _by_frames(
    root: pathlib.Path, name: str, database: _Paths, queries: _Paths, frames: int
) -> Benchmark:
    if frames < 0 or len(database) != len(queries):
        raise InputError(
            f"{root}: found {frames} frames, {len(database)} database images and {len(queries)} "
            "queries, expected at least 0 frames, and the same number of images in both folders"
        )
    count, apart = len(queries), counted(frames, "frame")
    name, rule = f"{name} (two folders, +-{apart})", f"at most {frames} frames apart"
    if (count, frames) == (3450, 2):
        name = "Nordland-test (SelaVPR: 3450 + 3450 images, +-2 frames)"
        rule += "; identified by its number of images as SelaVPR's Nordland-test"
    database, queries = (tuple(sorted(side, key=_in_numbers)) for side in (database, queries))
    windows = (range(max(0, i - frames), min(count, i + frames + 1)) for i in range(count))
    positives = tuple(np.array(window, np.int64) for window in windows)
    return Benchmark(name, root, database, queries, positives, rule)


def _in_numbers(path: pathlib.Path) -> list[str | int]:
    """Return a sort key that orders the numbers in a path by value; its odd items are numbers."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)]


def _names(folder: pathlib.Path, paths: _Paths) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in paths]


def _by_table(
    folder: pathlib.Path, database: _Paths, queries: _Paths
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Read the matches of each query from a table, which may have a header."""
    path = folder / TRUTH
    table = read_table(path)
    rows = [] if table.columns == _HEADER else [(1, table.columns)]
    rows += [(line, [field.strip() for field in fields]) for line, fields in table.lines]
    number = {name: image for image, name in enumerate(_names(folder / "database", database))}
    number[""] = _NO_MATCH
    matches: dict[str, set[int]] = {name: set() for name in _names(folder / "queries", queries)}
    asked = matched((fields[0] for _, fields in rows if fields), matches)
    there = matched((fields[-1] for _, fields in rows if fields), number)
    for line, fields in rows:
        if len(fields) != 2 or fields[0] not in asked or fields[1] not in there:
            raise InputError(
                f"{path}: line {line}: found {','.join(map(repr, fields))}, expected query,database"
                ": the paths of images below queries/ and database/"
            )
        matches[asked[fields[0]]].add(number[there[fields[1]]])
    wrong = [name for name, of in matches.items() if not of or (_NO_MATCH in of and len(of) > 1)]
    if wrong:
        raise InputError(
            f"{path}: found {len(wrong)} of {len(matches)} queries without a line, or with matches "
            f"and a line for none, expected either; the first is {wrong[0]} (the line "
            f"'{wrong[0]},' means no match)"
        )
    return tuple(np.array(sorted(of - {_NO_MATCH}), np.int64) for of in matches.values())


def _read_positions(
    folder: pathlib.Path, database: _Paths, queries: _Paths
) -> tuple[Float64[np.ndarray, "images axis"], Float64[np.ndarray, "q axis"]] | tuple[None, None]:
    """Read where the images of two folders were taken, as points whose distances are metres."""
    both = folder / "positions.csv"
    sides = [(both, folder, database), (both, folder, queries)]
    if not both.exists():
        sides = [
            (folder / "database.csv", folder / "database", database),
            (folder / "queries.csv", folder / "queries", queries),
        ]
    if not any(table.exists() for table, _, _ in sides):
        return None, None
    found, points = [], []
    for table, names_from, images in sides:
        names = _names(names_from, images)
        positions = positions_of(table, names, images, folder)
        found.append(positions)
        missing = [name for name in names if name not in positions.of]
        if missing or positions.axes != found[0].axes:
            raise InputError(
                f"{table}: found columns {','.join(positions.axes)}, and {len(missing)} of "
                f"{len(names)} images without a line ({''.join(missing[:1])}), expected "
                f"{','.join(found[0].axes)}, and all images"
            )
        points.append(np.array([positions.of[name] for name in names], np.float64))
    if found[0].axes == AXES[1]:
        points = np.split(comparable(*np.concatenate(points).T), [len(database)])
    return points[0], points[1]
