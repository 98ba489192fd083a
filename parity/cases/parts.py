"""Every layer as a pair of functions from inputs to outputs: ours and the torch reference's.

Inputs and outputs are dictionaries by name, in our layout: batch first, channels last. The first
argument is the whole model on either side, so that the gradient of every parameter is available.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import torch
from torch import Tensor

from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.attention import attention
from crisalad_jax.nn.backbones import Features
from crisalad_jax.nn.backbones.vit import (
    Block,
    ViTConfig,
    block,
    embed,
    feed_forward,
    interpolate_positions,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, describe
from crisalad_jax.nn.pixels import normalise
from crisalad_jax.sinkhorn import assign_with_dustbin
from crisalad_jax.training.losses import LossConfig, all_pairs, metric_loss, mine
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from parity.reference import losses as torch_losses
from parity.reference import sinkhorn as torch_sinkhorn
from parity.reference.model import Crisalad as TorchCrisalad
from parity.reference.tokens import Tokens as TorchTokens
from parity.reference.vit import Features as TorchFeatures

GRID = (3, 4)
"""Rows and columns of patches for cases with a grid: not square, so that swapped axes show."""
LOSS = LossConfig(kind=MultiSimilarityConfig(base=0.5))
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's statistics as torchvision publishes them, because our own constants are under test."""

Inputs = Mapping[str, Any]


class Part(NamedTuple):
    """The same computation on both sides, from (whole model, inputs, config) to outputs."""

    ours: Callable[[Crisalad, Inputs, ModelConfig], dict[str, jax.Array]]
    theirs: Callable[[TorchCrisalad, Inputs, ModelConfig], dict[str, Tensor]]


def _last_block(params: Crisalad) -> Block:
    return jax.tree.map(lambda x: x[-1], params.backbone.blocks)


def _vit(config: ModelConfig) -> ViTConfig:
    assert isinstance(config.backbone, ViTConfig)
    return config.backbone


def _salad(config: ModelConfig) -> SaladConfig:
    assert isinstance(config.aggregator, SaladConfig)
    return config.aggregator


def _channels_first(images: Tensor) -> Tensor:
    return images.permute(0, 3, 1, 2)


