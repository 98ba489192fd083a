"""Evaluation sets: database, queries, and which database images are right for each query.

Layouts: `@UTM` file names (VPR-datasets-downloader) and VPR-Bench (Zaffar et al. 2021).
"""

import dataclasses
import os
import pathlib
import pickle
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float64, Int64

from crisalad_jax.data.images import list_images
from crisalad_jax.errors import InputError

SPLITS = ("test", "val", "train")


@dataclasses.dataclass(frozen=True, eq=False)
class Benchmark:
    """One evaluation set, in the order in which its images are described."""

    name: str
    """Exactly what was read, for instance "sped_val/test (@UTM, 25 m)"."""
    root: pathlib.Path
    database: tuple[pathlib.Path, ...]
    queries: tuple[pathlib.Path, ...]
    positives: tuple[Int64[np.ndarray, " _"], ...] | None
    """Query -> ascending database indices; empty where the query has no match. None where the set
    has no ground truth."""
    rule: str
    """What makes a database image positive, in words."""
    database_positions: Float64[np.ndarray, "n 2"] | None = None
    """Metres, where the set has them."""
    query_positions: Float64[np.ndarray, "n 2"] | None = None


def open_benchmark(
    root: str | os.PathLike[str], split: str | None = None, radius: float = 25.0
) -> Benchmark:
    """Read an evaluation set whose layout is found by looking into the folder.

    `split` and `radius` (metres) are those of `read_utm`.

    Raises:
        InputError: no known layout, or what the layout's reader raises.
    """
    root = pathlib.Path(root)
    if (root / "images").is_dir() or _is_pair(root, "database", "queries"):
        return read_utm(root, split, radius)
    if _is_pair(root, "ref", "query"):
        if split is not None:
            raise InputError(
                f"split: found {split!r}, but {root} is a VPR-Bench folder without any"
            )
        return read_vpr_bench(root)
    raise InputError(
        f"{root}: found {_listing(root)}; expected images/{{test,val,train}}/, or database/ and "
        "queries/, or ref/, query/ and ground_truth_new.npy"
    )


def read_utm(
    root: str | os.PathLike[str], split: str | None = None, radius: float = 25.0
) -> Benchmark:
    """Read `@UTM_east@UTM_north@...` images; a positive is at most `radius` metres away.

    Args:
        root: a folder with `images/{test,val,train}`, or one that itself holds `database/` and
            `queries/`.
        split: None takes `test`, else `val`.
        radius: in metres, inclusive.

    Raises:
        InputError: no such split or folder, a folder without images, a name without coordinates, a
            negative radius.
    """
    root = pathlib.Path(root)
    if not radius >= 0:
        raise InputError(f"radius: found {radius}, expected metres from 0")
    folder, name = _find_split(root, split)
    database, queries = (_list_part(folder / part, folder) for part in ("database", "queries"))
    return Benchmark(
        name=f"{name} (@UTM, {radius:g} m)",
        root=root,
        database=database,
        queries=queries,
        positives=_within(_coordinates(database), _coordinates(queries), radius),
        rule=f"UTM distance of at most {radius:g} m",
    )


def _find_split(root: pathlib.Path, split: str | None) -> tuple[pathlib.Path, str]:
    """The folder that holds database/ and queries/, and what to call it."""
    # resolve: a root of "." still has a name to print
    resolved = root.resolve()
    if split is None and _is_pair(root, "database", "queries"):
        if resolved.parent.name == "images":
            return root, f"{resolved.parent.parent.name}/{resolved.name}"
        return root, resolved.name
    found = [name for name in SPLITS if (root / "images" / name).is_dir()]
    if split is None:
        split = next((name for name in found if name != "train"), None)
    if split is None or not (root / "images" / split).is_dir():
        raise InputError(
            f"{root}: found {_listing(root)} and splits {', '.join(found) or 'none'}, expected "
            f"images/{split or 'test'} with database/ and queries/"
        )
    return root / "images" / split, f"{resolved.name}/{split}"


def _coordinates(paths: tuple[pathlib.Path, ...]) -> Float64[np.ndarray, "images 2"]:
    """East and north in metres."""
    coordinates = np.empty((len(paths), 2))
    for row, path in zip(coordinates, paths, strict=True):
        fields = path.name.split("@")
        try:
            row[:] = float(fields[1]), float(fields[2])
        except (IndexError, ValueError):
            row[:] = np.nan
        if not np.isfinite(row).all():
            raise InputError(
                f"{path}: found no coordinates, expected a name @UTM_east@UTM_north@..."
            )
    return coordinates


