"""A training set of queries and a database, from which tuples are mined (NetVLAD, SelaVPR)."""

import dataclasses
import functools
import os
import pathlib

import numpy as np

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks.benchmark import within
from crisalad_jax.data.benchmarks.msls import is_msls
from crisalad_jax.data.benchmarks.on_disk import has_split
from crisalad_jax.data.benchmarks.open import open_benchmark
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Int64


@brief
@dataclasses.dataclass(frozen=True, eq=False)
class QuerySet:
    """Queries that have positives in a database, with their positives."""

    root: pathlib.Path
    files: tuple[str, ...]
    """Paths of the images, as text: the database, then all queries."""
    database: int
    """Number of database images, which come first in `files`."""
    queries: Int64[np.ndarray, " query"]
    """Index in `files` of each query that has positives."""
    positives: tuple[Int64[np.ndarray, " _"], ...]
    """For each query, the indices of its positives, at least one, ascending."""
    near: tuple[Int64[np.ndarray, " _"], ...]
    """For each query, the database images that are not negatives, positives included, ascending."""

    def path(self, image: int | np.integer) -> pathlib.Path:
        """Return the path of one image."""
        return pathlib.Path(self.files[image])


@takes(root=PATH)
def read_query_set(
    root: str | os.PathLike[str],
    *,
    positive_radius: float = 10.0,
    negative_radius: float = 25.0,
    images: str | os.PathLike[str] | None = None,
    on_bad_image: OnBadImage = "stop",
) -> QuerySet:
    r"""Read the training split of a set that `open_benchmark` reads, such as pitts30k_train.mat.

    Args:
        root: a folder or file; from a folder with several splits, `train` is read.
        positive_radius: radius of positives in metres, inclusive.
        negative_radius: metres from a query within which database images are not negatives.
        images: the folder of the images that a file names.
        on_bad_image: "stop" refuses missing images; under "skip" training leaves them out.

    Returns:
        The set, without the queries that have no positive.

    Raises:
        InputError: `open_benchmark` cannot read the set; the set has neither positions nor ground
            truth; or no query has positives and negatives.

    Example:
        >>> import shutil
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> lines = ["query,database", *(f"{number}.png,{number}.png" for number in range(4))]
        >>> _ = (folder / "set" / "ground_truth.csv").write_text("\n".join(lines))
        >>> read_query_set(folder / "set").queries.tolist()
        [4, 5, 6, 7]
    """
    root = pathlib.Path(root)
    raw_msls = root.is_dir() and is_msls(root)
    split = "train" if raw_msls or (root.is_dir() and has_split(root)) else None
    read = functools.partial(open_benchmark, root, split, images=images, on_bad_image=on_bad_image)
    radii = (positive_radius, negative_radius)
    if raw_msls:
        # Images of different cities never match, whatever their positions.
        benchmark, wider = map(read, radii)
        positives, near = benchmark.ground_truth(), wider.ground_truth()
    else:
        benchmark = read()
        there, asked = benchmark.database_positions, benchmark.query_positions
        if there is None or asked is None:
            positives = near = benchmark.ground_truth()
        else:
            positives, near = (within(there, asked, radius) for radius in radii)
    kept = [query for query, matches in enumerate(positives) if matches.size]
    count = len(benchmark.database)
    if not any(len(near[query]) < count for query in kept):
        raise InputError(
            f"{root}: found {len(kept)} of {len(benchmark.queries)} queries with a database image "
            f"within {positive_radius:g} m, and none of them with one farther than "
            f"{negative_radius:g} m, expected positives and negatives"
        )
    return QuerySet(
        root=benchmark.root,
        files=tuple(map(str, (*benchmark.database, *benchmark.queries))),
        database=count,
        queries=count + np.array(kept, np.int64),
        positives=tuple(positives[query] for query in kept),
        near=tuple(near[query] for query in kept),
    )
