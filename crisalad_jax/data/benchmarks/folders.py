"""Two plain folders, `database/` and `queries/`, with tables of matches or positions, or none."""

import os
import pathlib
import re

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import DEFAULT_RADIUS, Benchmark, check_radius, within
from crisalad_jax.data.benchmarks.on_disk import find_split, list_part
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.positions import AXES, read_positions
from crisalad_jax.data.tables import matched, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float64, Int64

TRUTH = "ground_truth.csv"
_POSITIONS = "positions.csv"
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
    """Read `database/` and `queries/`, whose images may have any names.

    The ground truth is `ground_truth.csv` in the same folder, or `frames`, or the positions of a
    table, or there is none. The table of matches has lines of `query,database`, with paths
    relative to the two folders: one line for each match of a query, or the line `query,` for a
    query without a match. Every query has a line.

    Positions are in `positions.csv`, which names images by their path, as `database/1.jpg`; or in
    `database.csv` and `queries.csv`, which name them by their path in these folders. The columns
    are `name,east,north` or `name,lat,lon`; degrees are projected to UTM if all are of one zone,
    else they become points on the ellipsoid (`metres.comparable`).

    Args:
        root: the folder that holds the two, or one with `images/{test,val,train}` that do.
        split: None takes `test`, else `val`.
        radius: where positions are the ground truth, metres within which an image is a positive,
            inclusive; None is 25.
        frames: the i-th query matches the database images i - frames to i + frames, where both
            folders hold a frame of the same moments. Frames are in the order of the numbers in
            their names, so that frame 10 follows frame 9.

    Raises:
        InputError: a folder is missing or without images; a table that names an image that is not
            there, leaves one out, or contradicts itself; a negative number of frames, folders of
            different counts, `frames` with a table, a radius without positions to measure, one
            side's table of positions without the other's, or what `read_positions` raises.
    """
    root = pathlib.Path(root)
    folder, name = find_split(root, split)
    database, queries = (list_part(folder / part) for part in ("database", "queries"))
    table = folder / TRUTH
    if frames is not None:
        if radius is not None or table.exists():
            given = "a radius" if radius is not None else table
            raise InputError(f"frames: found {frames} and {given}, expected one of the two")
        return _by_frames(root, name, database, queries, frames)
    places, asked = _read_positions(folder, database, queries)
    if radius is not None and (table.exists() or places is None):
        has = table if table.exists() else f"{root}, which has no positions ({_POSITIONS})"
        raise InputError(
            f"radius: found {radius:g} with {has}, expected it where positions are the ground truth"
        )
    radius = DEFAULT_RADIUS if radius is None else radius
    check_radius(radius)
    if table.exists():
        positives = _by_table(table, _numbers(folder, database), _numbers(folder, queries))
        truth, rule = TRUTH, f"the database images that {TRUTH} lists"
    elif places is not None and asked is not None:
        positives = within(places, asked, radius)
        truth, rule = f"{radius:g} m", f"a distance of at most {radius:g} m"
    else:
        positives, truth, rule = None, "no ground truth", "none: there is no ground truth"
    name = f"{name} (two folders, {truth})"
    return Benchmark(name, root, database, queries, positives, rule, places, asked, radius)


def _by_frames(
    root: pathlib.Path, name: str, database: _Paths, queries: _Paths, frames: int
) -> Benchmark:
    if frames < 0:
        raise InputError(f"frames: found {frames}, expected a number from 0")
    if len(database) != len(queries):
        raise InputError(
            f"frames: found {len(database)} database images and {len(queries)} queries in {root}, "
            "expected as many: a frame matches those of the same moment"
        )
    count = len(queries)
    title, rule = f"{name} (two folders", f"at most {frames} frames apart"
    if (count, frames) == (3450, 2):
        title = "Nordland-test (SelaVPR: 3450 + 3450 images"
        rule += "; by its number of images it is SelaVPR's Nordland-test"
    return Benchmark(
        name=f"{title}, +-{frames} frame{'s' * (frames != 1)})",
        root=root,
        database=tuple(sorted(database, key=_in_numbers)),
        queries=tuple(sorted(queries, key=_in_numbers)),
        positives=tuple(
            np.arange(max(0, i - frames), min(count, i + frames + 1)) for i in range(count)
        ),
        rule=rule,
    )


