"""VPR-Bench folders (Zaffar et al., IJCV 2021): `ref/`, `query/`, `ground_truth_new.npy`."""

import os
import pathlib

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders_on_disk import list_part
from crisalad_jax.data.benchmarks.ground_truth import indices, is_nordland_star, matches
from crisalad_jax.data.benchmarks.safe_npy import read_npy
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Int64

TRUTH = "ground_truth_new.npy"


def read_vpr_bench(root: str | os.PathLike[str]) -> Benchmark:
    """Read a VPR-Bench folder: `ref/`, `query/`, `ground_truth_new.npy`.

    The file holds one row for each query: its index and a list of reference indices, [-1] where
    there is no match. An index is a position among the images in the order of their numbers. No
    code in the file is run.

    The published lists of GardensPointWalking and 17places are windows of frames, and the last ones
    end after the last image. Such references are left out, and a note counts them.

    Raises:
        InputError: a folder or the file is missing, a number is skipped among the images' names,
            the file holds anything but plain arrays, lists and numbers, all references of a query
            are out of range, a query has no row or two.
    """
    root = pathlib.Path(root)
    database, queries = (_numbered(list_part(root / part)) for part in ("ref", "query"))
    path = root / TRUTH
    positives = _match(path, read_npy(path), len(database), len(queries))
    name, rule = f"{real_path(root).name} (VPR-Bench)", f"the reference images that {TRUTH} lists"
    if is_nordland_star(positives, len(database)):
        name = "Nordland*, winter database, summer queries (VPR-Bench)"
        rule += ", which are 10i - 1, 10i and 10i + 1 for query i: by that it is Nordland*"
    return Benchmark(name, root, database, queries, positives, rule)


def _numbered(paths: tuple[pathlib.Path, ...]) -> tuple[pathlib.Path, ...]:
    """Sort paths by number where all names are numbers: 10.jpg follows 9.jpg, not 1.jpg."""
    if not all(path.stem.isdecimal() for path in paths):
        return paths
    paths = tuple(sorted(paths, key=lambda path: int(path.stem)))
    first = int(paths[0].stem)
    for position, path in enumerate(paths):
        # A gap would silently shift every later position against the ground truth.
        if int(path.stem) != first + position:
            raise InputError(
                f"{path}: found after number {first + position - 1}, expected number "
                f"{first + position}: the ground truth counts positions"
            )
    return paths


def _match(
    path: pathlib.Path, rows: np.ndarray, database: int, queries: int
) -> tuple[Int64[np.ndarray, " _"], ...]:
    if rows.shape != (queries, 2):
        raise InputError(
            f"{path}: found shape {rows.shape}, expected ({queries}, 2): one row for each query"
        )
    positives: dict[int, np.ndarray] = {}
    beyond = 0
    for number, (query, references) in enumerate(rows):
        try:
            index = indices(query)
            matching = matches(references, database, windows=True)
            beyond += int((indices(references) >= database).sum())
        except (InputError, TypeError, OverflowError) as error:
            raise InputError(f"{path}: row {number}: {error}") from error
        if index.size != 1 or not 0 <= index[0] < queries or int(index[0]) in positives:
            raise InputError(
                f"{path}: row {number}: found query {index[:3].tolist()}, expected one from 0 to "
                f"{queries - 1} that no other row has"
            )
        positives[int(index[0])] = matching
    if beyond:
        warn(
            f"{path}: found {beyond} references after the last of {database} images, where windows "
            "of frames end; left out"
        )
    return tuple(positives[query] for query in range(queries))
