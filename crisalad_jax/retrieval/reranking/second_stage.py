"""What every second stage does: it scores each pair of images once, and sorts by the scores."""

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np

from crisalad_jax.data.reading import Reading
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.progress import Bar, progress_bar
from crisalad_jax.utils.shapes import Int


class SecondStage:
    """Puts each query's first neighbours in a new order; enter it before use."""

    def __init__(self, label: str, top: int, reading: Reading) -> None:
        """Take its name for progress bars, and how many neighbours it puts in order."""
        self._label, self._top, self._reading = label, top, reading
        self._scores: dict[tuple[int, int], Any] = {}

    def __enter__(self) -> Self:
        """Return the second stage itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release what it holds."""

    def prepare(self, first: Int[np.ndarray, "query candidate"]) -> None:
        """Compute what depends on one image only."""

    def compare(self, query: int, candidates: Sequence[int]) -> Iterable[Any]:
        """Score some candidates of a query, each by itself."""
        raise NotImplementedError

    def order(self, scores: np.ndarray, similarities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the new order of a query's candidates, and a score of each, in the old one."""
        raise NotImplementedError

    def __call__(self, neighbours: Neighbours) -> Neighbours:
        """Sort each query's first `top` neighbours by falling score.

        Equal scores keep the first stage's order, and so do the neighbours after the first `top`.
        Scores replace the similarities of the neighbours that are re-ranked.

        Raises:
            InputError: an image cannot be read; the disk has no room for the features.
        """
        indices, similarities = (np.array(part) for part in neighbours)
        first = indices[:, : self._top]
        self.prepare(first)
        with self.bar("pairs", first.size, "pairs") as bar:
            for query, candidates in enumerate(first.tolist()):
                new = [each for each in candidates if (query, each) not in self._scores]
                found = zip(new, self.compare(query, new), strict=True)
                self._scores |= {(query, each): score for each, score in found}
                scores = np.array([self._scores[query, each] for each in candidates])
                order, scores = self.order(scores, similarities[query, : self._top])
                first[query] = first[query, order]
                similarities[query, : self._top] = scores[order]
                bar.advance(len(candidates))
        return Neighbours(indices, similarities)

    def bar(self, what: str, count: int, unit: str) -> contextlib.AbstractContextManager[Bar]:
        """Show the progress of a part of its work."""
        return progress_bar(f"{self._label}, {what}", count, unit, quiet=self._reading.quiet)
