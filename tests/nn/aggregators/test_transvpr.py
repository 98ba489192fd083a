"""TransVPR's key patches by hand; its levels against the backbone's own layers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.transvpr import TransVpr, TransVprConfig, key_features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import Linear
from crisalad_jax.nn.model import describe, extract_features
from crisalad_jax.utils.errors import InputError
from tests.conftest import random_params

CONFIG = ModelConfig(
    image_size=(42, 56),
    backbone=ViTConfig(dim=16, depth=3, heads=2, position_grid=3),
    aggregator=TransVprConfig(levels=3, dim=8),
    cross_image="none",
)


def start() -> TransVpr:
    return CONFIG.aggregator.init(jax.random.key(1), CONFIG.backbone, CONFIG.grid)


@pytest.mark.parametrize(
    ("levels", "depth", "expected"),
    [(3, 12, (4, 8, 12)), (2, 4, (2, 4)), (3, 5, (1, 3, 5)), (1, 7, (7,)), (3, 3, (1, 2, 3))],
)
def test_levels_are_evenly_apart_and_end_at_the_last(levels: int, depth: int, expected) -> None:
    assert TransVprConfig(levels=levels).features(depth).levels == expected


def test_more_levels_than_blocks_are_refused() -> None:
    with pytest.raises(InputError, match=r"TransVprConfig.levels: found 6, expected 1 to 3"):
        dataclasses.replace(CONFIG, aggregator=TransVprConfig(levels=6))


def test_a_models_last_level_is_its_backbones_last_layer() -> None:
    params = random_params(CONFIG)
    images = jax.random.normal(jax.random.key(0), (2, 42, 56, 3))
    features = extract_features(params, images, CONFIG)
    assert features.patches.shape == (2, 12, 3 * 16)
    # The same sums, compiled twice, of numbers of order 1.
    last, _ = CONFIG.backbone.apply(params.backbone, images)
    np.testing.assert_allclose(features.patches[..., -16:], last.patches, atol=1e-5)
    np.testing.assert_allclose(features.class_token, last.class_token, atol=1e-5)
    descriptors = describe(params, images, CONFIG)
    assert descriptors.shape == (2, 8)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-6)


def test_key_patches_by_hand() -> None:
    """Level 0 sees patches 0 and 1, level 1 patch 2; patch 3 is in no level, 4 in too little."""
    wanted = np.log([[1.0, 0.0001], [0.5, 0.0001], [0.0001, 1.0], [0.0001, 0.0001], [0.01, 0.01]])
    # The first number of each level is its score; the second makes the token's direction.
    patches = np.stack(
        [np.array([a, 1.0, b, 0.5 + number]) for number, (a, b) in enumerate(wanted)]
    )
    attention = np.zeros((4, 2))
    attention[0, 0] = attention[2, 1] = 1
    params = TransVpr(Linear(jnp.asarray(attention), None), Linear(jnp.zeros((4, 8)), jnp.zeros(8)))
    found = np.asarray(key_features(params, jnp.asarray(patches, jnp.float32), 2))
    # Stretched: 1, 0.5 and 1 at the first three, 0 at patch 3, at patch 4 about 0.01 in each level,
    # of a sum that goes to about 1 in all: just under 0.02.
    tokens = patches[:, 2:].astype(np.float32)  # the middle level of two is the last
    np.testing.assert_array_equal(found[:3], tokens[:3])
    np.testing.assert_array_equal(found[3:], 0)


def test_patches_that_are_all_alike_have_no_key_patch_and_no_nan() -> None:
    params = start()
    np.testing.assert_array_equal(key_features(params, jnp.ones((12, 48)), 3), 0)
