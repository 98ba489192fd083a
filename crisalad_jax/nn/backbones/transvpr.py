"""TransVPR's own backbone: convolutions, and a transformer over patches of all their feature maps.

Wang et al., CVPR 2022, section 3.1. Constants missing from the paper are from
RuotongWANG/TransVPR-model-implementation.
"""

import dataclasses
import itertools
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require_field
from crisalad_jax.nn import random_init
from crisalad_jax.nn.attention import Attention, attention
from crisalad_jax.nn.backbones.base import (
    BACKBONES,
    Backbone,
    Features,
    FeatureSpec,
    Pixels,
    TokenBatch,
    Valid,
)
from crisalad_jax.nn.convolutions import (
    ConvNorm,
    conv_norm,
    init_conv_norm,
    init_he_conv,
    max_pool,
)
from crisalad_jax.nn.layers import (
    Conv,
    LayerNorm,
    Linear,
    conv,
    gelu,
    init_layer_norm,
    init_small_linear,
    layer_norm,
    linear,
    residual_sum,
)
from crisalad_jax.utils.pytree import pytree_dataclass

WIDTHS = (64, 128, 256, 512)
"""Output channels of the convolutions; max pooling after each halves the grid."""


@pytree_dataclass
class TransVprBlock:
    """Attention and a feed-forward network; `norm1` normalises the residual stream itself."""

    pre_norm: LayerNorm
    self_attn: Attention
    norm1: LayerNorm
    linear1: Linear
    linear2: Linear


@pytree_dataclass
class TransVprNet:
    """Parameters of the backbone. In `blocks` every leaf has a leading depth axis."""

    convs: tuple[ConvNorm, ...]
    tokenizers: tuple[Conv, ...]
    """Convolutions without overlap that bring the feature maps of all layers to the same grid."""
    cls_token: Float[Array, " dim"]
    blocks: TransVprBlock
    norm: LayerNorm
    """Layer norm of every requested block output."""


@BACKBONES.register("transvpr-net", tiny={"dim": 64, "depth": 4})
class TransVprNetConfig(Backbone):
    """TransVPR's convolutions and transformer; no position embeddings (Wang et al., CVPR 2022)."""

    patch_size: ClassVar[int] = 16
    dim: PositiveInt = 256
    depth: PositiveInt = 6
    heads: PositiveInt = 4
    hidden: PositiveInt = 512
    """Width of the feed-forward networks."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        fits = self.dim % self.heads == self.dim % len(WIDTHS) == 0
        words = f"a multiple of the {self.heads} heads and of the {len(WIDTHS)} maps"
        require_field(self, "dim", fits, words)

    def init(self, key: PRNGKeyArray) -> TransVprNet:
        """Draw parameters: convolutions as He et al. do, linears normal with deviation 0.02."""
        conv_key, token_key, block_key = random_init.split(key, 3)
        conv_keys, token_keys = (random_init.split(x, len(WIDTHS)) for x in (conv_key, token_key))
        part = self.dim // len(WIDTHS)
        convs, tokenizers = [], []
        for i, (d_in, d_out) in enumerate(itertools.pairwise((3, *WIDTHS))):
            convs.append(init_conv_norm(conv_keys[i], 3, d_in, d_out, bias=True))
            tokenizers.append(init_he_conv(token_keys[i], _side(i), d_out, part, bias=True))
        return TransVprNet(
            convs=tuple(convs),
            tokenizers=tuple(tokenizers),
            cls_token=random_init.zeros(self.dim),
            blocks=random_init.stacked(self._init_block, random_init.split(block_key, self.depth)),
            norm=init_layer_norm(self.dim),
        )

    def _init_block(self, key: PRNGKeyArray) -> TransVprBlock:
        qkv, proj, first, second = random_init.split(key, 4)
        dim, hidden = self.dim, self.hidden
        return TransVprBlock(
            pre_norm=init_layer_norm(dim),
            self_attn=Attention(
                init_small_linear(qkv, dim, 3 * dim, bias=False), init_small_linear(proj, dim, dim)
            ),
            norm1=init_layer_norm(dim),
            linear1=init_small_linear(first, dim, hidden),
            linear2=init_small_linear(second, hidden, dim),
        )

    def apply(
        self, params: TransVprNet, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, TransVprNet]:
        """Return the requested levels' patches, concatenated, and the last level's class token.

        With remat "full" the backward pass recomputes every block from its input.

        Raises:
            InputError: during tracing, if the levels are out of order.
        """
        levels = request.levels_of(self.depth)

        def body(x: TokenBatch, layer: TransVprBlock) -> tuple[TokenBatch, TokenBatch]:
            y = block(layer, x, self.heads)
            return y, y

        if remat == "full":
            body = jax.checkpoint(body, prevent_cse=False)
        tokens, params = embed(params, images, valid)
        with jax.named_scope("blocks"):
            _, outputs = jax.lax.scan(body, tokens, params.blocks)
        chosen = [outputs[level - 1] for level in levels]
        if request.norm:
            chosen = [layer_norm(params.norm, x) for x in chosen]
        patches = jnp.concatenate([x[:, 1:] for x in chosen], axis=-1)
        return Features(chosen[-1][:, 0], patches), params


def _side(number: int) -> int:
    """Return the side of a patch on map `number`, counted from 0."""
    return TransVprNetConfig.patch_size // 2 ** (number + 1)


def embed(params: TransVprNet, images: Pixels, valid: Valid) -> tuple[TokenBatch, TransVprNet]:
    """Return the class token, and a vector for every patch with a part from each feature map.

    Returns:
        (tokens, updated): `updated` is `params`, with new running statistics if `valid` is given.
    """
    x, parts, convs = images, [], []
    for number, layer in enumerate(params.convs):
        x, layer = conv_norm(layer, x, valid)
        x = max_pool(jax.nn.relu(x), 3, padding=1)
        convs.append(layer)
        parts.append(conv(params.tokenizers[number], x, stride=_side(number), padding=0))
    tokens = jnp.concatenate(parts, axis=-1)
    tokens = tokens.reshape(images.shape[0], -1, tokens.shape[-1])
    first = jnp.broadcast_to(params.cls_token, (images.shape[0], 1, tokens.shape[-1]))
    tokens = jnp.concatenate([first.astype(tokens.dtype), tokens], axis=1)
    return tokens, dataclasses.replace(params, convs=tuple(convs))


def block(params: TransVprBlock, x: TokenBatch, heads: int) -> TokenBatch:
    """Add attention to the tokens, normalise them, and add the feed-forward network's output."""
    normed = layer_norm(params.pre_norm, x)
    x = x + attention(params.self_attn, normed, heads)
    x = layer_norm(params.norm1, x)
    return residual_sum(x, linear(params.linear2, gelu(linear(params.linear1, x))))
