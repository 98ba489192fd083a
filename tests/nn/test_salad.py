"""SALAD's parts beside its golden file: dropout, and too few patches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config import SaladConfig
from crisalad_jax.errors import InputError
from crisalad_jax.nn.salad import init_salad, salad
from crisalad_jax.nn.vit import Features

CONFIG = SaladConfig(clusters=3, cluster_dim=4, token_dim=8, hidden=16, dropout=0.5)


def features(patches: int) -> Features:
    keys = jax.random.split(jax.random.key(1))
    return Features(jax.random.normal(keys[0], (12,)), jax.random.normal(keys[1], (patches, 12)))


def test_tokens_are_unit_vectors_and_do_not_depend_on_the_order_of_patches() -> None:
    params = init_salad(jax.random.key(0), 12, CONFIG)
    whole = features(10)
    tokens = salad(params, whole, CONFIG, key=None)
    shuffled = salad(params, Features(whole.class_token, whole.patches[::-1]), CONFIG, key=None)
    for ours, other in zip(tokens, shuffled, strict=True):
        # float32 rounding of lengths and of sums taken in another order.
        np.testing.assert_allclose(jnp.linalg.norm(ours, axis=-1), 1, atol=1e-6)
        np.testing.assert_allclose(ours, other, atol=1e-6)


def test_dropout_is_on_with_a_key_only() -> None:
    params = init_salad(jax.random.key(0), 12, CONFIG)
    plain = salad(params, features(10), CONFIG, key=None)
    first, again, other = (
        salad(params, features(10), CONFIG, key=jax.random.key(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.local, again.local)
    assert not np.allclose(first.local, other.local, atol=1e-3)
    assert not np.allclose(first.local, plain.local, atol=1e-3)
    # The public implementation has no dropout in the global token's network.
    np.testing.assert_array_equal(first.global_token, plain.global_token)


@pytest.mark.parametrize("patches", [2, 3])
def test_no_more_patches_than_clusters_raises(patches: int) -> None:
    params = init_salad(jax.random.key(0), 12, CONFIG)
    with pytest.raises(InputError, match=f"found {patches} patches for 3 clusters"):
        salad(params, features(patches), CONFIG, key=None)


def test_dropout_stands_before_relu_of_the_two_local_networks(monkeypatch) -> None:
    """The public order (linear, dropout, ReLU, linear), with a key for each network."""
    import crisalad_jax.nn.salad as module

    calls = []

    def record(x, rate, *, key):
        calls.append((rate, None if key is None else tuple(jax.random.key_data(key).tolist())))
        assert (x < 0).any()  # before ReLU
        return x

    monkeypatch.setattr(module, "dropout", record)
    params = init_salad(jax.random.key(0), 12, CONFIG)
    salad(params, features(10), CONFIG, key=jax.random.key(1))
    drawn = [key for rate, key in calls if rate == 0.5]
    assert len(calls) == 3
    assert len(drawn) == 2
    assert len(set(drawn)) == 2
    assert None not in drawn
    assert (0.0, None) in calls  # the global token's network
