"""FoL's local features and scores against torch and loops; the public code's are in parity/."""

import jax
import numpy as np
import pytest
import torch

from crisalad_jax.retrieval.reranking import fol
from tests.retrieval.reranking.test_stage import FOL


def test_cells_are_enlarged_as_by_torch() -> None:
    for source in range(1, 80):
        target = 4 * source - 3
        cells = torch.arange(source, dtype=torch.float32)[None, None]
        expected = torch.nn.functional.interpolate(cells, size=target, mode="nearest")
        np.testing.assert_array_equal(fol._nearest(source, target), expected[0, 0])


def test_features_of_the_chosen_patches_come_in_row_order() -> None:
    rng, grid = np.random.default_rng(0), (19, 15)
    confidence = rng.permutation(19 * 15).astype(np.float32)
    local = rng.normal(size=(73, 57, 3)).astype(np.float32)
    mask = torch.from_numpy((confidence >= 19 * 15 - 225).reshape(1, 1, *grid)).float()
    wide = torch.nn.functional.interpolate(mask, size=(73, 57), mode="nearest")[0, 0].bool()
    expected = local[wide.numpy()]
    found = np.asarray(jax.jit(fol.chosen_features)(confidence, local))
    assert found.shape == (3600, 3)
    np.testing.assert_array_equal(found[: len(expected)], expected)
    assert not found[len(expected) :].any()


def test_the_most_confident_do_not_count_as_they_are() -> None:
    plan = np.random.default_rng(0).random((56, 5)).astype(np.float32)
    masses = plan[:, :4].mean(axis=1)
    falling = np.argsort(-masses)
    expected = masses.copy()
    expected[falling[:3]] = masses[falling[2]]  # of 56, 0.05 times 56 exceed it
    found = np.asarray(jax.jit(fol.confidence)(plan))
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # float32 sums of four numbers
    assert (found < masses).sum() == 2


@pytest.mark.parametrize(("matches", "score"), [(0, 0), (1, 0), (2, 2), (3, 3)])
def test_one_match_alone_counts_as_none(matches: int, score: int) -> None:
    """Axes match themselves; elsewhere the cosine to the nearest is 0.69, which is too little."""
    query = np.eye(4, 9, dtype=np.float32)
    candidate = np.eye(4, 9, dtype=np.float32)
    for row in range(matches, 4):
        candidate[row] = 0
        candidate[row, [row, row + 5]] = 0.69, np.sqrt(1 - 0.69**2)
    query, candidate = (np.pad(each, ((0, 2), (0, 0))) for each in (query, candidate))
    assert fol.count_matches(query, candidate[None], FOL).tolist() == [score]
    near = np.where(candidate == np.float32(0.69), 0.71, candidate)
    assert fol.count_matches(query, near[None], FOL).tolist() == [4]
