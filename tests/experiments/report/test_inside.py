"""Figures of attention, gradients and descriptors, by what they draw and where."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from crisalad_jax.experiments.report import (
    show_attention,
    show_descriptors,
    show_gradient_norms,
    show_image_attention,
)
from crisalad_jax.nn.model import Model, attention_maps
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL
from tests.experiments.report.pictures import assert_clear_edges, drawn

PICTURES = list(np.random.default_rng(0).integers(0, 256, (3, 60, 80, 3), dtype=np.uint8))


@pytest.fixture(scope="module")
def model(params) -> Model:
    return Model(params, MODEL)


def overlays(figure):
    """The title of each panel but the photograph's, and the values that it draws."""
    panels = [axes for axes in figure.axes if len(axes.images) == 2]
    titles = [axes.get_title(loc="left") for axes in panels]
    return titles, [np.asarray(axes.images[1].get_array()) for axes in panels]


@pytest.mark.parametrize("patch", [None, (1, 2)])
def test_a_panel_is_what_a_token_attends_to(model, tmp_path, patch):
    """Tokens are the class token, then 3 x 4 patches."""
    image = prepare_image(PICTURES[0], MODEL)
    (maps,) = np.asarray(attention_maps(model.params, image[None], MODEL, block=0))
    row = maps[:, 0 if patch is None else 1 + 4 + 2, 1:].reshape(2, 3, 4)
    figure = show_attention(PICTURES[0], model, block=0, patch=patch)
    titles, values = overlays(figure)
    assert [title.partition(":")[0] for title in titles] == ["all heads", "head 0", "head 1"]
    np.testing.assert_allclose(values, [row.mean(axis=0), *row], rtol=1e-6)
    low, high = 100 * row[1].min(), 100 * row[1].max()
    assert titles[2] == f"head 1: {low:.2g} to {high:.2g} %"
    squares = [axes.patches for axes in figure.axes[:4]]
    if patch is None:
        assert not any(squares)
    else:  # in pixels of 80 x 60
        assert [(s.get_xy(), s.get_width(), s.get_height()) for (s,) in squares] == [
            ((39.5, 19.5), 20, 20)
        ] * 4
    assert_clear_edges(drawn(figure, tmp_path))
    _, (alone,) = overlays(show_attention(PICTURES[0], model, block=0, head=1, patch=patch))
    np.testing.assert_allclose(alone, row[1], rtol=1e-6)


def test_images_that_attend_to_themselves_alone_are_a_diagonal(model, tmp_path):
    figure = show_image_attention(PICTURES, model, mask=np.eye(3, dtype=bool))
    layers = figure.axes[:2]
    assert [axes.get_title(loc="left") for axes in layers] == ["layer 0", "layer 1"]
    for axes in layers:
        np.testing.assert_allclose(axes.images[0].get_array(), 100 * np.eye(3), atol=1e-5)
        found = {text.get_position(): text.get_text() for text in axes.texts}
        assert found == {(x, y): "100.0" if x == y else "0.0" for x in range(3) for y in range(3)}
        # Below the matrix each picture is left of its row, and above its column.
        centres = [np.reshape(image.get_extent(), (2, 2)).mean(axis=1) for image in axes.images[1:]]
        wanted = [each for n in range(3) for each in ((-1.05, n), (n, -1.05))]
        np.testing.assert_allclose(centres, wanted, atol=1e-9)
    assert_clear_edges(drawn(figure, tmp_path))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: show_attention(PICTURES[0], m, head=2), "head: found 2, expected 0 to 1, or No"),
        (
            lambda m: show_attention(PICTURES[0], m, patch=(3, 0)),
            r"patch: found \(3, 0\), expected",
        ),
        (lambda m: show_image_attention([], m), "images: found sizes of none, expected one"),
        (lambda m: show_gradient_norms({}), "norms: found none, expected those of gradient_norms"),
        (
            lambda m: show_descriptors(np.eye(3, dtype=np.float32), ["a"]),
            "places: found 1, of 1 pl",
        ),
        (lambda m: show_descriptors(np.eye(37, dtype=np.float32), range(37)), "of at most 36 plac"),
    ],
)
def test_what_cannot_be_drawn_is_refused(model, call, message):
    with pytest.raises(InputError, match=message):
        call(model)


def test_norms_are_lines_over_blocks_and_dots_for_the_rest(tmp_path):
    norms = {"backbone.patch_embed": 0.5, "backbone.blocks.0": 2.0, "backbone.blocks.10": 3.0}
    norms |= {"backbone.blocks.0.adapter": 0.01, "backbone.blocks.10.adapter": 0.0, "aggregator": 1}
    figure = show_gradient_norms(norms)
    blocks, others = figure.axes
    assert blocks.get_yscale() == others.get_yscale() == "log"
    found = {line.get_label(): np.transpose(line.get_data()).tolist() for line in blocks.lines}
    assert found == {"blocks": [[0, 2], [10, 3]], "adapter": [[0, 0.01], [10, 0]]}
    assert np.transpose(others.lines[0].get_data()).tolist() == [[0, 0.5], [1, 1]]
    assert [label.get_text() for label in others.get_xticklabels()] == ["patch embed", "aggregator"]
    assert_clear_edges(drawn(figure, tmp_path))
    (alone,) = show_gradient_norms({"aggregator": 1.0}).axes
    assert len(alone.lines) == 1


def test_places_have_marks_of_their_own_about_their_mean(tmp_path):
    """Descriptors in a plane: the picture is that plane, turned."""
    generator = np.random.default_rng(0)
    flat = np.zeros((72, 5))
    flat[:, :2] = generator.normal(size=(72, 2)) * (3, 1)
    places = [f"_place$ {number % 36}$_{{" for number in range(72)]  # no formula, and not hidden
    figure = show_descriptors(flat.astype(np.float32), places)
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == places[:36]
    offsets = np.array([np.asarray(each.get_offsets()) for each in axes.collections])
    apart = np.linalg.norm(offsets[:, 0] - offsets[:, 1], axis=1)
    # float32 of numbers up to 10.
    np.testing.assert_allclose(apart, np.linalg.norm(flat[:36] - flat[36:], axis=1), atol=1e-5)
    marks = {
        (to_hex(each.get_facecolor()[0]), each.get_paths()[0].vertices.tobytes())
        for each in axes.collections
    }
    assert len(marks) == 36
    shares = flat.var(axis=0) / flat.var(axis=0).sum()
    assert axes.get_xlabel() == f"first component, {100 * shares[0]:.0f} % of the variance"
    assert_clear_edges(drawn(figure, tmp_path))
