"""The similarity threshold at which the accepted top-1 retrievals reach a given precision."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from crisalad_jax.evaluation.metrics import accepted, right_retrievals
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import counted

CONFIDENCE = 0.95
"""Confidence of the lower bound of a precision."""


class OperatingPoint(NamedTuple):
    """Outcome of accepting first (top-1) retrievals at or above a threshold on their similarity.

    If no threshold reaches the requested precision, the one with the highest precision is used, and
    `reached` is False.
    """

    asked: float
    """The requested precision, as a fraction."""
    min_similarity: float
    """The threshold: a first retrieval is accepted at this similarity or above it."""
    answered: int
    """Number of queries whose first retrieval is accepted."""
    right: int
    """Number of answered queries whose first retrieval is correct."""
    queries: int
    """Number of all queries."""
    unknown: int
    """Number of queries without a positive: places that the database does not have."""
    unknown_answered: int
    """Number of queries of unknown places that are accepted anyway, each of them wrongly."""

    @property
    def precision(self) -> float:
        """Share of the accepted top-1 retrievals that are correct."""
        return self.right / self.answered

    @property
    def lower_bound(self) -> float:
        """Lower end of the one-sided 95 % interval of the precision by Clopper and Pearson 1934.

        Queries are treated as independent, and the threshold as fixed in advance. In fact it was
        chosen on the same queries, so the bound is somewhat too high.
        """
        if not self.right:
            return 0.0
        import scipy.special  # takes a tenth of a second, and no query needs it

        wrong = self.answered - self.right
        return float(scipy.special.betaincinv(self.right, wrong + 1, 1 - CONFIDENCE))

    @property
    def recall(self) -> float:
        """Share of all queries whose first retrieval is accepted and correct."""
        return self.right / self.queries

    @property
    def reached(self) -> bool:
        """Whether the measured precision is at least the requested one."""
        return self.precision >= self.asked


def check_precision(precision: float) -> None:
    """Raise InputError unless a precision is above 0 and at most 1."""
    if not 0 < precision <= 1:
        raise InputError(
            f"precision: found {precision}, expected a fraction above 0, at most 1, such as 0.99"
        )


def operating_point(
    indices: Int[np.ndarray, "q k"],
    similarities: Float[np.ndarray, "q k"],
    positives: Sequence[Int[np.ndarray, " _"]],
    precision: float,
) -> OperatingPoint:
    """Choose the similarity threshold with the highest recall at a given precision.

    The candidates are the thresholds of `precision_recall`. Queries of equal similarity are
    accepted together. Accepting a query without positives is always wrong. Recall is over all
    queries, so it is Recall@1 if everything is accepted.

    Args:
        indices: database indices of each query's neighbours, best first; only the first counts.
        similarities: similarities of `indices`.
        positives: correct database indices of each query, possibly none.
        precision: share of accepted retrievals that must be correct, above 0 and at most 1.

    Returns:
        The outcome at the lowest threshold that reaches the precision, or else at the most precise
        one. Either is rounded down to the fewest decimals, 3 or more, that accept the same queries.

    Raises:
        InputError: `precision` is out of range, or `accepted` or `right_retrievals` raises it.

    Example:
        >>> import numpy as np
        >>> similarities = np.array([[0.9], [0.8], [0.7], [0.6]])
        >>> positives = [np.array([0]), np.array([0]), np.array([]), np.array([0])]
        >>> point = operating_point(np.zeros((4, 1), int), similarities, positives, 0.99)
        >>> point.min_similarity, point.answered, point.recall
        (0.8, 2, 0.5)
    """
    check_precision(precision)
    right = right_retrievals(indices[:, :1], positives)[:, 0]
    known = np.array([np.size(wanted) > 0 for wanted in positives])
    ordered, last, accepted_right = accepted(similarities[:, 0], right)
    precisions = accepted_right / (last + 1)
    enough = np.flatnonzero(precisions >= precision)
    best = precisions == precisions.max()
    place = int(enough[-1] if len(enough) else np.flatnonzero(best)[-1])
    chosen, answered = float(ordered[last[place]]), int(last[place]) + 1
    below = float(ordered[answered]) if answered < len(ordered) else -math.inf
    return OperatingPoint(
        asked=precision,
        min_similarity=_rounded_down(chosen, below),
        answered=answered,
        right=int(accepted_right[place]),
        queries=len(right),
        unknown=int((~known).sum()),
        unknown_answered=int((~known & (similarities[:, 0] >= chosen)).sum()),
    )


def _rounded_down(value: float, below: float) -> float:
    """Round down to the fewest decimals, three or more, that stay above the next lower value."""
    if math.isfinite(value):
        for power in (10.0**decimals for decimals in range(3, 16)):
            rounded = math.floor(value * power) / power
            if below < rounded <= value:
                return rounded
    return value


def to_json(point: OperatingPoint) -> dict[str, Any]:
    """Convert the fields and properties of an operating point to JSON values by name."""
    names = ("precision", "lower_bound", "recall", "reached")
    return point._asdict() | {name: getattr(point, name) for name in names}


_FEWEST = 3
"""Minimum number of answers that a map's similarity must rest on."""


def check_supported(point: OperatingPoint, source: str) -> None:
    """Check that an operating point rests on at least three answers; see also `caveats`.

    Args:
        point: the operating point.
        source: name of the set, for the message.

    Raises:
        InputError: there are fewer than three answers.
    """
    if point.answered < _FEWEST:
        raise InputError(
            f"precision: found {counted(point.answered, 'answer')} of similarity "
            f"{point.min_similarity:.9g} or more on {source}, {point.right} correct, which shows a "
            f"precision of at least {100 * point.lower_bound:.1f} % (95 % confidence), expected "
            f"at least {_FEWEST} answers: more queries are needed, or the set is of another place"
        )


def caveats(point: OperatingPoint) -> list[str]:
    """Describe why an operating point may miss the requested precision; empty if nothing is wrong.

    Each caveat is at most one line, and starts in lower case so that it can follow a name.
    """
    asked = f"{100 * point.asked:g} %"
    measured = f"{point.right} of {point.answered} answers were correct"
    if not point.reached:
        return [
            f"no similarity reaches a precision of {asked}; the highest is "
            f"{100 * point.precision:.1f} % ({measured})"
        ]
    if point.lower_bound >= point.asked:
        return []
    sure = (
        f"rests on few queries: {measured}, which shows a precision of at least "
        f"{100 * point.lower_bound:.1f} % (95 % confidence)"
    )
    if point.right == point.answered and point.asked < 1:  # no number of queries shows 100 %
        enough = math.ceil(math.log(1 - CONFIDENCE) / math.log(point.asked))
        sure += f"; {asked} takes {enough} answers, all of them correct"
    return [sure]
