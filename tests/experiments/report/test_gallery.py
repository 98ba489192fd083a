"""Galleries by their frames and the pictures in them."""

import shutil
import warnings

import cv2
import numpy as np
import pytest

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments import report
from crisalad_jax.experiments.report.gallery import _half_right
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.experiments.report.pictures import (
    GREEN,
    RED,
    assert_clear_edges,
    boxes_of,
    drawn,
    is_colour,
    near_colour,
)


def _answers(photographs, indices):
    """A map's answers, where what is right is unknown."""
    database = photographs["database"]
    images = [MapImage(file.name, 1, None, str(file.parent)) for file in database]
    return Answers(photographs["queries"][: len(indices)], _near(indices), images, None)


def _near(indices):
    similarities = np.linspace(0.9, 0.1, len(indices[0]), dtype=np.float32)
    return Neighbours(np.array(indices), np.tile(similarities, (len(indices), 1)))


def _gallery(photographs, folder, indices, positives, **options):
    """Draw a result of an evaluation."""
    queries, database = photographs["queries"][: len(indices)], photographs["database"]
    positives = tuple(np.array(each, np.int64) for each in positives)
    root = queries[0].parent.parent
    benchmark = Benchmark("town", root, tuple(database), tuple(queries), positives, "by hand")
    found = GroupingResult("single", {1: 0.5}, _near(indices))
    return drawn(report.show_retrievals(found, benchmark, **options), folder)


def _is_level(picture, number):
    """Where a picture of `photographs` is, by its colour."""
    return is_colour(picture, (60, 20 * number + 60, 90))


def test_gallery_frames_are_green_where_right_and_red_where_wrong(photographs, tmp_path):
    picture = _gallery(photographs, tmp_path, [[2, 1, 0], [3, 4, 5]], [[2, 0], [5]], title="T")
    height, width = picture.shape[:2]
    # Four columns of 1.7 inches at 120 dots, three gaps and two margins, two rows of 4 : 3.
    assert 850 < width < 1000
    assert 400 < height < 600
    green, red = boxes_of(picture, GREEN), boxes_of(picture, RED)
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
            assert near_colour(below, colour).any()


def test_gallery_without_positives_is_neither_green_nor_red(photographs, tmp_path):
    """Two of four queries, from first to last, each with its own two pictures beside it."""
    indices = [[0, 5], [1, 4], [2, 3], [3, 2]]
    figure = report.show_retrievals(_answers(photographs, indices), rows=2, columns=2)
    picture = drawn(figure, tmp_path)
    assert not is_colour(picture, GREEN).any()
    assert not is_colour(picture, RED).any()
    # Queries 0 and 3, in the colours of pictures 0 and 3; found: 0 and 5, 3 and 2.
    levels = [_is_level(picture, number).sum() for number in range(6)]
    assert levels[1] == levels[4] == 0
    assert levels[0] == levels[3] == 2 * levels[5] == 2 * levels[2] > 0


@pytest.mark.parametrize(
    ("right", "rows", "expected"),
    [
        ([1, 0, 1, 0, 1, 0], 3, [0, 4, 1]),
        ([1, 1, 1, 1, 1, 0], 4, [0, 2, 4, 5]),
        ([0, 0, 0, 1, 0, 0], 4, [3, 0, 2, 5]),
        ([1, 1, 1], 8, [0, 1, 2]),
    ],
)
def test_gallery_takes_half_right_half_wrong(right, rows, expected):
    assert _half_right(np.array(right, bool), rows) == expected


