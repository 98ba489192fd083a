"""Tables by their numbers."""

from rich.console import Console

from crisalad_jax.experiments import report
from crisalad_jax.experiments.tables import Cell, Table

DASH = "\N{EN DASH}"
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


def test_latex_by_hand():
    """Every letter that LaTeX reads otherwise; dashes between numbers, but not in names."""
    rows = [
        [Cell("lr-1e-4"), Cell("62.5", "± 1.2\n(40.0-80.0)", "best"), Cell("+4.5", "better")],
        [Cell("[a]_b & c%"), Cell("-0.1", f"-3{DASH}1"), Cell("-")],
        [Cell("*2024-05 \\x{~^|<>$#}\x1b"), Cell(""), Cell("none", "0-1")],
    ]
    table = Table(["row", "R@1\n95 %", "Δ R@1"], rows, title="Of 100 %", summed=True)
    assert table.latex().splitlines() == [
        "% Of 100 %",
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"row & \shortstack[r]{R@1 \\ 95 \%} & $\Delta$ R@1 \\",
        r"\midrule",
        r"lr-1e-4 & \textbf{62.5} {\footnotesize $\pm$ 1.2 (40.0--80.0)}"
        r" & +4.5 {\footnotesize better} \\",
        r"{[}a{]}\_b \& c\% & $-$0.1 {\footnotesize $-$3--1} & - \\",
        r"\midrule",
        r"{*}2024-05 \textbackslash{}x\{\textasciitilde{}\textasciicircum{}\textbar{}"
        r"\textless{}\textgreater{}\$\#\}\textbackslash{}x1b &  & none {\footnotesize 0--1} \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_latex_of_groups_has_a_rule_between_them():
    lines = report.recall_table(ROWS).latex().splitlines()
    assert lines[0] == r"\begin{tabular}{lllrrr}"
    assert lines[4:8] == [
        r"streets & HOG & single & 40.5 & 61.3 & - \\",
        r"streets & trained {[}seed 0{]} & shuffled & 50.0 & 100.0 & 100.0 \\",
        r"\midrule",
        r"a\textbar{}b & trained {[}seed 0{]} & single & 0.0 & 7.0 & - \\",
    ]


def test_words_are_at_the_left_and_numbers_at_the_right():
    rows = [[Cell(text), Cell("x"), Cell("1")] for text in ("a", "b")]
    table = Table(["first", "second", "number"], rows, labels=2).terminal()
    assert [column.justify for column in table.columns] == ["left", "left", "right"]
    assert not any(row.end_section for row in table.rows)  # two labels part no groups
