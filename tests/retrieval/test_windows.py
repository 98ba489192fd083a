"""Frames described with those before them, against the grouping `window` of all at once."""

import dataclasses
import types

import numpy as np
import pytest

from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.describe import (
    FrameDescriber,
    TokenSet,
    described,
    group,
)
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.grouping import batches_of
from crisalad_jax.retrieval.pca import fit_pca
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL
from tests.retrieval.maps.test_stores import ROUNDING

WINDOW = 3
READING = Reading(batch_size=BATCH, quiet=True)


@pytest.fixture(scope="module")
def town(shared, params):
    """Seven images, and their descriptors by the grouping `window`."""
    paths = list_images(shared / "town" / "images" / "test" / "database")
    describer = describer_of(Model(params, MODEL))
    rows = TokenSet(describer, paths, READING).rows
    expected = group(describer, rows, batches_of(len(rows), "window", WINDOW))
    alone = group(describer, rows, batches_of(len(rows), "single", BATCH))
    # The test can fail: the frames before it change a descriptor.
    assert np.abs(expected - alone)[1:].max() > 1000 * ROUNDING
    return types.SimpleNamespace(paths=paths, expected=expected, describer=describer, rows=rows)


def test_batch_by_batch(town):
    """The first window of the second batch is of both."""
    stream = described(town.describer, town.paths, READING, window=WINDOW)
    parts = [part.descriptors for part in stream]
    assert [len(part) for part in parts] == [4, 3]
    # float32 sums of other batches.
    np.testing.assert_allclose(np.concatenate(parts), town.expected, atol=ROUNDING)


def test_an_unreadable_frame_is_left_out_and_not_looked_at(town, tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    paths = [*town.paths[:2], broken, *town.paths[3:]]
    skips = dataclasses.replace(READING, on_bad_image="skip")
    parts = list(described(town.describer, paths, skips, window=WINDOW))
    assert [index for part in parts for index in part.indices] == [0, 1, 3, 4, 5, 6]
    assert [index for part in parts for index in part.unreadable] == [2]
    found = np.concatenate([part.descriptors for part in parts])
    rows = np.delete(town.rows, 2, axis=0)
    expected = group(town.describer, rows, batches_of(len(rows), "window", WINDOW))
    np.testing.assert_allclose(found, expected, atol=ROUNDING)  # as above


def test_one_by_one(town):
    describer = FrameDescriber(town.describer, WINDOW)
    images = [read_image(path) for path in town.paths]
    found = np.concatenate([describer(image) for image in images])
    np.testing.assert_allclose(found, town.expected, atol=ROUNDING)  # as above
    describer.forget()
    np.testing.assert_allclose(describer(images[0]), town.expected[:1], atol=ROUNDING)


def test_windows_that_mean_nothing_are_refused(town):
    with pytest.raises(InputError, match="window: found 0, expected at least 1"):
        FrameDescriber(town.describer, 0)
    alone = types.SimpleNamespace(config=dataclasses.replace(MODEL, cross_image="none"))
    with pytest.raises(InputError, match="window: found 2, expected 1 for a model without a cross"):
        FrameDescriber(alone, 2)
    FrameDescriber(alone, 1)


def test_components_shorten_what_is_described(town, tmp_path):
    """Also of a batch without a readable image."""
    components = fit_pca(town.expected, 4)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    paths, skips = [broken] * BATCH + town.paths, dataclasses.replace(READING, on_bad_image="skip")
    stream = described(town.describer, paths, skips, window=WINDOW, components=components)
    parts = [part.descriptors for part in stream]
    assert [part.shape for part in parts] == [(0, 4), (4, 4), (3, 4)]
    found = np.concatenate(parts)
    # As above, times what unit length gives back of a vector that lost most of its own.
    np.testing.assert_allclose(found, components.apply(town.expected), atol=10 * ROUNDING)
