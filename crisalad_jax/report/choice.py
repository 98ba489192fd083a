"""Which queries a page shows: right, wrong, and without anything to find."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from crisalad_jax.retrieval import Neighbours


class Verdicts(NamedTuple):
    """What became of each query's first retrieval."""

    right: Bool[np.ndarray, " q"]
    matched: Bool[np.ndarray, " q"]
    """Whether any database image is right for the query."""

    @property
    def wrong(self) -> Bool[np.ndarray, " q"]:
        """Whether something else would have been right."""
        return self.matched & ~self.right


def judge(neighbours: Neighbours, positives: Sequence[Int[np.ndarray, " _"]]) -> Verdicts:
    """Judge the first retrievals."""
    first = neighbours.indices[:, 0]
    right = [bool(np.isin(index, wanted)) for index, wanted in zip(first, positives, strict=True)]
    return Verdicts(np.array(right, bool), np.array([np.size(p) > 0 for p in positives], bool))


class Shown(NamedTuple):
    """Queries by what a page shows them for."""

    right: list[int]
    wrong: list[int]
    unmatched: list[int]


def choose_shown(similarities: Float[np.ndarray, " q"], verdicts: Verdicts, most: int = 6) -> Shown:
    """At most so many of each kind, the most similar first; of equal ones the first in file order.

    Wrong ones and those without anything to find are the most confident: what would do the most
    harm. Right ones are spread evenly from the most to the least confident.
    """
    order = np.argsort(-similarities, kind="stable")
    right, wrong, unmatched = (
        order[mask[order]] for mask in (verdicts.right, verdicts.wrong, ~verdicts.matched)
    )
    spread = np.linspace(0, len(right) - 1, min(most, len(right))).round().astype(int)
    return Shown(right[spread].tolist(), wrong[:most].tolist(), unmatched[:most].tolist())
