"""NetVLAD's `.mat` files (Arandjelovic et al., CVPR 2016): Pitts30k, Pitts250k, Tokyo.

A struct `dbStruct` with the fields whichSet, dbImage, utmDb (2 x N), qImage, utmQ, numDb, numQ,
posDistThr, and others that are not needed here.
"""

import os
import pathlib
from typing import Any

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark, check_radius, within
from crisalad_jax.data.benchmarks.on_disk import find_images, image_roots
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.mat_files import load_mat

_FIELDS = ("whichSet", "dbImage", "utmDb", "qImage", "utmQ", "numDb", "numQ", "posDistThr")
_SIDES = (
    ("dbImage", "utmDb", "numDb", (".", "images")),
    # Look in the queries' folders first: a query may have the same name as a database image.
    ("qImage", "utmQ", "numQ", ("queries_real", "queries", "query", ".")),
)
"""Fields of the names, positions and count of the database and the queries, and their folders."""


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
    radius = float(_numbers(path, struct, "posDistThr").item()) if radius is None else radius
    check_radius(radius)
    found = []
    for field, utm, count, folders in _SIDES:
        names = _names(path, struct, field)
        expected = _numbers(path, struct, count).item()
        if len(names) != expected or not names:
            raise InputError(
                f"{path}: {field}: found {len(names)} images, expected {count}, {expected:g}, and "
                "at least one"
            )
        positions = np.ascontiguousarray(_numbers(path, struct, utm, len(names)).T, np.float64)
        roots = image_roots(path, images, folders)
        found.append((find_images(path, names, roots, on_bad_image), positions))
    (database, places), (queries, asked) = found
    which = " ".join(map(str, struct["whichSet"].reshape(-1)[:1]))
    return Benchmark(
        name=f"{path.stem} (NetVLAD .mat, {which} set, {radius:g} m)",
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


def _numbers(
    path: pathlib.Path, struct: np.void, field: str, images: int | None = None
) -> np.ndarray:
    """Return a field that holds one number, or two for each image."""
    value = struct[field]
    right = value.size == 1 if images is None else value.shape == (2, images)
    if not right or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
        expected = "a finite number" if images is None else f"2 x {images} numbers"
        raise InputError(f"{path}: {field}: found {_found(value)}, expected {expected}")
    return value


def _names(path: pathlib.Path, struct: np.void, field: str) -> list[str]:
    cells = struct[field].reshape(-1)
    if any(getattr(cell, "dtype", cells.dtype).kind != "U" or cell.size != 1 for cell in cells):
        raise InputError(f"{path}: {field}: found {_found(cells)}, expected names of images")
    return [str(cell.item()) for cell in cells]


def _found(value: Any) -> str:
    return str(value.item()) if value.size == 1 else f"an array of {value.shape} of {value.dtype}"
