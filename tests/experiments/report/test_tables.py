"""Tables by their numbers."""

from rich.console import Console

from crisalad_jax.experiments import report
from crisalad_jax.experiments.report.tables import Cell, Table

ROWS = [
    report.RecallRow("streets", "HOG", "single", {1: 0.405, 5: 0.6126}),
    report.RecallRow("streets", "trained [seed 0]", "shuffled", {1: 0.5, 5: 1.0, 10: 1.0}),
    report.RecallRow("a|b", "trained [seed 0]", "single", {1: 0.0, 5: 0.0704}),
]


def test_markdown_table_by_hand():
    assert report.recall_table(ROWS).markdown() == (
        "| data set | model | grouping | R@1 | R@5 | R@10 |\n"
        "| --- | --- | --- | ---: | ---: | ---: |\n"
        "| streets | HOG | single | 40.5 | 61.3 | - |\n"
        "| streets | trained [seed 0] | shuffled | 50.0 | 100.0 | 100.0 |\n"
        "| a\\|b | trained [seed 0] | single | 0.0 | 7.0 | - |\n"
    )


def test_terminal_table_has_the_same_numbers():
    console = Console(width=100, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(report.recall_table(ROWS, title="Recall").terminal())
    lines = capture.get().splitlines()
    assert lines[0].strip() == "Recall"
    cells = [
        [cell.strip() for cell in line.strip("│┃ ").replace("┃", "│").split("│")]
        for line in lines
        if "R@1" in line or "single" in line or "shuffled" in line
    ]
    assert cells == [
        ["data set", "model", "grouping", "R@1", "R@5", "R@10"],
        ["streets", "HOG", "single", "40.5", "61.3", "-"],
        ["streets", "trained [seed 0]", "shuffled", "50.0", "100.0", "100.0"],
        ["a|b", "trained [seed 0]", "single", "0.0", "7.0", "-"],
    ]
    rules = [number for number, line in enumerate(lines) if line.startswith("├")]
    assert rules == [6]  # between the two data sets, and nowhere else


def test_words_are_at_the_left_and_numbers_at_the_right():
    rows = [[Cell(text), Cell("x"), Cell("1")] for text in ("a", "b")]
    table = Table(["first", "second", "number"], rows, labels=2).terminal()
    assert [column.justify for column in table.columns] == ["left", "left", "right"]
    assert not any(row.end_section for row in table.rows)  # two labels part no groups
