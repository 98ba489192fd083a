"""The base of every second stage: score each pair of images once, and sort by the scores."""

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np

from crisalad_jax.data.reading import Reading
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.progress import Bar, progress_bar
from crisalad_jax.utils.shapes import Int


class SecondStage:
    """A callable that re-ranks the first neighbours of each query; use it as a context manager."""

    def __init__(self, label: str, top: int, reading: Reading) -> None:
        """Set the progress bars' label, how many neighbours to re-rank, and how to read images."""
        self._label, self._top, self._reading = label, top, reading
        self._scores: dict[tuple[int, int], Any] = {}

    def __enter__(self) -> Self:
        """Return the second stage itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the resources of the second stage."""

    def prepare(self, first: Int[np.ndarray, "query candidate"]) -> None:
        """Compute what depends on single images; `first` has the candidates of each query."""

    def compare(self, query: int, candidates: Sequence[int]) -> Iterable[Any]:
        """Score each candidate of a query independently; images are given by index."""
        raise NotImplementedError

    def order(self, scores: np.ndarray, similarities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the new order of a query's candidates, and their scores in the old order."""
        raise NotImplementedError

    def __call__(self, neighbours: Neighbours) -> Neighbours:
        """Re-rank the first `top` neighbours of each query; `top` is an argument of the class.

        Ties, and neighbours after the first `top`, stay in the order of the first stage. Scores
        replace the similarities of the re-ranked neighbours.

        Raises:
            InputError: an image cannot be read; the disk has no space for the features.
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
        """Show a progress bar for one part of the work, of `count` units."""
        return progress_bar(f"{self._label}, {what}", count, unit, quiet=self._reading.quiet)
