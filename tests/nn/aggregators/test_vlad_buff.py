"""Burst weights by hand, and NetVLAD where all patches are far apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.vlad import (
    BURST,
    NetVlad,
    VladBuff,
    VladBuffConfig,
    burst_weights,
    netvlad,
    vlad_buff,
)
from crisalad_jax.nn.layers import init_linear, l2_normalise
from crisalad_jax.utils.errors import InputError


def test_patches_that_are_alike_share_their_weight() -> None:
    """Three equal patches, and two at right angles to all: sigmoids of 7 and of 7 - 8 x 2."""
    patches = jnp.eye(4)[jnp.array([0, 0, 0, 1, 2])]
    same, other = 1 / (1 + np.exp(-7.0)), 1 / (1 + np.exp(9.0))
    expected = np.array([3 * same + 2 * other] * 3 + [same + 4 * other] * 2)
    # Float32 sums of five numbers.
    np.testing.assert_allclose(burst_weights(jnp.array(BURST), patches), expected, rtol=1e-6)
    squared = burst_weights(jnp.array([8.0, 7.0, 2.0]), patches)
    np.testing.assert_allclose(squared, expected**2, rtol=1e-6)


def test_equal_weights_leave_netvlad() -> None:
    """A slope of 0 makes all patches alike; a common factor falls to the intra-normalisation."""
    conv = init_linear(jax.random.key(0), 6, 3, bias=False)
    centroids = l2_normalise(jax.random.normal(jax.random.key(1), (3, 6)))
    patches = jax.random.normal(jax.random.key(2), (2, 7, 6))
    found = vlad_buff(VladBuff(None, conv, centroids, jnp.array([0.0, 7.0, 1.0])), patches)
    # Other orders of the same sums, at cancelling residuals.
    np.testing.assert_allclose(found, netvlad(NetVlad(conv, centroids), patches), atol=1e-5)


def test_what_is_no_vlad() -> None:
    with pytest.raises(InputError, match="clusters: found 1, expected at least 2"):
        VladBuffConfig(clusters=1)
    with pytest.raises(InputError, match="reduced: found -1, expected at least 0"):
        VladBuffConfig(reduced=-1)