def test_gallery_is_deterministic_and_takes_mixed_sizes(photographs, tmp_path):
    for number, shape in enumerate(((900, 300, 3), (100, 2500, 3), (1, 1, 3))):
        cv2.imwrite(str(photographs["database"][number]), np.full(shape, 77, np.uint8))
    arguments = [[0, 1, 2, 3]] * 4, [[1], [], [3], [0]]
    first, second = (
        _gallery(photographs, tmp_path, *arguments, rows=9, columns=9) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    assert len(boxes_of(first, GREEN)) == 3
    assert_clear_edges(first)


def test_gallery_rejects_what_does_not_fit(photographs, tmp_path):
    for options, message in (
        ({"rows": 0}, r"^queries: found \[\]"),
        ({"queries": [1]}, r"^queries: found \[1\], expected numbers from 0 to 0"),
        ({"queries": []}, r"^queries: found \[\], expected numbers from 0 to 0"),
    ):
        with pytest.raises(InputError, match=message):
            _gallery(photographs, tmp_path, [[0, 1]], [[0]], **options)
    photographs["database"][1].write_bytes(b"")
    with pytest.raises(InputError, match=r"database.1\.png: found an empty file"):
        _gallery(photographs, tmp_path, [[0, 1]], [[0]])


def test_values_of_a_narrow_range_are_shown_with_contrast(tmp_path):
    """Of 16 bits, half 7,200 and half 8,900, which by their high bytes are both dark grey."""
    file = tmp_path / "thermal.png"
    cv2.imwrite(str(file), np.repeat(np.full((60, 2), [7200, 8900], np.uint16), 40, axis=1))
    answers = _answers({"queries": [file], "database": [file]}, [[0]])
    black = is_colour(drawn(report.show_retrievals(answers), tmp_path), (0, 0, 0))
    # Half of the query and of what was found, of 1.7 x 1.275 inches at 120 dots.
    assert black.sum() > 0.9 * 204 * 153


def test_a_picture_of_a_map_that_is_gone_is_a_grey_box_and_a_note(photographs, tmp_path):
    """The first of two answers; it is found where --map-images says."""
    answers = _answers(photographs, [[4, 1]])
    photographs["database"][4].rename(tmp_path / photographs["database"][4].name)
    words = r"1 picture shown as a grey box \(first: .*4\.png: found no such .*\); --map-images"
    with pytest.warns(Note, match=words):
        picture = drawn(report.show_retrievals(answers), tmp_path)
    grey, there = is_colour(picture, (196, 196, 196)), _is_level(picture, 1)
    # As large as the picture of the other answer, but for edges that are drawn softly.
    assert grey.sum() == pytest.approx(there.sum(), rel=0.02)
    for each in photographs["database"][:4]:
        shutil.copy(each, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        picture = drawn(report.show_retrievals(answers, root=tmp_path), tmp_path)
    # The soft edges of letters have any grey.
    assert is_colour(picture, (196, 196, 196)).sum() < 0.01 * grey.sum()


def test_names_stand_below_the_captions_shortened_in_the_middle(photographs):
    """Of answers; a name with dollars is drawn as any other."""
    long = photographs["database"][0].with_name("abcdefghijklmn" * 10 + ".png")
    shutil.copy(photographs["database"][0], long)
    photographs["database"][1] = long
    figure = report.show_retrievals(_answers(photographs, [[0, 1]]))
    names = [axes.texts[0] for axes in figure.axes]
    shown = [name.get_text() for name in names]
    assert shown[1:] == ["0.png", "abcdefghijklmn\N{HORIZONTAL ELLIPSIS}fghijklmn.png"]
    assert not any(name.get_parse_math() for name in names)


def test_gallery_shows_the_queries_chosen_in_their_order(photographs, tmp_path):
    """Below each other, and what was found for them from left to right, in its own colours."""
    indices = [[0, 0], [2, 5], [0, 0], [4, 0]]
    picture = _gallery(photographs, tmp_path, indices, [[0]] * 4, queries=[3, 1])
    places = {n: np.argwhere(_is_level(picture, n)).mean(axis=0) for n in range(6)}
    for upper, lower in zip((3, 4, 0), (1, 2, 5), strict=True):
        assert places[upper][0] < places[lower][0]
    for row in ((3, 4, 0), (1, 2, 5)):
        columns = [places[n][1] for n in row]
        assert columns == sorted(columns)


def test_names_of_any_letters_are_drawn_without_a_word(photographs, tmp_path, recwarn):
    """Control characters, bytes that are no UTF-8, and letters that the font lacks."""
    moved = {side: list(paths) for side, paths in photographs.items()}
    for number, name in enumerate(("a\x1b[31m\a\r.jpg", "caf\udce9.jpg", "\u6771\u4eac.jpg")):
        path = tmp_path / name
        path.write_bytes(moved["database"][number].read_bytes())
        moved["database"][number] = path
    _gallery(moved, tmp_path, [[0, 1, 2]], [[0]], title="\x1b[31m caf\udce9")
    assert not [str(warning.message) for warning in recwarn]


def test_a_result_comes_with_its_benchmark_and_answers_without(photographs, benchmark):
    result, answers = GroupingResult("single", {1: 1.0}, _near([[0]])), _answers(photographs, [[0]])
    for arguments, words in (
        ((result,), "benchmark: found none for a result"),
        ((answers, benchmark), "benchmark: found one for answers"),
    ):
        with pytest.raises(InputError, match=words):
            report.show_retrievals(*arguments)
