"""The evaluation set that every reader returns: database, queries and ground truth."""

import dataclasses
import pathlib

import numpy as np
from jaxtyping import Float64, Int64

from crisalad_jax.utils.errors import InputError


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
    database_positions: Float64[np.ndarray, "database 2"] | None = None
    """East and north in metres, for maps; None where there are none, or only placeholders."""
    query_positions: Float64[np.ndarray, "q 2"] | None = None
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
