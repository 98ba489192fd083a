"""The second stage that verifies retrievals by local features at the images' original size."""

import pathlib
from collections.abc import Iterable, Sequence

import numpy as np

from crisalad_jax.data.images import read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.retrieval.reranking.second_stage import SecondStage
from crisalad_jax.retrieval.verification.verify import Verifier, order_by_inliers


class LocalReranker(SecondStage):
    """Re-ranks the first neighbours of each query by similarity and inliers together.

    In the result, the number of inliers replaces the similarity of each re-ranked neighbour.
    """

    def __init__(
        self,
        verifier: Verifier,
        database: Sequence[pathlib.Path],
        queries: Sequence[pathlib.Path],
        reading: Reading,
    ) -> None:
        """Prepare the second stage for these images."""
        super().__init__("local", verifier.verify.answers, reading)
        self._verifier, self._database, self._queries = verifier, database, queries

    def compare(self, query: int, candidates: Sequence[int]) -> Iterable[int]:
        """Count the inliers between a query and each candidate; all are given by index."""
        if not candidates:
            return []
        files = [self._database[each] for each in candidates]
        image = read_image(self._queries[query], bit_depth="contrast-stretch")
        checks = self._verifier.check(image, [(str(f.parent), f.name) for f in files])
        return [check.inliers for check in checks]

    def order(self, scores: np.ndarray, similarities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Order candidates by similarity and inliers (the scores), as `order_by_inliers` does."""
        return order_by_inliers(similarities, scores), scores
