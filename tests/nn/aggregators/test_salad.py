"""SALAD's parts beside its golden file: dropout, dustbins, statistics, and too few patches."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.salad import Salad, SaladConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.tokens import Tokens
from tests.nn.conftest import slow_unless

CONFIG = SaladConfig(clusters=3, cluster_dim=4, token_dim=8, hidden=16, dropout=0.5)


def init_salad(config: SaladConfig) -> Salad:
    return config.init(jax.random.key(0), ViTConfig(dim=12, heads=1), (3, 3))


def salad(params: Salad, features: Features, config: SaladConfig, key: Any) -> Tokens:
    return config.apply(params, features, (1, features.patches.shape[-2]), key=key)


def features(patches: int) -> Features:
    keys = jax.random.split(jax.random.key(1))
    return Features(jax.random.normal(keys[0], (12,)), jax.random.normal(keys[1], (patches, 12)))


def test_tokens_are_unit_vectors_and_do_not_depend_on_the_order_of_patches() -> None:
    params = init_salad(CONFIG)
    whole = features(10)
    tokens = salad(params, whole, CONFIG, key=None)
    shuffled = salad(params, Features(whole.class_token, whole.patches[::-1]), CONFIG, key=None)
    for ours, other in zip(tokens[:2], shuffled[:2], strict=True):
        # float32 rounding of lengths and of sums taken in another order.
        np.testing.assert_allclose(jnp.linalg.norm(ours, axis=-1), 1, atol=1e-6)
        np.testing.assert_allclose(ours, other, atol=1e-6)


def test_dropout_stands_before_relu_of_the_two_local_networks(monkeypatch) -> None:
    """The public order (linear, dropout, ReLU, linear), with a key for each network."""
    import crisalad_jax.nn.layers as module

    calls = []

    def record(x, rate, *, key):
        calls.append((rate, None if key is None else tuple(jax.random.key_data(key).tolist())))
        assert (x < 0).any()  # before ReLU
        return x

    monkeypatch.setattr(module, "dropout", record)
    params = init_salad(CONFIG)
    salad(params, features(10), CONFIG, key=jax.random.key(1))
    drawn = [key for rate, key in calls if rate == 0.5]
    assert len(calls) == 3
    assert len(drawn) == 2
    assert len(set(drawn)) == 2
    assert None not in drawn
    assert (0.0, None) in calls  # the global token's network


@pytest.mark.parametrize(
    "dustbin",
    slow_unless({"column", "token", "mass"}, ("none", "column", "row and column", "token", "mass")),
)
def test_a_batch_is_its_images_under_every_dustbin(dustbin: str) -> None:
    config = dataclasses.replace(CONFIG, dustbin=dustbin)
    params = init_salad(config)
    keys = jax.random.split(jax.random.key(1))
    batch = Features(jax.random.normal(keys[0], (5, 12)), jax.random.normal(keys[1], (5, 10, 12)))
    together = salad(params, batch, config, key=None)
    assert together.local.shape == (5, 3, 4)
    by_vmap = jax.vmap(lambda f: salad(params, f, config, key=None))(batch)
    one_by_one = [
        salad(params, Features(*(x[i] for x in batch[:2])), config, key=None) for i in range(5)
    ]
    by_hand = jax.tree.map(lambda *singles: jnp.stack(singles), *one_by_one)
    for others in (by_vmap, by_hand):
        # float32 rounding of unit vectors by other kernels, and of statistics of order 10.
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, atol=1e-6), together[:2], others[:2]
        )
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), together, others)


def test_a_dustbin_score_a_patch_is_the_networks_own_column() -> None:
    config = dataclasses.replace(CONFIG, dustbin="token")
    params = init_salad(config)
    assert params.dust_bin is None
    assert params.score.fc2.weight.shape == (16, 4)
    given = features(10)

    def plan(weight: jax.Array) -> jax.Array:
        second = dataclasses.replace(params.score.fc2, weight=weight)
        whole = dataclasses.replace(params, score=dataclasses.replace(params.score, fc2=second))
        return jnp.exp(config.transport(whole, given, key=None).log_plan)

    weight = params.score.fc2.weight
    np.testing.assert_allclose(plan(weight).sum(axis=1), 1, atol=1e-5)  # rows are met last
    gradient = jax.grad(lambda w: jnp.sin(3 * plan(w)).sum())(weight)
    assert jnp.abs(gradient[:, -1]).max() > 1e-3  # the dustbin's own weights train


def test_a_dustbin_of_fixed_mass_allows_more_clusters_than_patches() -> None:
    config = dataclasses.replace(CONFIG, dustbin="mass")
    params = init_salad(config)
    tokens = salad(params, features(2), config, key=None)
    np.testing.assert_allclose(jnp.linalg.norm(tokens.local, axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize("fields", [{}, {"row_tau": 0.7}], ids=str)
def test_statistics_are_those_of_the_plan(fields) -> None:
    """In numpy, of two unlike images and sharp scores; with relaxed rows, patches of any mass."""
    config = dataclasses.replace(CONFIG, **fields)
    params = init_salad(config)
    patches = jax.random.normal(jax.random.key(2), (2, 10, 12)) * jnp.array([[[20.0]], [[60.0]]])

    @jax.jit
    def both(patches: jax.Array):
        given = Features(patches[:, 0], patches)
        log_plan = config.transport(params, given, key=None).log_plan
        return salad(params, given, config, key=None).transport, log_plan

    found, log_plan = both(patches)
    plan = np.exp(np.asarray(log_plan, np.float64))
    # Three clusters of mass 1, and the dustbin has what is left of ten patches.
    errors = np.abs(plan.sum(axis=1) / np.array([1, 1, 1, 7]) - 1).max(axis=1)
    # float32 rounding of sums of ten masses, relative to 1; the errors themselves are some 0.1.
    np.testing.assert_allclose(found.marginal_error, errors, atol=3e-6)
    # The same rounding, of ratios and logarithms of order 1.
    binned = plan[..., 3].sum(axis=1) / plan.sum(axis=(1, 2))
    np.testing.assert_allclose(found.dustbin_share, binned, rtol=1e-5)
    shares = plan[..., :3] / plan[..., :3].sum(axis=1, keepdims=True)
    entropies = -np.where(shares > 0, shares * np.log(np.maximum(shares, 1e-300)), 0).sum(axis=1)
    each = np.exp(entropies).mean(axis=1)
    np.testing.assert_allclose(found.patches_per_cluster, each, rtol=1e-5)


@pytest.mark.parametrize("dustbin", ["none", "column", "row and column", "token", "mass"])
def test_a_dustbin_starts_at_1(dustbin: str) -> None:
    """As published; where it has a parameter at all."""
    start = init_salad(dataclasses.replace(CONFIG, dustbin=dustbin)).dust_bin
    assert start is None if dustbin in ("none", "token") else start == 1
