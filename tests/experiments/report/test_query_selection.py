"""Which queries a page shows, by hand."""

import numpy as np

from crisalad_jax.experiments.report.query_selection import choose_shown, judge
from crisalad_jax.retrieval.neighbours import Neighbours


def test_verdicts_by_hand():
    indices = np.array([[0, 1], [1, 0], [2, 0], [2, 1]])
    positives = [np.array([0, 2]), np.array([0]), np.array([], int), np.array([2])]
    verdicts = judge(Neighbours(indices, np.zeros((4, 2), np.float32)), positives)
    assert verdicts.right.tolist() == [True, False, False, True]
    assert verdicts.matched.tolist() == [True, True, False, True]
    assert verdicts.wrong.tolist() == [False, True, False, False]


def test_the_most_confident_mistakes_come_first_and_right_ones_are_spread():
    indices = np.array([[0]] * 6 + [[1]] * 4 + [[1]])
    positives = [np.array([0])] * 10 + [np.array([], int)]
    similarities = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.2, 0.9, 0.2, 0.3, 0.1])
    verdicts = judge(Neighbours(indices, similarities[:, None].astype(np.float32)), positives)
    shown = choose_shown(similarities, verdicts, most=3)
    # Of six right ones the first, the last, and one of the two in the middle.
    assert shown.right == [0, 2, 5]
    # 6 and 8 are as similar: file order.
    assert shown.wrong == [7, 9, 6]
    assert shown.unmatched == [10]
    assert choose_shown(similarities, verdicts, most=3) == shown
    assert choose_shown(similarities, verdicts, most=50).wrong == [7, 9, 6, 8]
    assert choose_shown(similarities, verdicts, most=50).right == [0, 1, 2, 3, 4, 5]