def _within(
    database: Float64[np.ndarray, "images 2"], queries: Float64[np.ndarray, "q 2"], radius: float
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Database indices within `radius` of each query; memory stays linear in the database."""
    # Along the longer side of the map a band of twice the radius holds few candidates.
    axis = int(np.argmax(np.ptp(database, axis=0)))
    order = np.argsort(database[:, axis], kind="stable")
    ordered = database[order]
    # The extra metre keeps rounding at the edge of the band from deciding: the distance decides.
    reach = radius + 1.0
    first = np.searchsorted(ordered[:, axis], queries[:, axis] - reach, side="left")
    last = np.searchsorted(ordered[:, axis], queries[:, axis] + reach, side="right")
    positives = []
    for query, start, stop in zip(queries, first, last, strict=True):
        squared = np.square(ordered[start:stop] - query).sum(axis=1)
        positives.append(np.sort(order[start:stop][squared <= radius * radius]))
    return tuple(positives)


def read_vpr_bench(root: str | os.PathLike[str]) -> Benchmark:
    """Read a VPR-Bench folder: `ref/`, `query/`, `ground_truth_new.npy`.

    The file holds one row for each query: its index and a list of reference indices, [-1] where
    there is no match. An index is a position among the images in the order of their numbers. No
    code in the file is run.

    Raises:
        InputError: a folder or the file is missing, a number is skipped among the images' names,
            the file holds anything but plain arrays, lists and numbers, an index is out of range,
            a query has no row or two.
    """
    root = pathlib.Path(root)
    database, queries = (_numbered(_list_part(root / part, root)) for part in ("ref", "query"))
    truth_path = root / "ground_truth_new.npy"
    return Benchmark(
        name=f"{root.resolve().name} (VPR-Bench)",
        root=root,
        database=database,
        queries=queries,
        positives=_match(truth_path, _load_objects(truth_path), len(database), len(queries)),
        rule="the reference images that ground_truth_new.npy lists",
    )


def _numbered(paths: tuple[pathlib.Path, ...]) -> tuple[pathlib.Path, ...]:
    """Sort by number where all names are numbers: 10.jpg follows 9.jpg, not 1.jpg."""
    if not all(path.stem.isdecimal() for path in paths):
        return paths
    paths = tuple(sorted(paths, key=lambda path: int(path.stem)))
    first = int(paths[0].stem)
    for position, path in enumerate(paths):
        # A gap would shift every later position against the ground truth, unnoticed.
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
    for number, (query, references) in enumerate(rows):
        try:
            index = _indices(query)
            matches = _indices(references)
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: row {number}: found {error}, expected indices") from error
        if index.size != 1 or not 0 <= index[0] < queries or int(index[0]) in positives:
            raise InputError(
                f"{path}: row {number}: found query {index.tolist()}, expected one from 0 to "
                f"{queries - 1} that no other row has"
            )
        matches = np.unique(matches[matches != -1])
        if matches.size and not 0 <= matches[0] <= matches[-1] < database:
            raise InputError(
                f"{path}: row {number}: found reference indices {matches[0]} to {matches[-1]}, "
                f"expected 0 to {database - 1}, or -1 for no match"
            )
        positives[int(index[0])] = matches
    return tuple(positives[query] for query in range(queries))


def _indices(value: Any) -> Int64[np.ndarray, " _"]:
    array = np.asarray(value).reshape(-1)
    if array.size == 0:
        return np.empty(0, np.int64)
    if array.dtype == object:
        array = np.asarray(array.tolist())
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ValueError(f"values of type {array.dtype}")
    return array.astype(np.int64)


def _load_objects(path: pathlib.Path) -> np.ndarray:
    """Read a .npy file, pickled objects included, without running code from it."""
    try:
        with path.open("rb") as file:
            return _load_npy(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except Exception as error:  # a damaged pickle can raise anything at all
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: cannot be read as an array of indices: {type(error).__name__}: {reason}"
        ) from error


def _load_npy(file: BinaryIO) -> np.ndarray:
    version = np.lib.format.read_magic(file)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f"found .npy version {version}, expected (1, 0) or (2, 0)")
    shape, _, dtype = readers[version](file)
    if not dtype.hasobject:
        file.seek(0)
        return np.load(file, allow_pickle=False)
    array = _ArrayUnpickler(file, encoding="latin1").load()
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ValueError(f"found a pickled {type(array).__name__}, expected an array of {shape}")
    return array


def _encode_latin1(text: str, encoding: str) -> bytes:
    """Stand in for `_codecs.encode`, by which old pickles spell bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"encoding {encoding!r} is not allowed")
    return text.encode("latin1")


# numpy 2 moved its modules, and files of both ages are about. The functions are taken from what
# numpy itself would write.
_RECONSTRUCT = np.empty(0).__reduce__()[0]
_SCALAR = np.int64(0).__reduce__()[0]
_FROM_BUFFER = np.empty(0).__reduce_ex__(5)[0]
_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy.core.multiarray", "scalar"): _SCALAR,
    ("numpy._core.multiarray", "scalar"): _SCALAR,
    ("numpy.core.numeric", "_frombuffer"): _FROM_BUFFER,
    ("numpy._core.numeric", "_frombuffer"): _FROM_BUFFER,
    ("_codecs", "encode"): _encode_latin1,
}


class _ArrayUnpickler(pickle.Unpickler):
    """Rebuild numpy arrays, lists and numbers; refuse every other name a pickle may ask for."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if (module_name, global_name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"the file asks for {module_name}.{global_name}")
        return _ALLOWED[module_name, global_name]


def _is_pair(root: pathlib.Path, *parts: str) -> bool:
    return all((root / part).is_dir() for part in parts)


def _list_part(folder: pathlib.Path, parent: pathlib.Path) -> tuple[pathlib.Path, ...]:
    if not folder.is_dir():
        raise InputError(f"{parent}: found {_listing(parent)}, expected a folder {folder.name}")
    return tuple(list_images(folder))


def _listing(folder: pathlib.Path) -> str:
    """What a folder holds, for a message."""
    if not folder.is_dir():
        return "no such folder"
    names = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    shown = ", ".join(names[:8]) or "nothing"
    return f"{shown} and {len(names) - 8} more" if len(names) > 8 else shown
