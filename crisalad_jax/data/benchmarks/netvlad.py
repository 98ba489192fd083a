"""NetVLAD's `.mat` files (Arandjelovic et al., CVPR 2016): Pitts30k, Pitts250k, Tokyo.

A struct `dbStruct` with the fields whichSet, dbImage, utmDb (2 x N), qImage, utmQ, numDb, numQ,
posDistThr, and others that are not needed here.
"""

import math
import os
import pathlib
from typing import Any

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders_on_disk import find_image_root, find_images
from crisalad_jax.data.benchmarks.ground_truth import check_radius, within
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.mat_files import load_mat
from crisalad_jax.utils.shapes import Float64

_FIELDS = ("whichSet", "dbImage", "utmDb", "qImage", "utmQ", "numDb", "numQ", "posDistThr")
_DATABASE_FOLDERS = (".", "images")
# Look in the queries' folders first: a query may have the same name as a database image.
_QUERY_FOLDERS = ("queries_real", "queries", "query", ".")


def read_netvlad(
    path: str | os.PathLike[str],
    radius: float | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Read a `.mat` file of NetVLAD; a positive is at most `radius` metres away.

    Args:
        path: for instance `pitts30k_test.mat`.
        radius: in metres, inclusive; None takes the file's posDistThr.
        images: the folder with `000/...` (or `images/000/...`) and with the queries in
            `queries_real/`, `queries/` or `query/`; None looks beside the file and one folder
            further up.
        on_bad_image: "skip" lets images be missing, for whoever reads them to leave out.

    Raises:
        InputError: no such file, no dbStruct in it, counts that differ from its arrays, images that
            are missing, a negative radius.
    """
    path = pathlib.Path(path)
    struct = _read_struct(path)
    radius = _number(path, struct, "posDistThr") if radius is None else radius
    check_radius(radius)
    sides = []
    for names, utm, count, folders in (
        ("dbImage", "utmDb", "numDb", _DATABASE_FOLDERS),
        ("qImage", "utmQ", "numQ", _QUERY_FOLDERS),
    ):
        listed = _names(path, struct, names)
        expected = _number(path, struct, count)
        if len(listed) != expected or not listed:
            raise InputError(
                f"{path}: {names}: found {len(listed)} images, expected {count}, {expected:g}, and "
                "at least one"
            )
        positions = _positions(path, struct, utm, len(listed))
        root = find_image_root(path, images, listed, folders, on_bad_image=on_bad_image)
        sides.append((find_images(path, root, listed, on_bad_image=on_bad_image), positions))
    (database, places), (queries, asked) = sides
    return Benchmark(
        name=f"{path.stem} (NetVLAD .mat, {_text(path, struct, 'whichSet')} set, {radius:g} m)",
        root=path,
        database=database,
        queries=queries,
        positives=within(places, asked, radius),
        rule=f"UTM distance of at most {radius:g} m",
        database_positions=places,
        query_positions=asked,
        radius=radius,
    )


def _read_struct(path: pathlib.Path) -> np.void:
    contents = load_mat(path, "a .mat file with dbStruct", damaged="cannot be read as a .mat file")
    struct = contents.get("dbStruct")
    if struct is None or struct.size != 1 or struct.dtype.names is None:
        variables = ", ".join(name for name in contents if not name.startswith("__"))
        raise InputError(f"{path}: found {variables or 'nothing'}, expected a struct dbStruct")
    missing = [name for name in _FIELDS if name not in struct.dtype.names]
    if missing:
        raise InputError(f"{path}: dbStruct: found no {', '.join(missing)}")
    return struct.reshape(-1)[0]


def _text(path: pathlib.Path, struct: np.void, field: str) -> str:
    value = struct[field]
    if value.dtype.kind != "U" or value.size != 1:
        raise InputError(f"{path}: {field}: found {_found(value)}, expected text")
    return str(value.item())


def _number(path: pathlib.Path, struct: np.void, field: str) -> float:
    value = struct[field]
    if value.dtype.kind not in "iuf" or value.size != 1:
        raise InputError(f"{path}: {field}: found {_found(value)}, expected a number")
    number = float(value.item())
    if not math.isfinite(number):
        raise InputError(f"{path}: {field}: found {number}, expected a finite number")
    return number


def _names(path: pathlib.Path, struct: np.void, field: str) -> list[str]:
    cells = struct[field].reshape(-1)
    if any(not isinstance(cell, np.ndarray) or cell.dtype.kind != "U" for cell in cells) or any(
        cell.size != 1 for cell in cells
    ):
        raise InputError(f"{path}: {field}: found {_found(cells)}, expected names of images")
    return [str(cell.item()) for cell in cells]


def _positions(
    path: pathlib.Path, struct: np.void, field: str, count: int
) -> Float64[np.ndarray, "images 2"]:
    value = struct[field]
    right = value.dtype.kind in "iuf" and value.shape == (2, count)
    if not right or not np.isfinite(value).all():
        raise InputError(
            f"{path}: {field}: found {_found(value)}, expected 2 x {count} numbers, one pair for "
            "each image"
        )
    return np.ascontiguousarray(value.T, dtype=np.float64)


def _found(value: Any) -> str:
    return f"an array of {value.shape} of {value.dtype}"