def _in_numbers(path: pathlib.Path) -> list[str | int]:
    """Return a sort key that orders the numbers in a path by value. Its odd parts are numbers."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)]


def _numbers(folder: pathlib.Path, paths: _Paths) -> dict[str, int]:
    """Number the images by their path below `database/` or `queries/`."""
    depth = len(folder.parts) + 1
    return {"/".join(path.parts[depth:]): number for number, path in enumerate(paths)}


def _by_table(
    path: pathlib.Path, database: dict[str, int], queries: dict[str, int]
) -> tuple[Int64[np.ndarray, " _"], ...]:
    table = read_table(path)
    rows = [] if table.columns == _HEADER else [(1, table.columns)]
    rows += [(line, [field.strip() for field in fields]) for line, fields in table.lines]
    lines = rows if len(table.columns) == 2 else []
    asked = matched((query for _, (query, _) in lines), queries)
    there = matched((match for _, (_, match) in lines), database)
    matches: dict[str, set[int]] = {}
    for line, (query, match) in lines:
        for side, name, known in (("queries", query, asked), ("database", match, there)):
            if name not in known and (name or side == "queries"):
                raise InputError(
                    f"{path}: line {line}: found {name!r}, expected the path of an image below "
                    f"{path.parent / side}"
                )
        found = matches.setdefault(asked[query], set())
        found.add(database[there[match]] if match else _NO_MATCH)
        if _NO_MATCH in found and len(found) > 1:
            raise InputError(
                f"{path}: line {line}: found {query!r} with a match and without, expected either"
            )
    missing = queries.keys() - matches.keys()
    if missing:
        raise InputError(
            f"{path}: found {len(missing)} of {len(queries)} queries without a line query,database"
            f", expected all ('{min(missing)},' where there is no match)"
        )
    return tuple(np.array(sorted(matches[query] - {_NO_MATCH}), np.int64) for query in queries)


def _read_positions(
    folder: pathlib.Path, database: _Paths, queries: _Paths
) -> tuple[Float64[np.ndarray, "images axis"], Float64[np.ndarray, "q axis"]] | tuple[None, None]:
    """Read where the images of two folders were taken, as points whose distances are metres."""
    both, sides = folder / _POSITIONS, [folder / "database.csv", folder / "queries.csv"]
    there = [table for table in (both, *sides) if table.exists()]
    if not there:
        return None, None
    if there not in ([both], sides):
        raise InputError(
            f"{folder}: found {', '.join(table.name for table in there)}, expected {_POSITIONS}, "
            "or database.csv and queries.csv"
        )
    tables = [read_positions(table) for table in there]
    if len({table.axes for table in tables}) > 1:
        raise InputError(
            f"{there[0]}: found lat,lon in one table and east,north in the other, expected the same"
        )
    found = []
    for number, images in enumerate((database, queries)):
        table, root = (number, folder / sides[number].stem) if there == sides else (0, folder)
        names = ["/".join(image.parts[len(root.parts) :]) for image in images]
        of = tables[table].of
        lines = matched(names, of)
        missing = [name for name in names if name not in lines]
        if missing:
            raise InputError(
                f"{there[table]}: found {len(missing)} of {len(names)} images of "
                f"{sides[number].stem} without a line, expected all; the first is {missing[0]}"
            )
        found.append(np.array([of[lines[name]] for name in names], np.float64))
    if tables[0].axes == AXES[1]:
        found = np.split(comparable(*np.concatenate(found).T), [len(found[0])])
    return found[0], found[1]
