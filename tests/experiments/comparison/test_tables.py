"""Tables of hand-made results, to the letter."""

import csv
import json
import types

import pytest

from crisalad_jax.evaluation.difference import Difference
from crisalad_jax.evaluation.metrics import Interval
from crisalad_jax.experiments.comparison import AdapterCost, Recall, Row, Summary, tables
from crisalad_jax.experiments.comparison.results import Spread

ONE = Recall(0.625, 0.125, Interval(0.4, 0.8), (0.75, 0.5))
LONE = Recall(0.25, None, Interval(0.1, 0.4), (0.25,))


def row(name, grouping, recall, **changes):
    values = {
        "labels": (name.title(),),
        "dimension": 8448,
        "recalls": {"town": dict.fromkeys((1, 5, 10), recall)},
        "speed": 1.25,
        "images_per_second": None,
        "parameters": 1_000_000,
        "trained": 10_000,
        "training": Spread(0.5, 0.4, 0.75),
        "training_seconds": Spread(90.0, 84.0, 120.0),
    }
    return Row(name=name, grouping=grouping, **values | changes)


SUMMARY = Summary(
    "compare",
    ("method",),
    "First",
    {"town": types.SimpleNamespace(name="town", queries=[0], database=[0], rule="within 25 m")},
    [
        row("first", "single", ONE),
        row("first", "shuffled", ONE),
        row("a|b", "any", LONE, trained=None, training=None),
    ],
    ["A note."],
    [],
    {},
)


def test_markdown():
    recalls = "| 62.5 ± 12.5 (40.0-80.0) " * 3
    assert list(tables.tables_of(SUMMARY._replace(rows=SUMMARY.rows[:1]))) == ["recall", "costs"]
    costs = "| 8,448 | 1.25 x | 1,000,000 | 10,000 | 0.50 x (0.40 to 0.75) |"
    assert tables.markdown(SUMMARY).splitlines() == [
        "| method | town R@1 | town R@5 | town R@10 |",
        "| --- | ---: | ---: | ---: |",
        f"| First, single {recalls}|",
        f"| First, shuffled {recalls}|",
        r"| A\|B " + "| 25.0 (10.0-40.0) " * 3 + "|",
        "",
        "| method | dimension | images/s | parameters | trained | training time |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
        f"| First {costs}",
        r"| A\|B | 8,448 | 1.25 x | 1,000,000 | - | - |",
        "",
        "A note.",
    ]


def test_latex_has_the_best_in_bold_and_every_interval():
    lines = tables.tables_of(SUMMARY)["recall"].latex().splitlines()
    best = r" & \textbf{62.5} {\footnotesize $\pm$ 12.5 (40.0--80.0)}" * 3
    other = r" & 25.0 {\footnotesize (10.0--40.0)}" * 3
    assert lines[4:-2] == [
        rf"First, single{best} \\",
        rf"First, shuffled{best} \\",
        rf"A\textbar{{}}B{other} \\",
    ]


@pytest.mark.parametrize(("images", "speed"), [(None, "1.25 x"), (427.4, "427")])
def test_on_a_gpu_times_are_absolute_and_need_a_spread(images, speed):
    given = row("first", "single", ONE, images_per_second=images)
    time = "0.50 x (0.40 to 0.75)" if images is None else "1.5 min (1.4 to 2.0)"
    costs = ["8,448", speed, "1,000,000", "10,000"]
    assert list(tables.costs_of(given).values()) == [*costs, time]
    once = given._replace(training=None, training_seconds=None)
    assert list(tables.costs_of(once).values()) == [*costs, "-"]


