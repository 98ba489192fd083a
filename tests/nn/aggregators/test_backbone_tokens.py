"""Learnt tokens that run through the last blocks, by hand, and what cannot have them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig
from crisalad_jax.nn.backbones.vit import NORM_EPSILON, ViTConfig, block, embed
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import l2_normalise, layer_norm
from crisalad_jax.nn.model import describe
from crisalad_jax.utils.errors import InputError
from tests.conftest import random_params

NONE = "none"
CONFIG = ModelConfig(
    image_size=(28, 42),
    backbone=ViTConfig(dim=16, depth=3, heads=2, position_grid=2, registers=2, adapter=NONE),
    aggregator=AggregationTokensConfig(tokens=3, insertion=-2),
    cross_image="none",
)


@pytest.mark.slow
def test_the_tokens_run_through_the_last_blocks_by_hand() -> None:
    params = random_params(CONFIG)
    image = jax.random.normal(jax.random.key(1), (28, 42, 3))
    backbone = CONFIG.backbone
    assert isinstance(backbone, ViTConfig)
    tokens = embed(params.backbone, image, backbone)[None]
    for i in range(3):
        if i == 1:
            tokens = jnp.concatenate([params.aggregator.tokens[None], tokens], axis=1)
        layer = jax.tree.map(lambda leaf, i=i: leaf[i], params.backbone.blocks)
        tokens, _ = block(layer, tokens, TokenInfo((2, 3)), backbone)
    normed = layer_norm(params.backbone.norm, tokens[:, :3], epsilon=NORM_EPSILON)
    found = describe(params, image[None], CONFIG)
    # The same sums, compiled twice.
    np.testing.assert_allclose(found, l2_normalise(normed.reshape(1, -1)), atol=1e-6)

    # As training cuts the blocks, before the tokens come or after.
    for first in (1, 2):
        cut = dataclasses.replace(params, backbone=backbone.split_blocks(params.backbone, [first]))
        np.testing.assert_allclose(describe(cut, image[None], CONFIG), found, atol=1e-6)


@pytest.mark.parametrize("insertion", [-4, 3])
def test_there_is_such_a_block(insertion: int) -> None:
    with pytest.raises(InputError, match=f"insertion: found {insertion}, expected -3 to 2"):
        dataclasses.replace(CONFIG, aggregator=AggregationTokensConfig(insertion=insertion))


def test_other_backbones_say_that_they_have_no_place_for_tokens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(type(CONFIG.backbone), "supports_prompt_tokens", False)
    with pytest.raises(InputError, match="found vit for aggregator aggregation-tokens, expected"):
        dataclasses.replace(CONFIG)
