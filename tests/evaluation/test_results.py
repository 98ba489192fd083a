"""Summaries of hand-made rankings; the table by its cells, the JSON by its numbers."""

import json

import numpy as np
import pytest
from rich.console import Console

from crisalad_jax.evaluation.difference import paired_difference
from crisalad_jax.evaluation.metrics import Interval, bootstrap_interval
from crisalad_jax.evaluation.results import ANY, GroupingResult, over_single, summarise, to_json
from crisalad_jax.experiments.result_tables import grouping_table, leakage_table
from crisalad_jax.retrieval.neighbours import Neighbours

KS = (1, 2)
# Five queries, the last without a positive.
POSITIVES = [np.array(p, np.int64) for p in ([0], [0], [0], [0], [])]


def ranking(first: list[int], similarities: list[float]) -> Neighbours:
    """Each query's first database image, then the other of two."""
    indices = np.array([[one, 1 - one] for one in first])
    values = np.array([[value, 0.1] for value in similarities], np.float32)
    return Neighbours(indices, values)


# Right at ranks 1 1 1 2 -, and 1 1 2 2 -: the wrong ones at 0.5 and 0.4, then at 0.85, 0.5, 0.4.
RANKINGS = {
    3: ranking([0, 0, 0, 1, 0], [0.9, 0.8, 0.7, 0.5, 0.4]),
    5: ranking([0, 0, 1, 1, 1], [0.9, 0.8, 0.85, 0.5, 0.4]),
}


def summary(grouping: str, rankings, **known) -> GroupingResult:
    return summarise(grouping, rankings, POSITIVES, KS, is_random=grouping == "shuffled", **known)


@pytest.fixture
def results() -> list[GroupingResult]:
    return [
        summary("single", {3: RANKINGS[3]}),
        summary("shuffled", RANKINGS, query_share=0.25, database_share=1.0, mirrored_share=0.5),
        summary("window/single", {3: RANKINGS[5]}, query_share=0.5),
    ]


def test_one_ranking_by_hand(results):
    single, _, window = results
    assert single.recalls == {1: 3 / 5, 2: 4 / 5}
    assert single.intervals == {
        1: bootstrap_interval(np.array([1, 1, 1, 0, 0])),
        2: bootstrap_interval(np.array([1, 1, 1, 1, 0])),
    }
    # Of the four that have a positive.
    assert single.recall_at_full_precision == single.average_precision == 3 / 4
    assert window.recall_at_full_precision == 1 / 4
    assert window.average_precision == pytest.approx(1 / 4 + 1 / 4 * 2 / 3, rel=1e-15)
    assert (single.spread, dict(single.by_seed)) == (None, {})
    assert single.neighbours is RANKINGS[3]


def test_several_rankings_by_hand(results):
    shuffled = results[1]
    assert shuffled.recalls == {1: 1 / 2, 2: 4 / 5}
    assert shuffled.intervals[1] == bootstrap_interval(np.array([2, 2, 1, 0, 0]), trials=2)
    assert shuffled.recall_at_full_precision == 1 / 2
    # Of two numbers the sample deviation is their distance over the root of two.
    assert shuffled.spread.recalls[1] == pytest.approx(0.2 / np.sqrt(2), rel=1e-14)
    assert shuffled.spread.recalls[2] == 0
    assert shuffled.spread.recall_at_full_precision == pytest.approx(0.5 / np.sqrt(2), rel=1e-14)
    assert {seed: scores.recalls[1] for seed, scores in shuffled.by_seed.items()} == {
        3: 3 / 5,
        5: 2 / 5,
    }
    assert shuffled.neighbours is RANKINGS[3]
    assert shuffled.precision_recall.recall_at_full_precision == 3 / 4


def test_without_a_positive_there_is_no_curve():
    nothing = [np.array([], np.int64)] * 5
    result = summarise("shuffled", RANKINGS, nothing, KS, is_random=True)
    assert result.recalls == {1: 0, 2: 0}
    assert result.precision_recall is result.average_precision is None
    assert result.spread.recall_at_full_precision is None


