"""An evaluation set: database, queries, and the correct database images for each query."""

import contextlib
import dataclasses
import math
import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import read_image
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Bool, Float64, Int64


@brief
@dataclasses.dataclass(frozen=True, eq=False)
class Benchmark:
    """An evaluation set: its images, ground truth and, if known, positions."""

    name: str
    """Name of the set and how it was read, such as "sped_val/test (@UTM, 25 m)"."""
    root: pathlib.Path
    database: tuple[pathlib.Path, ...]
    queries: tuple[pathlib.Path, ...]
    positives: tuple[Int64[np.ndarray, " _"], ...] | None
    """For each query, the ascending indices of its correct database images; empty if there are
    none, which counts as a miss. None if the set has no ground truth at all."""
    rule: str
    """Description of the rule that makes a database image a positive."""
    database_positions: Float64[np.ndarray, "database axis"] | None = None
    """East and north (or x and y) in metres, or points `metres.on_ellipsoid` if zones differ."""
    query_positions: Float64[np.ndarray, "q axis"] | None = None
    """The same for the queries. Both are None if unknown, or for placeholder coordinates."""
    radius: float = 25.0
    """Distance in metres up to which two positions count as the same place."""

    def ground_truth(self) -> tuple[Int64[np.ndarray, " _"], ...]:
        """Return `positives`, or raise if the set has no ground truth.

        Raises:
            InputError: the set has no ground truth.
        """
        if self.positives is None:
            raise InputError(
                f"{self.root}: {self.name}: no ground truth, nothing to score; see `crisalad query`"
            )
        return self.positives

    def of_readable(
        self, queries: Bool[np.ndarray, " q"], database: Bool[np.ndarray, " database"]
    ) -> "Benchmark":
        """Return the set without the images that are marked as unreadable.

        Queries retain their readable positives. A query that has none counts as a miss.

        Args:
            queries: whether each query could be read.
            database: whether each database image could be read.

        Raises:
            InputError: none of the queries, or none of the database images, could be read.
        """
        if queries.all() and database.all():
            return self
        for side, readable in (("queries", queries), ("database", database)):
            if not readable.any():
                raise InputError(
                    f"{self.root}: {side}: found {len(readable)} images, none of them readable, "
                    "expected at least one"
                )
        asked, number = np.flatnonzero(queries), np.cumsum(database) - 1
        positives, places, at = self.positives, self.database_positions, self.query_positions
        return dataclasses.replace(
            self,
            database=tuple(self.database[image] for image in np.flatnonzero(database)),
            queries=tuple(self.queries[image] for image in asked),
            positives=positives
            and tuple(number[positives[query][database[positives[query]]]] for query in asked),
            database_positions=None if places is None else places[database],
            query_positions=None if at is None else at[queries],
        )


def leave_out_unreadable(benchmark: Benchmark, *, quiet: bool = False) -> Benchmark:
    """Read all images of a set, and return it without those that cannot be read.

    Args:
        benchmark: the set.
        quiet: whether to hide the progress bar.

    Raises:
        InputError: none of the queries, or none of the database images, can be read.
    """
    readable = readable_images((*benchmark.queries, *benchmark.database), quiet=quiet)
    return benchmark.of_readable(*np.split(readable, [len(benchmark.queries)]))


def readable_images(
    paths: Sequence[pathlib.Path], *, quiet: bool = False
) -> Bool[np.ndarray, " images"]:
    """Decode images, and return which of them can be read, in the order of `paths`."""
    readable = np.empty(len(paths), bool)
    with (
        progress_bar("reading", len(paths), "images", quiet=quiet) as bar,
        ThreadPoolExecutor(usable_cores()) as pool,
    ):
        for number, whole in enumerate(pool.map(_is_readable, paths)):
            readable[number] = whole
            bar.advance(1)
    return readable


def _is_readable(path: pathlib.Path) -> bool:
    with contextlib.suppress(InputError):
        read_image(path)
        return True
    return False


DEFAULT_RADIUS = 25.0
"""Default radius of positives in metres, as in Arandjelovic et al. (2016)."""


def within(
    database: Float64[np.ndarray, "images axis"],
    queries: Float64[np.ndarray, "q axis"],
    radius: float,
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Return the ascending indices of the database points at most `radius` from each query point.

    Raises:
        InputError: the radius is negative, infinite or not a number.
    """
    if not 0 <= radius < math.inf:
        raise InputError(f"radius: found {radius}, expected finite metres from 0")
    import scipy.spatial  # the import takes a fifth of a second

    near = scipy.spatial.KDTree(database).query_ball_point(queries, radius, return_sorted=True)
    return tuple(np.array(references, np.int64) for references in near)
