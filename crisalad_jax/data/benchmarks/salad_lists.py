"""Read the `.npy` lists of GSV-Cities and SALAD: names of images, and indices of matches.

Files are `pitts30k_test_dbImages.npy`, `..._qImages.npy` and `..._gt.npy`. MSLS has `..._qIdx.npy`
(indices of the evaluated queries) and `..._pIdx.npy` (their matches) in place of `gt`.
"""

import os
import pathlib
import re

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders_on_disk import find_image_root, find_images, listing
from crisalad_jax.data.benchmarks.ground_truth import indices, is_nordland_star, matches
from crisalad_jax.data.benchmarks.msls import msls_title
from crisalad_jax.data.benchmarks.safe_npy import read_npy
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.shapes import Int64

_FILE = re.compile(r"(?P<prefix>(?:.*_)?)(?P<kind>dbImages|qImages|gt|qIdx|pIdx)\.npy")
_MSLS_IMAGE = re.compile(r"train_val/([^/]+)/(?:database|query)/images/[^/]+")
# Look in the queries' folders first: a query may have the same name as a database image.
_QUERY_FOLDERS = ("queries_real", ".")

_Lists = dict[str, pathlib.Path]
"""The files of a set, by their kind."""


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
        split: part of a set's name, such as `val`, where the folder has the lists of several sets.
        images: the folder to which the names are relative; None looks beside the files and one
            folder further up.
        on_bad_image: "skip" lets images be missing, for whoever reads them to leave out.

    Raises:
        InputError: not the lists of just one set, a file that holds anything but names or indices,
            counts that do not fit, an index that is out of range, images that are missing.
    """
    root = pathlib.Path(root)
    prefix, files = _choose(root, split)
    database_names, query_names = _names(files["dbImages"]), _names(files["qImages"])
    if "qIdx" in files:
        query_names = [query_names[i] for i in _chosen(files["qIdx"], len(query_names))]
    truth_path = files.get("gt", files.get("pIdx"))
    positives, rule = None, "none: there is no ground truth beside the lists"
    if truth_path is not None:
        positives = _positives(truth_path, len(database_names), len(query_names))
        rule = f"the database images that {truth_path.name} lists"
    nordland = positives is not None and is_nordland_star(positives, len(database_names))
    if nordland:
        rule += ", which are 10i - 1, 10i and 10i + 1 for query i: by that it is Nordland*"

    images_of = {}
    for kind, names, folders in (
        ("dbImages", database_names, (".",)),
        ("qImages", query_names, _QUERY_FOLDERS),
    ):
        folder = find_image_root(files[kind], images, names, folders, on_bad_image=on_bad_image)
        images_of[kind] = find_images(files[kind], folder, names, on_bad_image=on_bad_image)
    cities = _msls_cities(database_names + query_names)
    if nordland:
        name = "Nordland*, winter database, summer queries (SALAD's lists)"
    elif cities is not None:
        name = f"{msls_title(cities)}, {len(query_names)} queries (SALAD's list)"
    else:
        name = f"{prefix.strip('_') or real_path(files['dbImages']).parent.name} (SALAD's lists)"
    return Benchmark(name, root, images_of["dbImages"], images_of["qImages"], positives, rule)


def is_list(path: pathlib.Path) -> bool:
    """Return whether a file has the name of one of the lists."""
    return path.is_file() and _FILE.fullmatch(path.name) is not None


def has_lists(folder: pathlib.Path) -> bool:
    """Return whether a folder holds the lists of any set."""
    return folder.is_dir() and bool(_find(folder))


def _find(folder: pathlib.Path) -> dict[str, _Lists]:
    """Find the files of every set that lists a database, by the prefix of their names."""
    sets: dict[str, _Lists] = {}
    for path in sorted(folder.glob("*.npy")):
        parts = _FILE.fullmatch(path.name)
        if parts is not None:
            sets.setdefault(parts["prefix"], {})[parts["kind"]] = path
    return {prefix: files for prefix, files in sets.items() if "dbImages" in files}


def _choose(root: pathlib.Path, split: str | None) -> tuple[str, _Lists]:
    parts = _FILE.fullmatch(root.name) if root.is_file() else None
    folder = root if parts is None else root.parent
    if not folder.is_dir():
        raise InputError(f"{root}: found {listing(root)}, expected a folder with ..._dbImages.npy")
    sets = _find(folder)
    if parts is not None:
        sets = {prefix: files for prefix, files in sets.items() if prefix == parts["prefix"]}
    there = ", ".join(prefix.strip("_") or "dbImages.npy" for prefix in sets)
    if split is not None:
        sets = {prefix: files for prefix, files in sets.items() if split in prefix.split("_")}
    if len(sets) != 1:
        asked = "" if split is None else f" and split {split!r}"
        raise InputError(
            f"{root}: found lists of {there or 'no set'}{asked}, expected those of one: name a "
            "..._dbImages.npy, or a split that one of them has in its name"
        )
    ((prefix, files),) = sets.items()
    if "qImages" not in files or {"gt", "pIdx"} <= files.keys():
        raise InputError(
            f"{folder}: found {', '.join(path.name for path in files.values())}, expected "
            f"{prefix}qImages.npy, and one of {prefix}gt.npy and {prefix}pIdx.npy"
        )
    return prefix, files


def _names(path: pathlib.Path) -> list[str]:
    array = read_npy(path)
    names = array.reshape(-1).tolist()
    if array.ndim != 1 or not names or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{path}: found an array of {array.shape} of {array.dtype}, expected names of images"
        )
    return names


def _chosen(path: pathlib.Path, queries: int) -> Int64[np.ndarray, " _"]:
    """Read the indices of the queries that are evaluated."""
    try:
        chosen = indices(read_npy(path))
    except (TypeError, OverflowError) as error:
        raise InputError(f"{path}: found {error}, expected indices") from error
    unlike = len(np.unique(chosen)) == len(chosen) > 0
    if not unlike or not 0 <= chosen.min() <= chosen.max() < queries:
        raise InputError(
            f"{path}: found {len(chosen)} indices, expected some from 0 to {queries - 1}, each once"
        )
    return chosen


def _positives(
    path: pathlib.Path, database: int, queries: int
) -> tuple[Int64[np.ndarray, " _"], ...]:
    rows = read_npy(path)
    if rows.ndim == 0 or len(rows) != queries:
        raise InputError(
            f"{path}: found shape {rows.shape}, expected a row for each of {queries} queries"
        )
    positives = []
    for number, row in enumerate(rows):
        try:
            positives.append(matches(row, database))
        except InputError as error:
            raise InputError(f"{path}: row {number}: {error}") from error
    return tuple(positives)


def _msls_cities(names: list[str]) -> frozenset[str] | None:
    """Return the cities in the paths; None unless all are paths of MSLS."""
    cities = [_MSLS_IMAGE.fullmatch(name) for name in names]
    return None if None in cities else frozenset(match[1] for match in cities if match)
