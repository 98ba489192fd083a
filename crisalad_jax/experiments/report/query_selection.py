"""Choice of the queries that a page shows: right, wrong, and without a positive."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from crisalad_jax.retrieval.neighbours import Neighbours


class Verdicts(NamedTuple):
    """Whether each query's first retrieval is right, and whether it could be."""

    right: Bool[np.ndarray, " q"]
    matched: Bool[np.ndarray, " q"]
    """Whether any database image is right for the query."""

    @property
    def wrong(self) -> Bool[np.ndarray, " q"]:
        """Mask of the queries whose first retrieval is wrong although another image is right."""
        return self.matched & ~self.right


def judge(neighbours: Neighbours, positives: Sequence[Int[np.ndarray, " _"]]) -> Verdicts:
    """Judge each query's first retrieval by the ground truth."""
    first = neighbours.indices[:, 0]
    right = [bool(np.isin(index, wanted)) for index, wanted in zip(first, positives, strict=True)]
    return Verdicts(np.array(right, bool), np.array([np.size(p) > 0 for p in positives], bool))


class Shown(NamedTuple):
    """The queries that a page shows, by kind."""

    right: list[int]
    wrong: list[int]
    unmatched: list[int]


def choose_shown(similarities: Float[np.ndarray, " q"], verdicts: Verdicts, most: int = 6) -> Shown:
    """Choose at most `most` queries of each kind, by similarity and then in file order.

    Wrong queries and those without a positive are the most confident ones, which would do the most
    harm. Right queries are spread evenly from the most to the least confident.
    """
    order = np.argsort(-similarities, kind="stable")
    right, wrong, unmatched = (
        order[mask[order]] for mask in (verdicts.right, verdicts.wrong, ~verdicts.matched)
    )
    spread = np.linspace(0, len(right) - 1, min(most, len(right))).round().astype(int)
    return Shown(right[spread].tolist(), wrong[:most].tolist(), unmatched[:most].tolist())
