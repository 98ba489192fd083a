"""Read NetVLAD's `.mat` files (Arandjelovic et al., CVPR 2016): Pitts30k, Pitts250k, Tokyo.

Each holds a struct `dbStruct` with whichSet, dbImage, utmDb (2 x N), qImage, utmQ, numDb, numQ,
posDistThr (the radius of positives in metres), and other fields that are not needed here.
"""

import os
import pathlib

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark, within
from crisalad_jax.data.benchmarks.on_disk import find_images
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST_TEXT
from crisalad_jax.utils.mat_files import load_mat

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
    """Read an evaluation set from one of NetVLAD's `.mat` files.

    Args:
        path: the file, such as `pitts30k_test.mat`.
        radius: radius of positives in metres, inclusive; None takes the file's posDistThr.
        images: the folder with `000/...` (or `images/000/...`) and with the queries in
            `queries_real/`, `queries/` or `query/`; None tries the file's folder, then its parent.
        on_bad_image: "stop" refuses missing images; under "skip" `evaluate` leaves them out.

    Raises:
        InputError: the file is missing or has no dbStruct, its counts differ from its arrays,
            images are missing, or the radius is negative.
    """
    path = pathlib.Path(path)
    expected, damaged = "a .mat file with dbStruct", "cannot be read as a .mat file"
    contents = load_mat(path, expected, damaged=damaged, largest=LARGEST_TEXT)
    images_of, metres = [], []
    try:
        struct = contents["dbStruct"].reshape(-1)[0]
        which = str(struct["whichSet"].item())
        radius = float(struct["posDistThr"].item()) if radius is None else radius
        for field, utm, count, folders in _SIDES:
            names = [str(cell.item()) for cell in struct[field].reshape(-1)]
            positions = np.ascontiguousarray(struct[utm].T, np.float64)
            counted = float(struct[count].item())
            right = positions.shape == (len(names), 2) and np.isfinite(positions).all()
            if not right or not names or len(names) != counted:
                raise ValueError(
                    f"{len(names)} names, a count of {counted:g} and positions of shape "
                    f"{positions.T.shape}, which must be finite"
                )
            images_of.append((names, folders))
            metres.append(positions)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: found {', '.join(contents)} ({error}), expected a struct dbStruct of NetVLAD"
        ) from error
    places, asked = metres
    database, queries = (
        find_images(path, names, images, on_bad_image, folders) for names, folders in images_of
    )
    name = f"{path.stem} (NetVLAD .mat, {which} set, {radius:g} m)"
    rule = f"UTM distance of at most {radius:g} m"
    positives = within(places, asked, radius)
    return Benchmark(name, path, database, queries, positives, rule, places, asked, radius)
