"""Frames described with those before them, against the grouping `window` of all at once."""

import dataclasses
import types

import numpy as np
import pytest

from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.retrieval.describe import group, read_tokens
from crisalad_jax.retrieval.pca import fit_pca
from crisalad_jax.retrieval.windows import FrameDescriber, check_window, describe_windows
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL
from tests.retrieval.maps.test_stores import ROUNDING

WINDOW = 3


@pytest.fixture(scope="module")
def town(shared, params):
    """Seven images, and their descriptors by the grouping `window`."""
    paths = list_images(shared / "town" / "images" / "test" / "database")
    tokens = read_tokens(params, MODEL, paths, batch_size=BATCH, label="", quiet=True)
    expected = group(params, MODEL, tokens, "window", batch_size=WINDOW)
    alone = group(params, MODEL, tokens, "single", batch_size=BATCH)
    # The test can fail: the frames before it change a descriptor.
    assert np.abs(expected - alone)[1:].max() > 1000 * ROUNDING
    return types.SimpleNamespace(paths=paths, expected=expected)


def test_batch_by_batch(town, params):
    """The first window of the second batch is of both."""
    stream = describe_windows(params, MODEL, town.paths, window=WINDOW, batch_size=BATCH)
    parts = [part.descriptors for part in stream]
    assert [len(part) for part in parts] == [4, 3]
    # float32 sums of other batches.
    np.testing.assert_allclose(np.concatenate(parts), town.expected, atol=ROUNDING)


def test_an_unreadable_frame_is_left_out_and_not_looked_at(town, params, tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    paths = [*town.paths[:2], broken, *town.paths[3:]]
    stream = describe_windows(
        params, MODEL, paths, window=WINDOW, batch_size=BATCH, on_bad_image="skip"
    )
    parts = list(stream)
    assert [index for part in parts for index in part.indices] == [0, 1, 3, 4, 5, 6]
    assert [index for part in parts for index in part.unreadable] == [2]
    found = np.concatenate([part.descriptors for part in parts])
    tokens = read_tokens(
        params, MODEL, paths, batch_size=BATCH, label="", on_bad_image="skip", quiet=True
    )
    expected = group(params, MODEL, tokens, "window", batch_size=WINDOW)[tokens.readable]
    np.testing.assert_allclose(found, expected, atol=ROUNDING)  # as above


def test_one_by_one(town, params):
    describer = FrameDescriber(params, MODEL, WINDOW)
    images = [read_image(path) for path in town.paths]
    found = np.concatenate([describer(image) for image in images])
    np.testing.assert_allclose(found, town.expected, atol=ROUNDING)  # as above
    describer.forget()
    np.testing.assert_allclose(describer(images[0]), town.expected[:1], atol=ROUNDING)


def test_windows_that_mean_nothing_are_refused():
    with pytest.raises(InputError, match="window: found 0, expected at least 1"):
        check_window(MODEL, 0)
    alone = dataclasses.replace(MODEL, cross_image=CrossImageConfig(layers=0))
    with pytest.raises(InputError, match="window: found 2 with a model without a cross-image enc"):
        check_window(alone, 2)
    check_window(alone, 1)


def test_components_shorten_what_is_described(town, params):
    components = fit_pca(town.expected, 4)
    stream = describe_windows(
        params, MODEL, town.paths, window=WINDOW, batch_size=BATCH, components=components
    )
    found = np.concatenate([part.descriptors for part in stream])
    # As above, times what unit length gives back of a vector that lost most of its own.
    np.testing.assert_allclose(found, components.apply(town.expected), atol=10 * ROUNDING)
