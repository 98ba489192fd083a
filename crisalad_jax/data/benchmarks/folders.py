"""Two plain folders, `database/` and `queries/`, with tables of matches or positions, or none."""

import csv
import os
import pathlib
import re
from collections.abc import Iterator

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders_on_disk import find_split, list_part
from crisalad_jax.data.benchmarks.ground_truth import DEFAULT_RADIUS, check_radius, within
from crisalad_jax.data.benchmarks.tables_of_positions import positions_beside
from crisalad_jax.data.names import matched
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source
from crisalad_jax.utils.shapes import Int64

TRUTH = "ground_truth.csv"
_HEADER = ["query", "database"]


def read_folders(
    root: str | os.PathLike[str],
    split: str | None = None,
    radius: float | None = None,
    *,
    frames: int | None = None,
) -> Benchmark:
    """Read `database/` and `queries/`, whose images may have any names.

    The ground truth is `ground_truth.csv` beside the folders, or `frames`, or the positions of a
    table (`positions_beside`), or there is none. The table of matches has lines of
    `query,database`, with paths relative to the two folders: one line for each match of a query, or
    the line `query,` for a query without a match. Every query has a line.

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
            different counts, `frames` beside a table, a radius without positions to measure, or
            what `positions_beside` raises.
    """
    root = pathlib.Path(root)
    folder, name = find_split(root, split)
    database, queries = (list_part(folder / part) for part in ("database", "queries"))
    table = folder / TRUTH
    if frames is not None:
        if table.exists():
            raise InputError(f"frames: found {frames} beside {table}, expected one of the two")
        _refuse_radius(radius, "frames")
        return _by_frames(root, name, database, queries, frames)
    places, asked = positions_beside(folder, database, queries)
    if table.exists():
        _refuse_radius(radius, table)
        positives = _by_table(table, _numbers(folder, database), _numbers(folder, queries))
        name, rule = f"{name} (two folders, {TRUTH})", f"the database images that {TRUTH} lists"
    elif places is not None and asked is not None:
        radius = DEFAULT_RADIUS if radius is None else radius
        check_radius(radius)
        positives = within(places, asked, radius)
        name, rule = f"{name} (two folders, {radius:g} m)", f"a distance of at most {radius:g} m"
    else:
        _refuse_radius(radius, f"{root}, which has no positions (positions.csv)")
        positives = None
        name, rule = f"{name} (two folders, no ground truth)", "none: there is no ground truth"
    radius = DEFAULT_RADIUS if radius is None else radius
    return Benchmark(name, root, database, queries, positives, rule, places, asked, radius)


def _refuse_radius(radius: float | None, what: object) -> None:
    if radius is not None:
        raise InputError(
            f"radius: found {radius:g} beside {what}, expected it where positions are the ground "
            "truth"
        )


def _by_frames(
    root: pathlib.Path,
    name: str,
    database: tuple[pathlib.Path, ...],
    queries: tuple[pathlib.Path, ...],
    frames: int,
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


def _numbers(folder: pathlib.Path, paths: tuple[pathlib.Path, ...]) -> dict[str, int]:
    """Number the images by their path below `database/` or `queries/`."""
    depth = len(folder.parts) + 1
    return {"/".join(path.parts[depth:]): number for number, path in enumerate(paths)}


def _by_table(
    table: pathlib.Path, database: dict[str, int], queries: dict[str, int]
) -> tuple[Int64[np.ndarray, " _"], ...]:
    matches: dict[str, set[int]] = {}
    without: set[str] = set()
    rows = list(_rows(table))
    asked = matched((query for _, query, _ in rows), queries)
    there = matched((match for _, _, match in rows), database)
    for line, query, match in rows:
        for side, name, names in (("query", query, asked), ("database", match, there)):
            if name not in names and (name or side == "query"):
                folder = "queries" if side == "query" else "database"
                raise InputError(
                    f"{table}: line {line}: found {side} {name!r}, expected the path of an image "
                    f"below {table.parent / folder}"
                )
        query = asked[query]
        matches.setdefault(query, set())
        if match:
            matches[query].add(database[there[match]])
        else:
            without.add(query)
        if query in without and matches[query]:
            raise InputError(
                f"{table}: line {line}: found {query!r} with a match and without, expected either"
            )
    missing = queries.keys() - matches.keys()
    if missing:
        raise InputError(
            f"{table}: found {len(missing)} of {len(queries)} queries without a line, expected all "
            f"('{min(missing)},' where there is no match)"
        )
    return tuple(np.array(sorted(matches[query]), np.int64) for query in queries)


def _rows(table: pathlib.Path) -> Iterator[tuple[int, str, str]]:
    """Yield the line number, query and match of every row that is not blank."""
    check_source(table, "a table of UTF-8 CSV", largest=LARGEST)
    try:
        # utf-8-sig: a spreadsheet's byte order mark would spoil the first name.
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            for number, row in enumerate(reader):
                row = [field.strip() for field in row]
                if not row or (number == 0 and row == _HEADER):
                    continue
                if len(row) != 2:
                    raise InputError(
                        f"{table}: line {reader.line_num}: found {len(row)} fields, expected "
                        "query,database"
                    )
                yield reader.line_num, row[0], row[1]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{table}: cannot be read as UTF-8 CSV: {error}") from error
