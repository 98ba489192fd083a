"""The page as a browser reads it: sections, numbers, pictures, and names that are no markup."""

import base64
import csv
import dataclasses
import html.parser
import json
import pathlib
import re
import shutil
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.metrics import Interval, precision_recall
from crisalad_jax.evaluation.results import GroupingResult, Scores
from crisalad_jax.experiments.report import recall_curves, write_report
from crisalad_jax.experiments.report.charts import outcomes_of
from crisalad_jax.experiments.report.page import Subject, page_rows, query_results
from crisalad_jax.experiments.tables import write_csv
from crisalad_jax.nn.model import Crisalad, Model
from crisalad_jax.retrieval.neighbours import Neighbours
from tests.conftest import MODEL

VOID = {"meta", "link", "img", "br", "hr", "input", "source"}
EAST = [np.array([[e, 5e6] for e in side]) for side in ([0.0, 40, 80], [3.0, 45, 9000])]


class Page(html.parser.HTMLParser):
    """Elements with their attributes and the text inside; every tag must be closed in its turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[dict[str, Any]] = []
        self.elements: list[dict[str, Any]] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = {"tag": tag, "text": "", **dict(attrs)}
        self.elements.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop()["tag"] == tag

    def handle_data(self, data: str) -> None:
        for element in self.open:
            element["text"] += data

    def all(self, tag: str, **attributes: str) -> list[dict[str, Any]]:
        wanted = {"tag": tag, **attributes}
        return [e for e in self.elements if all(e.get(k) == v for k, v in wanted.items())]


def small(benchmark: Benchmark, database: int = 3, queries: int = 3) -> Benchmark:
    """Some of the town; the last query has nothing to find, the second is retrieved wrongly."""
    return dataclasses.replace(
        benchmark,
        database=benchmark.database[:database],
        queries=(*benchmark.queries[: queries - 1], benchmark.queries[-1]),
        positives=POSITIVES,
        database_positions=EAST[0],
        query_positions=EAST[1],
    )


POSITIVES = (np.array([0]), np.array([1]), np.array([], int))
NEIGHBOURS = Neighbours(
    np.array([[0, 1, 2], [2, 0, 1], [1, 2, 0]]),
    np.array([[0.91, 0.5, 0.4], [0.82, 0.6, 0.3], [0.73, 0.2, 0.1]], np.float32),
)
GROUPINGS = [
    GroupingResult(
        "single",
        {1: 1 / 3, 5: 2 / 3},
        NEIGHBOURS,
        intervals={1: Interval(0.1, 0.5), 5: Interval(0.4, 0.9)},
        query_share=0.0,
        precision_recall=precision_recall(*NEIGHBOURS, POSITIVES),
        average_precision=0.4,
        recall_at_full_precision=0.5,
    ),
    GroupingResult(
        "shuffled/single",
        {1: 0.25, 5: 0.75},
        NEIGHBOURS,
        intervals={1: Interval(0.2, 0.3), 5: Interval(0.7, 0.8)},
        spread=Scores({1: 0.0125, 5: 0.02}, None, None),
    ),
]


def write(out, benchmark, groupings, params, config=MODEL, **options):
    settings = {"batch_size": 8, "seeds": 2, "same_place": "</pre><script>"}
    given = {"model_name": "a <b>model</b>", "settings": settings}
    return write_report(out, benchmark, groupings, model=Model(params, config), **given, **options)


@pytest.fixture(scope="module")
def written(
    benchmark: Benchmark, params: Crisalad, tmp_path_factory: pytest.TempPathFactory
) -> pathlib.Path:
    """The folder of a page with everything on it."""
    out, similarities = tmp_path_factory.mktemp("report") / "deep", np.eye(3, dtype=np.float32)
    path = write(out, small(benchmark), GROUPINGS, params, similarities=similarities)
    assert path == out / "index.html"
    return out


@pytest.fixture(scope="module")
def page(written: pathlib.Path) -> Page:
    return Page((written / "index.html").read_text(encoding="utf-8"))


def test_every_section_is_there_and_linked(page: Page):
    names = [e["id"] for e in page.all("section")]
    assert names == [
        *("recall", "queries", "right", "wrong", "no-positive"),
        *("map", "similarities", "transport", "settings"),
    ]
    assert {e["href"] for e in page.all("a")} == {f"#{name}" for name in names}
    assert [e["text"] for e in page.all("h1")] == ["town/test (@UTM, 25 m)"]


def test_nothing_is_asked_for_outside_of_the_page(written: pathlib.Path, page: Page):
    named = [element.get(name) for element in page.elements for name in ("src", "srcset", "href")]
    assert all(re.match("data:|#", each) for each in named if each is not None)
    style = page.all("style")[0]["text"]
    assert not re.search(r"url\(|@import", style)
    data, program = page.all("script")
    assert data["type"] == "application/json"
    assert not re.search(r"https?:|fetch|import|XMLHttp|innerHTML", program["text"])


def test_drawings_are_the_files_beside_the_page(written: pathlib.Path, page: Page):
    files = {path.name: path.read_bytes() for path in written.glob("*.png")}
    held = []
    for image in page.all("img"):
        assert image["alt"]
        kind, _, data = image["src"].partition(";base64,")
        data = base64.b64decode(data, validate=True)
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert decoded.shape[:2] == (int(image["height"]), int(image["width"]))
        if kind == "data:image/png":
            assert data in files.values()
            held.append(next(name for name, content in files.items() if content == data))
        else:
            assert kind == "data:image/webp"
    # Photographs are in the page alone.
    names = ("recall_curves.png", "precision_recall.png", "positions.png", "similarities.png")
    assert sorted(held) == sorted(files) == sorted(names)


def test_every_chart_is_a_vector_too(written: pathlib.Path):
    names = {path.stem for path in written.glob("*.png")}
    for name in names:
        height, width = cv2.imread(str(written / f"{name}.png")).shape[:2]
        points = [72 / 200 * each for each in (width, height)]  # of 200 pixels an inch
        svg = ElementTree.parse(written / f"{name}.svg").getroot()
        sides = [float(svg.attrib[each].removesuffix("pt")) for each in ("width", "height")]
        assert sides == pytest.approx(points, abs=0.4)  # a pixel is 0.36 points
        pdf = (written / f"{name}.pdf").read_bytes()
        (box,) = re.findall(rb"/MediaBox \[ 0 0 (\S+) (\S+) \]", pdf)
        assert [float(each) for each in box] == pytest.approx(points, abs=0.4)
    assert len(names) == 4
    for suffix in ("svg", "pdf"):
        assert {path.stem for path in written.glob(f"*.{suffix}")} == names


def test_a_figure_has_the_same_bytes_each_time(tmp_path: pathlib.Path):
    def written(name: str) -> bytes:
        recall_curves({"a $x^2$ \x1b": {1: 0.5, 5: 0.7}}).savefig(tmp_path / name)
        return (tmp_path / name).read_bytes()

    for suffix in ("png", "svg", "pdf"):
        assert written(f"a.{suffix}") == written(f"b.{suffix}")
    assert b"<dc:date>" not in written("a.svg")
    pdf = written("a.pdf")
    assert b"/CreationDate" not in pdf
    assert b"/Type3" not in pdf
    assert b"/CIDFontType2" in pdf  # TrueType


def test_the_table_holds_the_numbers(page: Page):
    headers = [" ".join(e["text"].split()) for e in page.all("th", scope="col")]
    assert headers == [
        *("queries/ database", "R@1 95 %", "R@5 95 %", "AP", "R at 100 % P"),
        *("queries/ database", "R@1", "points over single, 95 %", "same place q / db", "mirrored"),
    ]
    assert [e["text"] for e in page.all("th", scope="row")] == 2 * ["single", "shuffled/single"]
    assert [e["text"] for e in page.all("td")] == [
        *("33.310.0-50.0", "66.740.0-90.0", "40.0", "50.0"),
        *("25.0 ±1.220.0-30.0", "75.0 ±2.070.0-80.0", "-", "-"),
        *("33.3", "-", "0.0 / -", "-"),
        *("25.0", "-", "- / -", "-"),
    ]


def test_galleries_show_what_was_retrieved_with_distances(page: Page):
    captions = [" ".join(e["text"].split()) for e in page.all("figcaption")]
    assert captions == [
        *("query", "✓ 1 0.910 3 m", "✗ 2 0.500 37 m", "✗ 3 0.400 77 m"),
        *("query", "✗ 1 0.820 35 m", "✗ 2 0.600 45 m", "✓ 3 0.300 5 m"),
        "would be right rank 3 5 m",
        *("query", "✗ 1 0.730 8,960 m", "✗ 2 0.200 8,920 m", "✗ 3 0.100 9,000 m"),
    ]
    kinds = [e["class"] for e in page.all("figure") if not e["class"].startswith("drawing")]
    assert kinds[5:9] == ["wrong", "wrong", "right", "expected"]
    counts = ["Right 1 of 1", "Wrong 1 of 1", "Nothing to find 1 of 1"]
    assert [e["text"] for e in page.all("h2")][2:5] == counts


def test_words_from_outside_are_no_markup(
    benchmark: Benchmark, params: Crisalad, tmp_path: pathlib.Path
):
    name = "<script>alert('x')</script>\"onerror=&amp;.jpg".replace("/", "")
    shutil.copy(benchmark.queries[0], tmp_path / name)
    some = dataclasses.replace(
        small(benchmark),
        root=tmp_path,
        queries=(tmp_path / name, *benchmark.queries[1:3]),
        query_positions=None,
    )
    found = [GroupingResult("any", {1: 1.0}, NEIGHBOURS, {1: Interval(0.5, 1.0)})]
    plain = dataclasses.replace(params, aggregator=None, cross_image=None)
    encoder = "none"
    config = dataclasses.replace(MODEL, aggregator="class-token", cross_image=encoder)
    path = write(tmp_path / "out", some, found, plain, config)
    page = Page(path.read_text(encoding="utf-8"))
    assert len(page.all("script")) == 2
    (data,) = page.all("script", id="results")
    assert json.loads(data["text"])["rows"][0][0] == name
    assert not any("onerror" in key for element in page.elements for key in element)
    assert any(e["alt"] == f"query: {name}" for e in page.all("img"))
    assert [e["text"] for e in page.all("p", **{"class": "model"})] == ["a <b>model</b>"]
    assert '"</pre><script>"' in page.all("pre")[0]["text"]
    # Of what this model and set lack there is no section, nor a word.
    names = [e["id"] for e in page.all("section")]
    assert names == ["recall", "queries", "right", "wrong", "no-positive", "settings"]
    assert [e["text"] for e in page.all("figcaption")][1].split() == ["✓", "1", "0.910"]


def subject_of(benchmark, root, **changes):
    return Subject.of(dataclasses.replace(small(benchmark), root=root, **changes), NEIGHBOURS)


def test_a_row_for_every_query_and_grouping(benchmark, tmp_path: pathlib.Path):
    """Control characters are escaped, and what begins as a formula is quoted."""
    queries = tuple(tmp_path / name for name in ("=1+1.jpg", "a/b,\x1b.jpg", "@c.jpg"))
    database = tuple(tmp_path / "d" / f"{number}.jpg" for number in range(3))
    subject = subject_of(benchmark, tmp_path, queries=queries, database=database)
    found = [row for grouping in GROUPINGS for row in query_results(subject, grouping)]
    write_csv(tmp_path / "results.csv", found)
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["grouping"], row["query"]) for row in rows] == [
        (grouping, name)
        for grouping in ("single", "shuffled/single")
        for name in ("'=1+1.jpg", "a/b,\\x1b.jpg", "'@c.jpg")
    ]
    # The first is right at once, the second's image 1 stands third, the third has none to find.
    # Queries are at 3, 45 and 9,000 m, and the database at 0, 40 and 80 m.
    assert [tuple(row.values())[3:] for row in rows[:3]] == [
        ("right", "1", "d/0.jpg", "0.91", "3.0"),
        ("wrong", "3", "d/2.jpg", "0.82", "35.0"),
        ("no positive", "", "d/1.jpg", "0.73", "8960.0"),
    ]
    assert page_rows(subject, GROUPINGS[0]) == [
        ["=1+1.jpg", 2, 1, "0.jpg", 0.91, 3.0],
        ["a/b,\\x1b.jpg", 0, 3, "2.jpg", 0.82, 35.0],
        ["@c.jpg", 1, None, "1.jpg", 0.73, 8960.0],
    ]


def test_a_placeholder_has_no_distance(benchmark, tmp_path: pathlib.Path):
    city = np.array([5e5, 5e6]) + np.array([[0.0, 0], [40, 0], [80, 0]])
    asked = city + np.array([[3.0, 0], [5, 0], [0, 0]])
    asked[2] = 0
    subject = subject_of(benchmark, tmp_path, database_positions=city, query_positions=asked)
    metres = [row[-1] for row in page_rows(subject, GROUPINGS[0])]
    assert metres == [3.0, 35.0, None]
    without = subject_of(benchmark, tmp_path, query_positions=None)
    assert [row[-1] for row in page_rows(without, GROUPINGS[0])] == [None] * 3


def test_the_most_confident_mistakes_come_first_and_right_ones_are_spread(benchmark):
    indices = np.array([[0]] * 6 + [[1]] * 4 + [[1]])
    positives = (*[np.array([0])] * 10, np.array([], int))
    similarities = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.2, 0.9, 0.2, 0.3, 0.1])
    neighbours = Neighbours(indices, similarities[:, None].astype(np.float32))
    subject = Subject(benchmark, neighbours, outcomes_of(neighbours, positives), None)
    # Of six right ones the first, the last, and one of the two in the middle. 6 and 8 are as
    # similar: file order.
    shown = {"right": [0, 2, 5], "wrong": [7, 9, 6], "no positive": [10]}
    assert subject.choose(3) == subject.choose(3) == shown
    assert subject.choose(50)["wrong"] == [7, 9, 6, 8]
    assert subject.choose(50)["right"] == [0, 1, 2, 3, 4, 5]
