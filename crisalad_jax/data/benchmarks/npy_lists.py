"""Read sets with `.npy` ground truth: VPR-Bench's folders, GSV-Cities' and SALAD's lists.

VPR-Bench (Zaffar et al., IJCV 2021) has `ref/`, `query/` and `ground_truth_new.npy`.

The lists of a set are `pitts30k_test_dbImages.npy` and `..._qImages.npy` (names of images) and
`..._gt.npy` (matches of each query). Instead of the latter, MSLS has `..._qIdx.npy` (indices of the
evaluated queries) and `..._pIdx.npy` (their matches).

Published ground truths are arrays of lists, which numpy can only save as a pickle. They are read
without running code from them.
"""

import collections
import io
import os
import pathlib
import pickle
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from crisalad_jax.config.checks import kind_of
from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.msls import msls_title
from crisalad_jax.data.benchmarks.on_disk import find_images, list_part
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_bytes, real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Int64

VPR_BENCH_TRUTH = "ground_truth_new.npy"
_FILE = re.compile(r"(?P<prefix>(?:.*_)?)(?P<kind>dbImages|qImages|gt|qIdx|pIdx)\.npy")
_MSLS_IMAGE = re.compile(r"train_val/([^/]+)/(?:database|query)/images/[^/]+")
# Look in the queries' folders first: a query may have the same name as a database image.
_FOLDERS = {"dbImages": (".",), "qImages": ("queries_real", ".")}
_NORDLAND_RULE = ", which are 10i - 1, 10i and 10i + 1 for query i; this identifies Nordland*"

_MOST = 2**62
_Lists = dict[str, pathlib.Path]
"""The files of a set, by their kind."""


def read_vpr_bench(root: str | os.PathLike[str]) -> Benchmark:
    """Read a VPR-Bench folder `root`, with `ref/`, `query/` and `ground_truth_new.npy`.

    The file holds one row for each query: its index and a list of reference indices, [-1] where
    there is no match. Indices count the images from 0, in the order of the numbers in their names.
    No code in the file is run.

    The published lists of GardensPointWalking and 17places are windows of frames, which may extend
    past the last image. References past it are left out, and a warning counts them.

    Raises:
        InputError: a folder or the file is missing, a number is skipped among the images' names,
            the file holds anything but plain arrays, lists and numbers, all references of a query
            are out of range, or a query has no row or two rows.
    """
    root = pathlib.Path(root)
    database, queries = (_numbered(list_part(root / part)) for part in ("ref", "query"))
    path = root / VPR_BENCH_TRUTH
    rows = _read_rows(path, len(queries), 2)
    asked = _chosen(path, rows[:, 0], len(queries))
    truth = _read_matches(path, rows[:, 1], len(database), windows=True)
    positives = tuple(truth[row] for row in np.argsort(asked))
    name = f"{real_path(root).name} (VPR-Bench)"
    rule = f"the reference images that {VPR_BENCH_TRUTH} lists"
    if _is_nordland_star(positives, len(database)):
        name = "Nordland*, winter database, summer queries (VPR-Bench)"
        rule += _NORDLAND_RULE
    return Benchmark(name, root, database, queries, positives, rule)


def _numbered(paths: tuple[pathlib.Path, ...]) -> tuple[pathlib.Path, ...]:
    """Sort paths by number where all names are numbers: 10.jpg follows 9.jpg, not 1.jpg."""
    if not all(path.stem.isdecimal() for path in paths):
        return paths
    paths = tuple(sorted(paths, key=lambda path: int(path.stem)))
    for number, path in enumerate(paths, int(paths[0].stem)):
        # A gap would silently shift every later position against the ground truth.
        if int(path.stem) != number:
            raise InputError(
                f"{path}: found after number {number - 1}, expected number {number}: the ground "
                "truth counts positions"
            )
    return paths


