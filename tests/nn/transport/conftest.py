"""The precision of the transport's tests."""

from collections.abc import Iterator

import jax
import pytest


@pytest.fixture
def float64() -> Iterator[None]:
    """Computes in float64, where what is left of a tolerance is small."""
    with jax.enable_x64(True):
        yield
