"""FoL's dustbin, its gradient, and what its request cannot be met by; parity is in parity/."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.salad import FolConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import describe, extract_features
from crisalad_jax.utils.errors import InputError
from tests.conftest import random_params

CONFIG = ModelConfig(
    image_size=(42, 56),
    backbone=ViTConfig(dim=32, depth=2, heads=2, position_grid=3, adapter="none"),
    aggregator=FolConfig(
        clusters=4, cluster_dim=8, token_dim=16, hidden=16, dropout=0.0, local_hidden=8, local=4
    ),
    cross_image="none",
)
IMAGES = np.random.default_rng(0).integers(0, 256, (2, 42, 56, 3), np.uint8)


def test_attention_is_cut_at_the_published_threshold() -> None:
    params = random_params(CONFIG)
    features = extract_features(params, IMAGES, CONFIG)
    aggregator: Any = CONFIG.aggregator

    def plan(share: float) -> jax.Array:
        attention = jnp.zeros((2, 12)).at[:, 3].set(share)
        return aggregator.plan(params.aggregator, features._replace(class_attention=attention))

    np.testing.assert_array_equal(plan(0.00999), plan(0.0))
    assert (plan(0.01)[:, 3, -1] < plan(0.0)[:, 3, -1]).all()


def test_a_patch_that_is_looked_at_keeps_more_of_its_mass() -> None:
    params = random_params(CONFIG)
    features = extract_features(params, IMAGES, CONFIG)
    attention = features.class_attention
    assert attention is not None
    # Shares of two heads, less what the class token takes itself.
    assert attention.shape == (2, 12)
    assert 0 < float(attention.sum(axis=1).max()) < 2
    aggregator: Any = CONFIG.aggregator
    before = aggregator.plan(params.aggregator, features)
    np.testing.assert_allclose(before.sum(axis=-1), 1, atol=1e-6)  # each patch has mass 1
    seen = features._replace(class_attention=attention.at[:, 3].add(1.0))
    after = aggregator.plan(params.aggregator, seen)
    assert (after[:, 3, -1] < before[:, 3, -1]).all()
    assert (after[:, 4, -1] > before[:, 4, -1]).all()  # the dustbin's mass is as large as before


def test_the_descriptors_gradient_reaches_the_attention() -> None:
    """By central differences of one patch's share, in float32."""
    params = random_params(CONFIG)
    features = extract_features(params, IMAGES, CONFIG)

    def loss(attention: jax.Array) -> jax.Array:
        seen = features._replace(class_attention=attention)
        return (
            CONFIG.aggregator.apply(params.aggregator, seen, (3, 4), key=None).local[..., 0].sum()
        )

    attention = features.class_attention
    assert attention is not None
    slope = jax.grad(loss)(attention)
    nudge = jnp.zeros_like(attention).at[0, 5].set(1e-2)
    assert float(attention[0, 5]) > 0.03  # above the threshold on both sides
    expected = (loss(attention + nudge) - loss(attention - nudge)) / 2e-2
    # Float32's roundings of sums of order 1 over the step of 0.02.
    np.testing.assert_allclose(slope[0, 5], expected, atol=1e-4)
    assert abs(float(expected)) > 1e-3


def test_backbones_without_that_attention_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        InputError, match="found resnet for aggregator fol, expected one with a class token"
    ):
        dataclasses.replace(CONFIG, backbone=ResNetConfig())
    monkeypatch.setattr(type(CONFIG.backbone), "exposes_cls_attention", False)
    with pytest.raises(
        InputError, match="found vit for aggregator fol, expected one with a class token that"
    ):
        dataclasses.replace(CONFIG)


def test_a_cut_stack_of_blocks_gives_the_same() -> None:
    """As training cuts it: before the last block, or at it."""
    params = random_params(CONFIG)
    whole = describe(params, IMAGES, CONFIG)
    cut = dataclasses.replace(params, backbone=CONFIG.backbone.split_blocks(params.backbone, [1]))
    np.testing.assert_allclose(describe(cut, IMAGES, CONFIG), whole, atol=1e-6)  # two programs