def read_salad_lists(
    root: str | os.PathLike[str],
    split: str | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Read the `.npy` lists of GSV-Cities and SALAD. No code in the files is run.

    Args:
        root: a folder with such lists, or one of the files.
        split: part of a set's name between underscores, such as `val`, to choose one of several.
        images: the folder to which the names are relative; None tries the folder of the files, then
            its parent.
        on_bad_image: "stop" refuses missing images; under "skip" `evaluate` leaves them out.

    Raises:
        InputError: `root` and `split` do not select exactly one set; a file holds anything but
            names or indices; counts disagree; an index is out of range; or images are missing.
    """
    root = pathlib.Path(root)
    prefix, files = _choose(root, split)
    names = {kind: _names(files[kind]) for kind in _FOLDERS}
    count = len(names["dbImages"])
    if "qIdx" in files:
        chosen = _chosen(files["qIdx"], read_npy(files["qIdx"]), len(names["qImages"]))
        names["qImages"] = [names["qImages"][query] for query in chosen]
    asked = len(names["qImages"])
    truth = files.get("gt", files.get("pIdx"))
    positives, rule = None, "none: no ground truth was found next to the lists"
    if truth is not None:
        positives = _read_matches(truth, _read_rows(truth, asked), count)
        rule = f"the database images that {truth.name} lists"
    database, queries = (
        find_images(files[kind], names[kind], images, on_bad_image, folders)
        for kind, folders in _FOLDERS.items()
    )
    cities = [_MSLS_IMAGE.fullmatch(name) for kind in names for name in names[kind]]
    if positives is not None and _is_nordland_star(positives, count):
        name = "Nordland*, winter database, summer queries (SALAD's lists)"
        rule += _NORDLAND_RULE
    elif None not in cities:
        name = msls_title({match[1] for match in cities if match})
        name = f"{name}, {asked} queries (SALAD's list)"
    else:
        name = f"{prefix.strip('_') or real_path(files['dbImages']).parent.name} (SALAD's lists)"
    return Benchmark(name, root, database, queries, positives, rule)


def find_lists(root: pathlib.Path) -> dict[str, _Lists]:
    """Find the lists of each set in a folder, or of the set that a file belongs to.

    Returns:
        The files of each set with database and queries, by their prefix, then by kind ("gt", ...).
    """
    one = _FILE.fullmatch(root.name) if root.is_file() else None
    sets: dict[str, _Lists] = collections.defaultdict(dict)
    for path in sorted((root.parent if one else root).glob("*.npy")):
        parts = _FILE.fullmatch(path.name)
        if parts is not None and (one is None or one["prefix"] == parts["prefix"]):
            sets[parts["prefix"]][parts["kind"]] = path
    return {prefix: files for prefix, files in sets.items() if files.keys() >= _FOLDERS.keys()}


def _choose(root: pathlib.Path, split: str | None) -> tuple[str, _Lists]:
    """Find the lists of the one set that a file or a split names."""
    there = find_lists(root)
    chosen = [prefix for prefix in there if split is None or split in prefix.split("_")]
    if len(chosen) != 1:
        names = ", ".join(prefix.strip("_") or "dbImages.npy" for prefix in there) or "no set"
        raise InputError(
            f"{root}: found lists of {names}, expected those of one: name a ..._dbImages.npy, or a "
            f"split that one of them has in its name{'' if split is None else f', unlike {split}'}"
        )
    return chosen[0], there[chosen[0]]


def _names(path: pathlib.Path) -> list[str]:
    array = read_npy(path)
    names = array.reshape(-1).tolist()
    if array.ndim != 1 or not names or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{path}: found {array.dtype} of shape {array.shape}, expected names of images"
        )
    return names


def _read_rows(path: pathlib.Path, queries: int, *columns: int) -> np.ndarray:
    """Read a row for each query, checking the number of columns if given."""
    rows = np.atleast_1d(read_npy(path))
    if len(rows) != queries or (columns and rows.shape[1:] != columns):
        raise InputError(
            f"{path}: found shape {rows.shape}, expected {(queries, *columns)}: a row for each of "
            f"{queries} queries"
        )
    return rows


def _chosen(path: pathlib.Path, rows: np.ndarray, queries: int) -> list[int]:
    """Return the indices of queries in some rows, checking that each occurs only once."""
    indices = [index for row in _indices(path, np.atleast_1d(rows)) for index in row.tolist()]
    if not indices or len({*indices} & {*range(queries)}) < len(indices):
        raise InputError(
            f"{path}: found queries {indices[:8]}..., expected some from 0 to {queries - 1}, each "
            "once"
        )
    return indices


def _indices(path: pathlib.Path, rows: Iterable[Any]) -> Iterator[Int64[np.ndarray, " _"]]:
    """Yield the indices of each row of a file: a number, a flat list or an integer array.

    Nested lists are refused, not flattened: a pickle of a few hundred bytes can hold nested lists
    of any size.
    """
    for number, row in enumerate(rows):
        items = row.reshape(-1).tolist() if isinstance(row, np.ndarray) else row
        items = items if isinstance(items, list | tuple) else [items]
        wrong = [item for item in items if not kind_of(int).fits(item) or not -_MOST < item < _MOST]
        if wrong:
            raise InputError(
                f"{path}: row {number}: found values of type {type(wrong[0]).__name__}, expected "
                "whole numbers of 64 bits"
            )
        yield np.array(items, np.int64)


def _read_matches(
    path: pathlib.Path, rows: Iterable[Any], database: int, *, windows: bool = False
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Return the unique database indices of each row, ascending; -1 for no match is dropped.

    With `windows`, indices after the last image are dropped too, if others remain.
    """
    matches, beyond = [], 0
    for number, row in enumerate(_indices(path, rows)):
        found = np.unique(row[row != -1])
        if windows and found.size and 0 <= found[0] < database:
            beyond += int((row >= database).sum())
            found = found[found < database]
        if found.size and not 0 <= found[0] <= found[-1] < database:
            raise InputError(
                f"{path}: row {number}: found reference indices {found[0]} to {found[-1]}, "
                f"expected 0 to {database - 1}, or -1 for no match"
            )
        matches.append(found)
    if beyond:
        warn(
            f"{path}: found {beyond} references after the last of {database} images, where windows "
            "of frames end; left out"
        )
    return tuple(matches)


def _is_nordland_star(positives: Sequence[Int64[np.ndarray, " _"]], database: int) -> bool:
    """Return whether this is VPR-Bench's Nordland: query i matches 10i - 1, 10i and 10i + 1.

    Its queries (2,760, summer) are every tenth frame of its database (27,592, winter).
    """
    return len(positives) > 1 and all(
        references.tolist() == [*range(max(0, 10 * query - 1), min(10 * query + 2, database))]
        for query, references in enumerate(positives)
    )


_SAFE_NAMES = frozenset(
    (
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "scalar"),
        ("numpy._core.numeric", "_frombuffer"),
        ("_codecs", "encode"),
        ("__builtin__", "bytes"),
    )
)
"""All that a pickled array needs; the last two encode bytes for Python 2. None of it runs code from
the file, calls back into it, or can be changed by it."""


