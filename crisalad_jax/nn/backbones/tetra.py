"""TeTRA's vision transformer, whose linear layers have weights of -1, 0 and 1.

Grainge et al., TeTRA-VPR, 2025; the ternary layer is BitNet b1.58's (Ma et al. 2024). Constants
missing from the papers are from OliverGrainge/TeTRA-VPR.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require, require_field
from crisalad_jax.nn import random_init
from crisalad_jax.nn.attention import Attention, dot_product_attention, split_heads
from crisalad_jax.nn.backbones.base import (
    BACKBONES,
    Backbone,
    Features,
    FeatureSpec,
    Grid,
    Pixels,
    TokenBatch,
    Valid,
)
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    at_least_float32,
    gelu,
    init_layer_norm,
    init_small_linear,
    layer_norm,
    linear,
    residual_sum,
)
from crisalad_jax.utils.pytree import pytree_dataclass

STEPS = 127
"""Largest magnitude of an activation quantised to 8 bits, in steps."""
_SMALLEST = 1e-5
"""Lower bound of the scales that activations and weights are divided by."""


@pytree_dataclass
class TetraBlock:
    """A pre-norm block like ViT's, with two more layer norms if ternary, and one more if not."""

    norm1: LayerNorm
    attn: Attention
    norm2: LayerNorm
    """Norm of the heads' output before projection."""
    norm3: LayerNorm
    fc1: Linear
    norm4: LayerNorm | None
    """Norm of the hidden layer; None in the last block, which is not ternary."""
    fc2: Linear


@pytree_dataclass
class TetraVit:
    """Parameters of the backbone. Leaves of `blocks` (ternary blocks) have a leading depth axis."""

    pos_embed: Float[Array, "token dim"]
    """Positions of the class token, then of the patches in row order."""
    cls_token: Float[Array, " dim"]
    patch_norm: LayerNorm
    patch_embed: Linear
    """Linear layer over a patch's pixels, in (row, column, channel) order."""
    token_norm: LayerNorm
    blocks: TetraBlock
    last: TetraBlock


@BACKBONES.register("tetra-vit", tiny={"dim": 128, "depth": 4, "heads": 4, "position_grid": 7})
class TetraVitConfig(Backbone):
    """TeTRA's ternary vision transformer with patches of 14 x 14 (Grainge et al. 2025).

    All blocks but the last round their weights to ternary ones, in training too; the parameters are
    the floats before rounding. Images have a fixed size of `position_grid` patches per side.
    """

    exposes_levels: ClassVar[bool] = False
    heads: PositiveInt = 12
    hidden: PositiveInt = 3072
    """Width of the feed-forward networks."""
    position_grid: PositiveInt = 23
    """Number of patches along each side of an image: 23 are 322 pixels."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        words = f"a multiple of the {self.heads} heads"
        require_field(self, "dim", self.dim % self.heads == 0, words)
        require_field(self, "depth", self.depth > 1, "at least 2: the last is not ternary")

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return (`position_grid`, `position_grid`); raise InputError for any other image size."""
        side = self.position_grid * self.patch_size
        height, width = image_size
        require(
            (height, width) == (side, side),
            f"image size: found {height} x {width}, expected {side} x {side}, the only size that "
            "this backbone has position embeddings for",
        )
        return self.position_grid, self.position_grid

    def init(self, key: PRNGKeyArray) -> TetraVit:
        """Draw parameters: standard normal positions and class token, linears of deviation 0.02."""
        position_key, first_key, patch_key, *keys = random_init.split(key, 3 + self.depth)
        dim, pixels = self.dim, 3 * self.patch_size**2
        return TetraVit(
            pos_embed=random_init.normal(position_key, (1 + self.position_grid**2, dim)),
            cls_token=random_init.normal(first_key, (dim,)),
            patch_norm=init_layer_norm(pixels),
            patch_embed=init_small_linear(patch_key, pixels, dim),
            token_norm=init_layer_norm(dim),
            blocks=random_init.stacked(self._init_block, keys[:-1]),
            last=dataclasses.replace(self._init_block(keys[-1]), norm4=None),
        )

    def _init_block(self, key: PRNGKeyArray) -> TetraBlock:
        qkv, proj, first, second = random_init.split(key, 4)
        dim, hidden = self.dim, self.hidden
        return TetraBlock(
            norm1=init_layer_norm(dim),
            attn=Attention(
                init_small_linear(qkv, dim, 3 * dim, bias=False), init_small_linear(proj, dim, dim)
            ),
            norm2=init_layer_norm(dim),
            norm3=init_layer_norm(dim),
            fc1=init_small_linear(first, dim, hidden),
            norm4=init_layer_norm(hidden),
            fc2=init_small_linear(second, hidden, dim),
        )

    def apply(
        self, params: TetraVit, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, TetraVit]:
        """Return the tokens of the last block, without a last norm.

        With remat "full" the backward pass recomputes every block from its input.
        """

        def body(x: TokenBatch, layer: TetraBlock) -> tuple[TokenBatch, None]:
            return block(layer, x, self.heads), None

        if remat == "full":
            body = jax.checkpoint(body, prevent_cse=False)
        with jax.named_scope("blocks"):
            tokens, _ = jax.lax.scan(body, embed(params, images, self), params.blocks)
            tokens = block(params.last, tokens, self.heads)
        return Features(tokens[:, 0], tokens[:, 1:]), params