def cells_of(results, width: int, table=grouping_table) -> list[list[str]]:
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(table(results).terminal())
    return [
        [cell.strip() for cell in line.strip("│┃").replace("┃", "│").split("│")]
        for line in capture.get().splitlines()
        if line[0] in "│┃"
    ]


def test_the_table_has_these_cells(results):
    lines = cells_of(results, 100)
    assert lines == [
        ["queries/", "R@1", "R@2", "", "R at"],
        ["database", "95 %", "95 %", "AP", "100 % P"],
        ["single", "60.0", "80.0", "75.0", "75.0"],
        ["", "20.0-100.0", "40.0-100.0", "", ""],
        ["shuffled", "50.0 ±14.1", "80.0 ±0.0", "58.3", "50.0"],
        ["", "10.0-90.0", "40.0-100.0", "±23.6", "±35.4"],
        ["window/single", "40.0", "80.0", "41.7", "25.0"],
        ["", "0.0-80.0", "40.0-100.0", "", ""],
    ]


def test_what_a_grouping_gives_over_images_alone(results):
    alone = np.array([[1, 1, 1, 0, 0]], bool)
    np.testing.assert_array_equal(results[0].firsts, alone)
    compared = over_single([*results, results[2]._replace(rerank="transvpr:2")])
    single, shuffled, window, reranked = (each.over_single for each in compared)
    assert single is reranked is None  # of another second stage than any row alone
    hits = np.array([[1, 1, 1, 0, 0], [1, 1, 0, 0, 0]], bool)
    assert shuffled == paired_difference(hits, alone, same_seeds=False)
    assert window.mean == pytest.approx(-1 / 5, rel=1e-14)
    assert cells_of(compared[:3], 100, leakage_table)[:4] == [
        ["queries/", "", "points over", "same place", ""],
        ["database", "R@1", "single, 95 %", "q / db", "mirrored"],
        ["single", "60.0", "-", "- / -", "-"],
        ["shuffled", "50.0", "-10.0", "25.0 / 100.0", "50.0"],
    ]
    assert to_json(compared[2])["over_single"]["R@1"] == window.mean


def test_the_table_of_four_recalls_fits_a_hundred_columns():
    result = GroupingResult(
        "window/single",
        dict.fromkeys((1, 5, 10, 20), 0.123),
        RANKINGS[3],
        dict.fromkeys((1, 5, 10, 20), Interval(0.101, 0.999)),
        0.123,
        0.123,
        average_precision=0.5,
        recall_at_full_precision=0.5,
    )
    (row, below) = cells_of([result], 100)[2:]
    assert row[:2] == ["window/single", "12.3"]
    assert below[1:5] == ["10.1-99.9"] * 4


def test_json_has_everything_but_the_neighbours(results):
    single, shuffled, window = json.loads(json.dumps([to_json(result) for result in results]))
    assert (window["queries"], window["database"]) == ("window", "single")
    assert window["same_place"] == {"queries": 0.5, "database": None}
    assert single["recalls"] == {"R@1": 0.6, "R@2": 0.8}
    assert single["intervals"]["R@1"] == [0.2, 1.0]
    assert (single["spread"], single["by_seed"]) == (None, {})
    assert single["precision_recall"] == {
        "thresholds": [float(np.float32(value)) for value in (0.9, 0.8, 0.7, 0.5, 0.4)],
        "precision": [1, 1, 1, 3 / 4, 3 / 5],
        "recall": [1 / 4, 2 / 4, 3 / 4, 3 / 4, 3 / 4],
    }
    assert shuffled["by_seed"]["5"] == {
        "recalls": {"R@1": 0.4, "R@2": 0.8},
        "average_precision": results[2].average_precision,
        "recall_at_full_precision": 0.25,
    }
    assert shuffled["spread"]["recalls"]["R@2"] == 0
    any_ = to_json(results[0]._replace(grouping=ANY))
    assert (any_["grouping"], any_["queries"], any_["database"]) == (ANY, ANY, ANY)
