"""results.csv against results that were worked out by hand."""

import csv
import dataclasses
import pathlib

import numpy as np

from crisalad_jax.experiments.report.results_table import page_rows, write_results
from crisalad_jax.experiments.report.sections import Subject
from tests.experiments.report.test_page import GROUPINGS, NEIGHBOURS, small


def subject_of(benchmark, tmp_path, **changes):
    some = dataclasses.replace(small(benchmark), root=tmp_path, **changes)
    return Subject.of(tmp_path, some, NEIGHBOURS)


def test_a_row_for_every_query_and_grouping(benchmark, tmp_path: pathlib.Path):
    queries = tuple(tmp_path / "a" / name for name in ("=1+1.jpg", "b,\x1b.jpg", "c.jpg"))
    database = tuple(tmp_path / "d" / f"{number}.jpg" for number in range(3))
    subject = subject_of(benchmark, tmp_path, queries=queries, database=database)
    write_results(tmp_path / "results.csv", subject, GROUPINGS)
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["grouping"], row["query"]) for row in rows] == [
        (grouping, name)
        for grouping in ("single", "shuffled/single")
        for name in ("a/=1+1.jpg", "a/b,\\x1b.jpg", "a/c.jpg")
    ]
    found = [tuple(row.values())[3:] for row in rows[:3]]
    # The first is right at once, the second's image 1 stands third, the third has none to find.
    # Queries are at 3, 45 and 9,000 m, and the database at 0, 40 and 80 m.
    assert found == [
        ("right", "1", "d/0.jpg", "0.910000", "3.00"),
        ("wrong", "3", "d/2.jpg", "0.820000", "35.00"),
        ("no positive", "", "d/1.jpg", "0.730000", "8960.00"),
    ]
    assert page_rows(subject, GROUPINGS[0]) == [
        ["=1+1.jpg", 2, 1, "0.jpg", 0.91, 3.0],
        ["b,\\x1b.jpg", 0, 3, "2.jpg", 0.82, 35.0],
        ["c.jpg", 1, None, "1.jpg", 0.73, 8960.0],
    ]


def test_a_name_that_begins_as_a_formula_is_quoted(benchmark, tmp_path: pathlib.Path):
    queries = (tmp_path / "=HYPERLINK(1).jpg", tmp_path / "@b.jpg", tmp_path / "c.jpg")
    subject = subject_of(benchmark, tmp_path, queries=queries)
    write_results(tmp_path / "results.csv", subject, GROUPINGS[:1])
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as file:
        names = [row["query"] for row in csv.DictReader(file)]
    assert names == ["'=HYPERLINK(1).jpg", "'@b.jpg", "c.jpg"]


def test_a_placeholder_has_no_distance(benchmark, tmp_path: pathlib.Path):
    city = np.array([5e5, 5e6]) + np.array([[0.0, 0], [40, 0], [80, 0]])
    asked = city + np.array([[3.0, 0], [5, 0], [0, 0]])
    asked[2] = 0
    subject = subject_of(benchmark, tmp_path, database_positions=city, query_positions=asked)
    metres = [row[-1] for row in page_rows(subject, GROUPINGS[0])]
    assert metres == [3.0, 35.0, None]
    without = subject_of(benchmark, tmp_path, query_positions=None)
    assert [row[-1] for row in page_rows(without, GROUPINGS[0])] == [None] * 3