def read_npy(path: pathlib.Path) -> np.ndarray:
    """Read a .npy file; a pickle in it may hold lists, tuples, text, bytes, numbers and arrays.

    Raises:
        InputError: the file is missing, damaged, or holds anything else.
    """
    file = io.BytesIO(read_bytes(path, "a .npy file"))
    try:
        return _read_array(file)
    except Exception as error:  # a damaged pickle can raise anything at all
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: cannot be read as an array: {type(error).__name__}: {reason}"
        ) from error


def _read_array(file: io.BytesIO) -> np.ndarray:
    version = np.lib.format.read_magic(file)
    wide = version > (1, 0)
    header = np.lib.format.read_array_header_2_0 if wide else np.lib.format.read_array_header_1_0
    shape, _, dtype = header(file)
    if not dtype.hasobject:
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
    array = _Unpickler(file, encoding="latin1").load()
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ValueError(f"found a pickled {type(array).__name__}, expected an array of {shape}")
    return array


class _Unpickler(pickle._Unpickler):
    """An unpickler that looks up only `_SAFE_NAMES`.

    It is in pure Python: the one in C allocates as much memory as a damaged file claims.
    """

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        # numpy 2 moved its modules, and files from numpy 1 and 2 both exist.
        module = module_name.replace("numpy.core.", "numpy._core.")
        if (module, global_name) not in _SAFE_NAMES:
            raise pickle.UnpicklingError(f"the file asks for {module}.{global_name}")
        return super().find_class(module, global_name)
