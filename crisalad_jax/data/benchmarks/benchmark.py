"""The evaluation set that every reader returns: database, queries and ground truth."""

import dataclasses
import pathlib

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool, Float64, Int64


@brief
@dataclasses.dataclass(frozen=True, eq=False)
class Benchmark:
    """One evaluation set, in the order in which its images are described."""

    name: str
    """Name of exactly the images that were read, such as "sped_val/test (@UTM, 25 m)"."""
    root: pathlib.Path
    database: tuple[pathlib.Path, ...]
    queries: tuple[pathlib.Path, ...]
    positives: tuple[Int64[np.ndarray, " _"], ...] | None
    """Query -> ascending database indices; empty where the query has no match, which counts as a
    miss. None where the set has no ground truth at all."""
    rule: str
    """Rule that makes a database image positive, in words."""
    database_positions: Float64[np.ndarray, "database axis"] | None = None
    """East and north in metres; of a set wider than one UTM zone points on the ellipsoid
    (`metres.on_ellipsoid`). None where there are none, or only placeholders."""
    query_positions: Float64[np.ndarray, "q axis"] | None = None
    radius: float = 25.0
    """Metres within which two positions show the same place."""

    def ground_truth(self) -> tuple[Int64[np.ndarray, " _"], ...]:
        """Return `positives`, or raise where the set has no ground truth.

        Raises:
            InputError: the set has none.
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

        A query keeps its positives that are left. One without any is a miss, as in other sets.

        Args:
            queries: whether each query could be read.
            database: whether each database image could be read.

        Raises:
            InputError: none of the queries, or of the database, could be read.
        """
        if queries.all() and database.all():
            return self
        for name, kept in (("queries", queries), ("database", database)):
            if not kept.any():
                raise InputError(
                    f"{self.root}: {name}: found {len(kept)} images, none of them readable, "
                    "expected at least one"
                )
        number = np.cumsum(database) - 1
        positives = self.positives and tuple(
            number[wanted[database[wanted]]]
            for wanted, kept in zip(self.positives, queries, strict=True)
            if kept
        )
        places, asked = self.database_positions, self.query_positions
        return dataclasses.replace(
            self,
            database=_kept(self.database, database),
            queries=_kept(self.queries, queries),
            positives=positives,
            database_positions=None if places is None else places[database],
            query_positions=None if asked is None else asked[queries],
        )


def _kept(
    paths: tuple[pathlib.Path, ...], kept: Bool[np.ndarray, " image"]
) -> tuple[pathlib.Path, ...]:
    return tuple(path for path, keep in zip(paths, kept, strict=True) if keep)
