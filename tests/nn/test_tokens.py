"""Tokens of one image as a sequence for the cross-image encoder, and back."""

import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.tokens import Tokens, as_sequence, from_sequence


@pytest.mark.parametrize("global_token", [True, False])
def test_sequences_round_trip(global_token: bool) -> None:
    tokens = Tokens(jnp.arange(8.0), jnp.arange(12.0).reshape(3, 4))
    sequence = as_sequence(tokens, global_token=global_token)
    assert sequence.shape == (5 if global_token else 3, 4)
    back = from_sequence(2 * sequence, tokens, global_token=global_token)
    factor = 2 if global_token else 1  # left out, it comes back untouched
    np.testing.assert_array_equal(back.global_token, factor * tokens.global_token)
    np.testing.assert_array_equal(back.local, 2 * tokens.local)


def test_the_global_token_comes_first_in_order() -> None:
    tokens = Tokens(jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array([[5.0, 6.0]]))
    expected = [[1, 2], [3, 4], [5, 6]]
    np.testing.assert_array_equal(as_sequence(tokens, global_token=True), expected)
