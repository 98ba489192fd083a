"""Tables by their numbers, pictures by their size and by the colours where something must stand."""

import cv2
import numpy as np
import pytest
from rich.console import Console

from crisalad_jax import report
from crisalad_jax.errors import InputError

GREEN = (0x2A, 0x8F, 0x3C)
RED = (0xC6, 0x28, 0x28)
BLUE = (0x00, 0x72, 0xB2)
ORANGE = (0xD5, 0x5E, 0x00)

ROWS = [
    report.RecallRow("streets", "HOG", "single", {1: 0.405, 5: 0.6126}),
    report.RecallRow("streets", "trained [seed 0]", "shuffled", {1: 0.5, 5: 1.0, 10: 1.0}),
    report.RecallRow("a|b", "trained [seed 0]", "single", {1: 0.0, 5: 0.0704}),
]


def _read(path):
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def _is(picture, colour):
    return (picture == np.array(colour, np.uint8)).all(axis=-1)


def _near(picture, colour):
    # 40 grey levels: thin lines are blended with the white around them.
    return (np.abs(picture.astype(int) - colour) < 40).all(axis=-1)


def _boxes(picture, colour):
    """(left, top, width, height) of every frame of a colour; letters are narrower."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(_is(picture, colour).astype(np.uint8))
    return sorted(tuple(map(int, s[:4])) for s in stats[1:] if s[2] > 40)


@pytest.fixture
def photographs(tmp_path):
    """Six database pictures and four queries, each of one blue-grey level, 60 x 80."""
    files = {}
    for part, count in (("database", 6), ("queries", 4)):
        files[part] = [tmp_path / part / f"{number}.png" for number in range(count)]
        (tmp_path / part).mkdir()
        for number, file in enumerate(files[part]):
            cv2.imwrite(str(file), np.full((60, 80, 3), (90, 20 * number + 60, 60), np.uint8))
    return files


def _gallery(photographs, path, indices, positives, **options):
    indices = np.array(indices)
    similarities = np.linspace(0.9, 0.1, indices.shape[1])[None].repeat(len(indices), axis=0)
    report.prediction_gallery(
        path,
        photographs["queries"][: len(indices)],
        photographs["database"],
        indices,
        similarities,
        positives and [np.array(p, np.int64) for p in positives],
        **options,
    )
    return _read(path)


def test_markdown_table_by_hand():
    assert report.recall_markdown(ROWS) == (
        "| data set | model | grouping | R@1 | R@5 | R@10 |\n"
        "| --- | --- | --- | ---: | ---: | ---: |\n"
        "| streets | HOG | single | 40.5 | 61.3 | - |\n"
        "| streets | trained [seed 0] | shuffled | 50.0 | 100.0 | 100.0 |\n"
        "| a\\|b | trained [seed 0] | single | 0.0 | 7.0 | - |\n"
    )


def test_terminal_table_has_the_same_numbers():
    console = Console(width=100, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(report.recall_table(ROWS, title="Recall"))
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


@pytest.mark.parametrize("table", [report.recall_table, report.recall_markdown])
def test_tables_reject_what_is_no_recall(table):
    with pytest.raises(InputError, match=r"^rows: found none"):
        table([])
    with pytest.raises(InputError, match=r"^streets, HOG: found recall 40.5 at 1"):
        table([report.RecallRow("streets", "HOG", "single", {1: 40.5})])
    with pytest.raises(InputError, match=r"found recall nan"):
        table([report.RecallRow("streets", "HOG", "single", {1: float("nan")})])


def test_recall_curves_are_drawn_in_order(tmp_path):
    path = tmp_path / "deep" / "curves.png"
    curves = {"low": {1: 0.1, 20: 0.3}, "high": {1: 0.6, 20: 0.9}}
    report.recall_curves(path, curves, "Recall")
    picture = _read(path)
    assert picture.shape == (540, 840, 3)  # 7 x 4.5 inches at 120 dots
    blue, orange = (np.argwhere(_near(picture, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert len(orange) > 500
    # The first curve is blue and lower, all along.
    assert orange[:, 0].max() < blue[:, 0].min()
    assert [file.name for file in path.parent.iterdir()] == ["curves.png"]


def test_nothing_touches_the_edge(tmp_path):
    names = [f"a model with quite a long name, seed {seed}" for seed in range(9)]
    curves = {name: {1: 0.9, 5: 0.99, 10: 1.0, 20: 1.0} for name in names}
    report.recall_curves(tmp_path / "curves.png", curves, "A title beyond any measure " * 8)
    picture = _read(tmp_path / "curves.png")
    for edge in (picture[:4], picture[-4:], picture[:, :4], picture[:, -4:]):
        assert (edge == 255).all()


def test_names_beside_curves_are_spread():
    # Two that are too close move apart alike, one alone stays.
    assert report._spread([50.0, 49.0, 10.0], 6.0, 0.0, 100.0) == pytest.approx([52.5, 46.5, 10])
    # At the top they move down, in order; 0.1 is the hundredth of a gap at which it stops.
    assert report._spread([100.0] * 3, 10.0, 0.0, 100.0) == pytest.approx([80, 90, 100], abs=0.1)
    # More than fit share the height.
    crowd = report._spread([3.0] * 8, 40.0, 0.0, 80.0)
    assert np.diff(crowd) == pytest.approx([10] * 7, abs=1)
    assert min(crowd) >= 0
    assert max(crowd) <= 80


def test_curves_reject_nothing_and_percent(tmp_path):
    path = tmp_path / "curves.png"
    for curves, message in (
        ({}, r"^curves: found none"),
        ({"HOG": {}}, r"^HOG: found no recalls"),
        ({"HOG": {1: 59.2}}, r"^HOG: found recall 59.2 at 1"),
    ):
        with pytest.raises(InputError, match=message):
            report.recall_curves(path, curves, "Recall")
    assert not path.exists()


def test_training_curves_draw_what_the_records_hold(tmp_path):
    training = [
        {"step": s, "loss": 1 / (1 + s), "b_acc": 0.5, "learning_rate": 1e-3} for s in range(90)
    ]
    validation = [{"step": s, "R@1": s / 100, "R@5": 0.95} for s in (10, 50, 80)]
    heights = {}
    for name, records in (
        ("both", training + validation),
        ("training", training),
        ("validation", validation),
        ("once", training[:1]),
    ):
        report.training_curves(tmp_path / f"{name}.png", records, title="tiny")
        picture = _read(tmp_path / f"{name}.png")
        assert picture.shape[1] == 840
        assert _near(picture, BLUE).any()
        # R@5 is the second line of the recalls.
        assert _near(picture, ORANGE).any() == (name in ("both", "validation"))
        heights[name] = len(picture)
    assert heights["both"] > heights["training"] == heights["once"] > heights["validation"]


def test_training_curves_reject_what_they_cannot_draw(tmp_path):
    for records, message in (
        ([], r"^records: found 0 without any of loss"),
        ([{"step": 1, "images_per_second": 3.0}], r"^records: found 1 without any of loss"),
        ([{"step": 1, "loss": 1.0}, {"loss": 2.0}], r"^records: number 1 has no step, only loss"),
        ([{"step": 7, "R@1": 45.0}], r"^R@1: found recall 45.0 at 7"),
    ):
        with pytest.raises(InputError, match=message):
            report.training_curves(tmp_path / "curves.png", records)


def test_gallery_frames_are_green_where_right_and_red_where_wrong(photographs, tmp_path):
    picture = _gallery(
        photographs, tmp_path / "gallery.png", [[2, 1, 0], [3, 4, 5]], [[2, 0], [5]], title="T"
    )
    height, width = picture.shape[:2]
    # Four columns of 1.7 inches at 120 dots, three gaps and two margins, two rows of 4 : 3.
    assert 850 < width < 1000
    assert 400 < height < 600
    green, red = _boxes(picture, GREEN), _boxes(picture, RED)
    columns = sorted({left // 20 for left, *_ in green + red})
    found = np.full((2, 3), "?")
    for boxes, letter in ((green, "g"), (red, "r")):
        for left, top, *_ in boxes:
            found[int(top > height / 2), columns.index(left // 20)] = letter
    assert found.tolist() == [["g", "r", "g"], ["r", "r", "g"]]
    # Captions in the frame's colour stand below it.
    for boxes, colour in ((green, GREEN), (red, RED)):
        for left, top, _, box_height in boxes:
            below = picture[top + box_height + 1 : top + box_height + 25, left : left + 120]
            assert _near(below, colour).any()


def test_gallery_without_positives_is_neither_green_nor_red(photographs, tmp_path):
    """Two of four queries, from first to last, each with its own two pictures beside it."""
    indices = [[0, 5], [1, 4], [2, 3], [3, 2]]
    picture = _gallery(photographs, tmp_path / "g.png", indices, None, rows=2, columns=2)
    assert not _is(picture, GREEN).any()
    assert not _is(picture, RED).any()
    # Queries 0 and 3, in the colours of pictures 0 and 3; found: 0 and 5, 3 and 2.
    levels = [_is(picture, (60, 20 * number + 60, 90)).sum() for number in range(6)]
    assert levels[1] == levels[4] == 0
    assert levels[0] == levels[3] == 2 * levels[5] == 2 * levels[2] > 0


def test_gallery_shows_the_pictures_asked_for(photographs, tmp_path):
    picture = _gallery(photographs, tmp_path / "gallery.png", [[4, 1]], [[4]])
    # Query 0, then database 4 and 1, from left to right, in the colours they were written in.
    found = [
        np.argwhere(_is(picture, (60, 20 * number + 60, 90)))[:, 1].mean() for number in (0, 4, 1)
    ]
    assert found == sorted(found)


@pytest.mark.parametrize(
    ("right", "rows", "expected"),
    [
        ([1, 0, 1, 0, 1, 0], 4, [0, 4, 1, 5]),
        ([1, 0, 1, 0, 1, 0], 3, [0, 4, 1]),
        ([1, 1, 1, 1, 1, 0], 4, [0, 2, 4, 5]),
        ([0, 0, 0, 1, 0, 0], 4, [3, 0, 2, 5]),
        ([0, 0, 0], 2, [0, 2]),
        ([1, 1, 1], 8, [0, 1, 2]),
        ([1, 0], 1, [0]),
    ],
)
def test_gallery_takes_half_right_half_wrong(right, rows, expected):
    assert report._choose_queries(np.array(right, bool), rows) == expected


def test_gallery_is_deterministic_and_takes_mixed_sizes(photographs, tmp_path):
    for number, shape in enumerate(((900, 300, 3), (100, 2500, 3), (1, 1, 3))):
        cv2.imwrite(str(photographs["database"][number]), np.full(shape, 77, np.uint8))
    arguments = [[0, 1, 2, 3]] * 4, [[1], [], [3], [0]]
    first, second = (
        _gallery(photographs, tmp_path / f"{name}.png", *arguments, rows=9, columns=9)
        for name in "ab"
    )
    np.testing.assert_array_equal(first, second)
    assert len(_boxes(first, GREEN)) == 3
    # Pictures far from the usual shape stay within their row and column.
    edges = (first[:4], first[-4:], first[:, :4], first[:, -4:])
    assert all((edge == 255).all() for edge in edges)


def test_gallery_rejects_what_does_not_fit(photographs, tmp_path):
    path = tmp_path / "gallery.png"
    for indices, positives, options, message in (
        (np.zeros((0, 2), int), [], {}, r"^indices: found shape \(0, 2\)"),
        ([[0, 6]], [[0]], {}, r"^indices: found 0 to 6, expected 0 to 5"),
        ([[-1, 0]], [[0]], {}, r"^indices: found -1 to 0"),
        ([[0, 1]], [[0], [1]], {}, r"^positives: found 2, expected 1"),
        ([[0, 1]], [[0]], {"rows": 0}, r"^rows: found 0"),
        ([[0, 1]], [[0]], {"columns": 0}, r"^columns: found 0"),
    ):
        with pytest.raises(InputError, match=message):
            _gallery(photographs, path, indices, positives, **options)
    photographs["database"][1].write_bytes(b"")
    with pytest.raises(InputError, match=r"database.1\.png: found an empty file"):
        _gallery(photographs, path, [[0, 1]], [[0]])
    assert not path.exists()