def written(summary, folder):
    """The lines of table.csv."""
    tables.write_tables(summary, folder)
    with (folder / "table.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_csv_has_a_line_for_each_number(tmp_path):
    lines = written(SUMMARY, tmp_path)
    assert len(lines) == 3 * 3
    assert lines[0] == {
        **{"method": "First", "name": "first", "grouping": "single", "set": "town", "k": "1"},
        **{"recall": "0.625", "standard_deviation": "0.125", "low": "0.4", "high": "0.8"},
        **{"seeds": "2", "dimension": "8448", "speed": "1.25", "images_per_second": ""},
        **{"parameters": "1000000", "trained": "10000", "training": "0.5"},
        **{"training_least": "0.4", "training_most": "0.75"},
        **{"training_seconds": "90.0", "training_seconds_least": "84.0"},
        "training_seconds_most": "120.0",
        **dict.fromkeys(("difference", "difference_low", "difference_high", "verdict"), ""),
    }
    assert lines[-1]["standard_deviation"] == lines[-1]["training"] == ""


def test_a_row_that_changes_nothing_has_an_empty_cell_in_csv_and_a_hyphen_for_readers(tmp_path):
    plain = row("first", "single", LONE, labels=("base", ""))
    summary = SUMMARY._replace(headers=("row", "changed"), rows=[plain])
    lines = written(summary, tmp_path)
    assert [line["changed"] for line in lines] == ["", "", ""]
    assert not {"-", "'-", "\N{EM DASH}"} & {cell for line in lines for cell in line.values()}
    assert tables.markdown(summary).splitlines()[2].startswith("| base | - | 25.0")


def test_on_a_narrow_page_what_a_row_changes_stands_below_its_name(tmp_path):
    """A column of its own pushed all recalls out of sight, at 390 pixels."""
    words = "model.aggregator=gem, <b>"
    plain = row("first", "single", LONE, labels=("base", words))
    summary = SUMMARY._replace(kind="ablate", headers=("row", "changed"), rows=[plain])
    tables.write_tables(summary, tmp_path)
    page = (tmp_path / "index.html").read_text()
    shown = "model.<wbr>aggregator=gem, &lt;b&gt;"
    assert f'base<small class="under">{shown}</small></th>' in page
    assert f'<td class="label">{shown}</td>' in page


@pytest.mark.parametrize(
    ("cost", "line"),
    [
        (
            AdapterCost(
                *("depthwise", 741_504, 741_504, 39_223_296, 190_218_240),
                time=Spread(1.2, 1.1, 1.3),
                memory=1.5,
            ),
            "| depthwise | 741,504 | 741,504 | 39.223 | 78.447 | 190.2 | 1.20 x (1.10 to 1.30) "
            "| 1.50 x |",
        ),
        (  # what the paper prints, and no count gives
            AdapterCost("mlp", 590_976, 590_976, 1_180_800, 151_584_768, None, None),
            "| mlp | 590,976 (printed: 2,356,080) | 590,976 | 1.181 | 2.362 | 151.6 | - | - |",
        ),
    ],
)
def test_table_3_in_markdown(cost, line):
    assert line in tables.markdown(SUMMARY._replace(adapters=[cost])).splitlines()


BETTER = Difference(0.0449, Interval(0.004, 0.0861), "better")
UNTOLD = Difference(-0.0001, Interval(-0.1, 0.1), "inconclusive")
WORSE = Difference(-0.25, Interval(-0.5, -0.01), "worse")
DIFFERENCES = {1: BETTER, 5: UNTOLD, 10: WORSE}
DIFFERENT = {k: LONE._replace(difference=each) for k, each in DIFFERENCES.items()}
COMPARED = SUMMARY._replace(
    rows=[
        row("first", "single", ONE),
        row("other", "single", LONE, recalls={"town": DIFFERENT}),
    ],
)


def test_differences_in_markdown_csv_and_json(tmp_path):
    assert tables.markdown(COMPARED).splitlines()[5:8] == [
        "| method, less First | town Δ R@1 | town Δ R@5 | town Δ R@10 |",
        "| --- | ---: | ---: | ---: |",
        "| Other | +4.5 (+0.4 to +8.6) better | +0.0 (-10.0 to +10.0) inconclusive "
        "| -25.0 (-50.0 to -1.0) worse |",
    ]
    lines = written(COMPARED, tmp_path)
    verdicts = ["", "", "", "better", "inconclusive", "worse"]
    assert [line["verdict"] for line in lines] == verdicts
    names = ("difference", "difference_low", "difference_high")
    assert [lines[3][name] for name in names] == ["0.0449", "0.004", "0.0861"]
    first, second = json.loads(json.dumps(tables.as_json(COMPARED)))["rows"]
    assert first["recalls"]["town"]["R@10"] == {
        "mean": 0.625,
        "spread": 0.125,
        "interval": {"low": 0.4, "high": 0.8},
        "by_seed": [0.75, 0.5],
        "difference": None,
    }
    assert second["recalls"]["town"]["R@10"]["difference"] == {
        "mean": -0.25,
        "interval": {"low": -0.5, "high": -0.01},
        "verdict": "worse",
    }
