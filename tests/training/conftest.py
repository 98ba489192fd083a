"""The city's places, which most tests of training train on."""

import pathlib

import pytest

from crisalad_jax.data.places import Places, read_places


@pytest.fixture(scope="session")
def places(shared: pathlib.Path) -> Places:
    return read_places(shared / "city", min_images=2)
