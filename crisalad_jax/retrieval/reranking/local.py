"""The second stage that verifies retrievals by local features of the images' own size."""

import pathlib
from collections.abc import Sequence
from typing import Self

import numpy as np

from crisalad_jax.data.images import read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.verification.verify import Verifier, order_by_inliers
from crisalad_jax.utils.progress import progress_bar


class LocalReranker:
    """Puts each query's first neighbours in order by similarity and inliers; see `Reranker`."""

    def __init__(
        self,
        verifier: Verifier,
        database: Sequence[pathlib.Path],
        queries: Sequence[pathlib.Path],
        reading: Reading,
    ) -> None:
        """Prepare the second stage over these images."""
        self._verifier, self._reading = verifier, reading
        self._database, self._queries = database, queries
        self._inliers: dict[tuple[int, int], int] = {}

    def __enter__(self) -> Self:
        """Return the second stage itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: features are in memory."""

    def __call__(self, neighbours: Neighbours) -> Neighbours:
        """Sort each query's first neighbours; their inliers replace their similarities.

        Raises:
            InputError: a query cannot be read, or none of its neighbours.
        """
        indices, similarities = (np.array(part) for part in neighbours)
        top = self._verifier.verify.answers
        with progress_bar(
            "local, queries", len(indices), "queries", quiet=self._reading.quiet
        ) as bar:
            for query, first in enumerate(indices[:, :top].tolist()):
                inliers = self._count(query, first)
                order = order_by_inliers(similarities[query, :top], inliers)
                indices[query, :top] = indices[query, order]
                similarities[query, :top] = inliers[order]
                bar.advance(1)
        return Neighbours(indices, similarities)

    def _count(self, query: int, candidates: list[int]) -> np.ndarray:
        """Count the inliers of a query's candidates; those of pairs are cached."""
        new = [each for each in candidates if (query, each) not in self._inliers]
        if new:
            files = [self._database[each] for each in new]
            image = read_image(self._queries[query], bit_depth="contrast-stretch")
            checks = self._verifier.check(image, [(str(f.parent), f.name) for f in files])
            found = zip(new, checks, strict=True)
            self._inliers |= {(query, each): check.inliers for each, check in found}
        return np.array([self._inliers[query, each] for each in candidates])