def embed(params: TetraVit, images: Pixels, config: TetraVitConfig) -> TokenBatch:
    """Embed patches, normalised before and after, prepend the class token, and add positions."""
    count, side, size = images.shape[0], config.position_grid, config.patch_size
    pixels = images.reshape(count, side, size, side, size, 3).swapaxes(2, 3)
    patches = layer_norm(params.patch_norm, pixels.reshape(count, side**2, 3 * size**2))
    patches = layer_norm(params.token_norm, linear(params.patch_embed, patches))
    first = jnp.broadcast_to(params.cls_token, (count, 1, config.dim))
    tokens = jnp.concatenate([first, at_least_float32(patches)], axis=1) + params.pos_embed
    return tokens.astype(images.dtype)


def block(params: TetraBlock, x: TokenBatch, heads: int) -> TokenBatch:
    """Run a block; its linear layers are ternary if its hidden layer has a norm (`norm4`)."""
    layer = linear if params.norm4 is None else ternary_linear
    qkv = split_heads(layer(params.attn.qkv, layer_norm(params.norm1, x)), 3 * heads)
    mixed = dot_product_attention(*jnp.split(qkv, 3, axis=-2)).reshape(x.shape)
    x = residual_sum(x, layer(params.attn.proj, layer_norm(params.norm2, mixed)))
    hidden = gelu(layer(params.fc1, layer_norm(params.norm3, x)))
    hidden = hidden if params.norm4 is None else layer_norm(params.norm4, hidden)
    return residual_sum(x, layer(params.fc2, hidden))


def ternary_linear(params: Linear, x: Float[Array, "*batch d_in"]) -> Float[Array, "*batch d_out"]:
    """Apply a linear layer with its weights rounded to ternary ones, and `x` to 8-bit steps.

    A weight is -1, 0 or 1 times the weights' mean magnitude. Rounding is half to even. Sums of
    steps are integers below 2^24, exact in float32. Gradients pass straight through the rounding.

    Args:
        params: the layer, whose weight is rounded here.
        x: activations, which are rounded to steps of 1/127 of each token's largest magnitude.
    """
    wide = at_least_float32(x)
    fine = STEPS / jnp.maximum(jnp.abs(wide).max(axis=-1, keepdims=True), _SMALLEST)
    coarse = 1 / jnp.maximum(jnp.abs(params.weight).mean(), _SMALLEST)
    fine, coarse = jax.lax.stop_gradient((fine, coarse))
    steps, signs = wide * fine, params.weight * coarse
    steps = _straight_through(steps, jnp.round(steps))
    signs = _straight_through(signs, jnp.clip(jnp.round(signs), -1, 1))
    y = jnp.matmul(steps, signs, precision="highest") / fine / coarse
    return (y if params.bias is None else y + params.bias).astype(x.dtype)


def _straight_through(x: Array, rounded: Array) -> Array:
    """Return the rounded values, with the gradient of `x`."""
    return jax.lax.stop_gradient(rounded) + (x - jax.lax.stop_gradient(x))