def _our_pixels(_: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    return {"images": jax.vmap(lambda image: normalise(image, config.preprocessing))(x["images"])}


def _their_pixels(model: TorchCrisalad, x: Inputs, _: ModelConfig) -> dict[str, Tensor]:
    return {"images": torch_normalise(x["images"], model.backbone.cls_token.dtype)}


def torch_normalise(images: Tensor, dtype: torch.dtype) -> Tensor:
    """Normalise 8-bit (..., 3) like torchvision's `to_tensor` and `normalize`, channels last."""
    mean, deviation = (torch.tensor(x, dtype=dtype) for x in (MEAN, DEVIATION))
    return (images.to(dtype) / 255 - mean) / deviation


PIXELS = Part(_our_pixels, _their_pixels)


def _our_embed(params: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    one = jax.vmap(lambda image: embed(params.backbone, image, _vit(config)))
    return {"tokens": one(x["images"])}


EMBED = Part(
    _our_embed,
    lambda model, x, _: {"tokens": model.backbone.embed(_channels_first(x["images"]))},
)


def positions(grid: tuple[int, int]) -> Part:
    """Make a part that resizes position embeddings to a grid of patches."""

    def ours(params: Crisalad, _: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
        resized = interpolate_positions(params.backbone.pos_embed, grid, _vit(config))
        return {"positions": resized}

    def theirs(model: TorchCrisalad, _: Inputs, __: ModelConfig) -> dict[str, Tensor]:
        return {"positions": model.backbone.interpolate_positions(grid)[0].unflatten(0, grid)}

    return Part(ours, theirs)


def _our_attention(params: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    weights, heads = _last_block(params).attn, _vit(config).heads
    return {"tokens": attention(weights, x["tokens"], heads)}


ATTENTION = Part(
    _our_attention, lambda model, x, _: {"tokens": model.backbone.blocks[-1].attn(x["tokens"])}
)

FEED_FORWARD = Part(
    lambda params, x, _: {"tokens": feed_forward(_last_block(params).mlp, x["tokens"])},
    lambda model, x, _: {"tokens": model.backbone.blocks[-1].mlp(x["tokens"])},
)


def _our_block(params: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    return {"tokens": block(_last_block(params), x["tokens"], TokenInfo(GRID), _vit(config))[0]}


BLOCK = Part(
    _our_block, lambda model, x, _: {"tokens": model.backbone.blocks[-1](x["tokens"], GRID)}
)


def _our_aggregate(params: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    features = Features(x["class_token"], x["patches"])
    tokens = config.aggregator.apply(params.aggregator, features, GRID, key=None)
    return {"global_token": tokens.global_token, "local": tokens.local}


def _their_aggregate(model: TorchCrisalad, x: Inputs, _: ModelConfig) -> dict[str, Tensor]:
    patches = x["patches"].mT.unflatten(-1, GRID)
    tokens: TorchTokens = model.aggregate(TorchFeatures(x["class_token"], patches))
    return tokens._asdict()


AGGREGATE = Part(_our_aggregate, _their_aggregate)


def _our_sinkhorn(_: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    salad = _salad(config)
    result = assign_with_dustbin(
        x["scores"], x["dustbin"], salad.dustbin, epsilon=salad.epsilon, config=salad.sinkhorn
    )
    return {"log_plan": result.log_plan}


def _their_sinkhorn(_: TorchCrisalad, x: Inputs, config: ModelConfig) -> dict[str, Tensor]:
    salad = _salad(config)
    log_plan = torch_sinkhorn.assign_with_dustbin(
        x["scores"].mT, x["dustbin"], epsilon=salad.epsilon, config=salad.sinkhorn
    )
    return {"log_plan": log_plan.mT}


SINKHORN = Part(_our_sinkhorn, _their_sinkhorn)


def _our_encoder(params: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    assert params.cross_image is not None
    mask = x.get("mask")
    tokens = config.cross_image.apply(params.cross_image, x["tokens"], mask=mask, key=None)
    return {"tokens": tokens}


ENCODER = Part(
    _our_encoder, lambda model, x, _: {"tokens": model.encoder(x["tokens"], x.get("mask"))}
)

MINER = Part(
    lambda _, x, __: mine(
        x["similarities"], all_pairs(x["labels"]), margin=LOSS.miner_margin
    )._asdict(),
    lambda _, x, __: torch_losses.mine(
        x["similarities"], x["labels"], margin=LOSS.miner_margin
    )._asdict(),
)


def _our_loss(_: Crisalad, x: Inputs, __: ModelConfig) -> dict[str, jax.Array]:
    valid = x.get("valid")
    found = metric_loss(x["descriptors"], x["labels"], LOSS, valid=valid)
    return {"loss": found.loss, "easy_anchor_fraction": found.easy_anchor_fraction}


def _their_loss(_: TorchCrisalad, x: Inputs, __: ModelConfig) -> dict[str, Tensor]:
    valid = x.get("valid", torch.ones_like(x["labels"], dtype=torch.bool))
    found = torch_losses.multi_similarity_loss(x["descriptors"][valid], x["labels"][valid], LOSS)
    return found._asdict()


LOSS_PART = Part(_our_loss, _their_loss)


def _our_descriptor(params: Crisalad, x: Inputs, config: ModelConfig) -> dict[str, jax.Array]:
    return {"descriptors": describe(params, x["images"], config, mask=x.get("mask"))}


DESCRIPTOR = Part(
    _our_descriptor,
    lambda model, x, _: {"descriptors": model(_channels_first(x["images"]), x.get("mask"))},
)
