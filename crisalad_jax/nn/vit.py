"""DINOv2's vision transformer ViT/14 (Oquab et al. 2023; registers: Darcet et al. 2024).

Written from the papers and the behaviour of facebookresearch/dinov2, whose golden outputs it meets.
"""

import dataclasses
import functools
import itertools
import math
import operator
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from crisalad_jax.config import PATCH_SIZE, ViTConfig, choose
from crisalad_jax.nn.adapter import Adapter, adapter, init_adapter
from crisalad_jax.nn.attention import Attention, attention
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    gelu,
    init_layer_norm,
    layer_norm,
    linear,
    widen,
)
from crisalad_jax.pytree import params

NORM_EPSILON = 1e-6
_PRODUCTS = ("qkv", "attended", "hidden", "down", "mixed")
"""Results of a block's large products and the tokens between its halves, by their names."""
_POLICIES = {
    "products": jax.checkpoint_policies.save_only_these_names(*_PRODUCTS),
    "blocks": jax.checkpoint_policies.nothing_saveable,
    "everything": jax.checkpoint_policies.everything_saveable,
}


@params
class Mlp:
    """Feed-forward network: fc1, GELU, fc2."""

    fc1: Linear
    fc2: Linear


@params
class SwiGlu:
    """Feed-forward network of ViT-g: w12 makes gate and value side by side, w3 projects."""

    w12: Linear
    w3: Linear


@params
class Block:
    """One transformer block; `ls1` and `ls2` are LayerScale's gains."""

    norm1: LayerNorm
    attn: Attention
    ls1: Float[Array, "*stack dim"]
    norm2: LayerNorm
    mlp: Mlp | SwiGlu
    ls2: Float[Array, "*stack dim"]
    adapter: Adapter | None


@params
class ViT:
    """The backbone. In `blocks` every leaf has a leading depth axis.

    A tuple of such stacks is run one after the other: so training keeps the frozen blocks out of
    the gradient where only the last ones train.
    """

    patch_embed: Linear
    """The weight's rows are a patch's pixels in (row, column, channel) order."""
    cls_token: Float[Array, " dim"]
    register_tokens: Float[Array, "register dim"]
    pos_embed_cls: Float[Array, " dim"]
    pos_embed: Float[Array, "grid grid dim"]
    blocks: Block | tuple[Block, ...]
    norm: LayerNorm


class Features(NamedTuple):
    """What a backbone says of a batch, or of one image of it, after its last layer norm."""

    class_token: Float[Array, "*batch dim"]
    patches: Float[Array, "*batch patch dim"]


def init_vit(key: PRNGKeyArray, config: ViTConfig) -> ViT:
    """Start as DINOv2 does before training: linears normal of deviation 0.02, biases 0."""
    patch_key, class_key, register_key, position_key, block_key = jax.random.split(key, 5)
    dim, side = config.dim, config.position_grid
    if config.position_start == "sincos":
        positions = jnp.asarray(_sincos_positions(side, dim), jnp.float32)
    else:
        positions = 0.02 * jax.random.normal(position_key, (side, side, dim))
    return ViT(
        patch_embed=_init_linear(patch_key, 3 * PATCH_SIZE**2, dim),
        cls_token=1e-6 * jax.random.normal(class_key, (dim,)),
        register_tokens=1e-6 * jax.random.normal(register_key, (config.registers, dim)),
        pos_embed_cls=jnp.zeros(dim),
        pos_embed=positions,
        blocks=jax.vmap(functools.partial(_init_block, config=config))(
            jax.random.split(block_key, config.depth)
        ),
        norm=init_layer_norm(dim),
    )


def _init_linear(key: PRNGKeyArray, d_in: int, d_out: int) -> Linear:
    weight = 0.02 * jax.random.truncated_normal(key, -2.0, 2.0, (d_in, d_out))
    return Linear(weight, jnp.zeros(d_out))


def _init_block(key: PRNGKeyArray, config: ViTConfig) -> Block:
    qkv, proj, first, second, adapter_key = jax.random.split(key, 5)
    dim, hidden = config.dim, config.hidden
    if config.ffn == "swiglu":
        mlp = SwiGlu(_init_linear(first, dim, 2 * hidden), _init_linear(second, hidden, dim))
    else:
        mlp = Mlp(_init_linear(first, dim, hidden), _init_linear(second, hidden, dim))
    return Block(
        norm1=init_layer_norm(dim),
        attn=Attention(_init_linear(qkv, dim, 3 * dim), _init_linear(proj, dim, dim)),
        ls1=jnp.full(dim, config.layer_scale_start, jnp.float32),
        norm2=init_layer_norm(dim),
        mlp=mlp,
        ls2=jnp.full(dim, config.layer_scale_start, jnp.float32),
        adapter=init_adapter(adapter_key, config),
    )


def _sincos_positions(side: int, dim: int) -> np.ndarray:
    """Fixed 2-D sine-cosine codes (MoCo v3's), half the width for rows and half for columns."""
    frequencies = 1e4 ** -(np.arange(dim // 4) / (dim // 4))
    angles = np.arange(side)[:, None] * frequencies
    code = np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)
    rows = np.broadcast_to(code[:, None], (side, side, dim // 2))
    columns = np.broadcast_to(code[None], (side, side, dim // 2))
    return np.concatenate([rows, columns], axis=-1)


def vit(
    params: ViT,
    images: Float[Array, "image height width 3"],
    config: ViTConfig,
    *,
    keeps: str = "products",
) -> Features:
    """Features of a batch of normalised images whose sides are multiples of 14.

    `keeps` is `ModelConfig.keeps`.
    """
    tokens = jax.vmap(lambda image: embed(params, image, config))(images)
    tokens = run_blocks(params, tokens, grid_of(images[0]), config, keeps=keeps)
    tokens = layer_norm(params.norm, tokens, epsilon=NORM_EPSILON)
    return Features(tokens[:, 0], tokens[:, 1 + config.registers :])


def vit_levels(
    params: ViT,
    images: Float[Array, "image height width 3"],
    config: ViTConfig,
    depths: Sequence[int],
    *,
    keeps: str = "products",
) -> Features:
    """`vit`, with the patches after several numbers of blocks side by side: level times dim wide.

    All levels go through the last layer norm, as in DINOv2's own intermediate layers. `depths` are
    in order, the last of them the number of blocks. The stack of blocks is cut at each, which for
    inference takes the memory of its parameters once more.
    """
    tokens = jax.vmap(lambda image: embed(params, image, config))(images)
    levels = []
    for part in _cut_at(params.blocks, depths):
        shorter = dataclasses.replace(params, blocks=part)
        tokens = run_blocks(shorter, tokens, grid_of(images[0]), config, keeps=keeps)
        levels.append(layer_norm(params.norm, tokens, epsilon=NORM_EPSILON))
    patches = jnp.concatenate([level[:, 1 + config.registers :] for level in levels], axis=-1)
    return Features(levels[-1][:, 0], patches)


def _cut_at(
    blocks: Block | tuple[Block, ...], depths: Sequence[int]
) -> Iterator[tuple[Block, ...]]:
    """The stacks of blocks up to each of `depths` from the one before."""
    stacks = blocks if isinstance(blocks, tuple) else (blocks,)
    for begin, end in itertools.pairwise((0, *depths)):
        parts, start = [], 0
        for stack in stacks:
            chosen = slice(max(begin - start, 0), max(end - start, 0))
            parts.append(jax.tree.map(operator.itemgetter(chosen), stack))
            start += len(stack.ls1)
        yield tuple(part for part in parts if len(part.ls1))


def facet(
    params: ViT,
    images: Float[Array, "image height width 3"],
    config: ViTConfig,
    block_number: int,
    name: str,
) -> Features:
    """Features of one facet of one block; the blocks after it are not run.

    The facets are queries, keys and values of the block's attention, heads side by side, or the
    tokens that the block leaves, without the last layer norm (AnyLoc: Keetha et al. 2023).

    Args:
        params: a backbone whose blocks are one stack.
        images: normalised, with sides that are multiples of 14.
        config: of the backbone.
        block_number: of the block, from 0.
        name: query, key, value or token.
    """
    stack = params.blocks
    assert isinstance(stack, Block)  # training alone cuts it, and with a facet nothing trains
    grid = grid_of(images[0])

    def numbered(number: Int[Array, ""] | int) -> Block:
        # Not a slice of the stack to scan over, which would be a copy of its weights.
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, number, 0, False), stack)

    def body(
        carry: Float[Array, "image token dim"], number: Int[Array, ""]
    ) -> tuple[Float[Array, "image token dim"], None]:
        return block(numbered(number), carry, grid, config), None

    tokens = jax.vmap(lambda image: embed(params, image, config))(images)
    whole = block_number + (name == "token")
    tokens, _ = jax.lax.scan(body, tokens, jnp.arange(whole))
    if name != "token":
        last = numbered(block_number)
        here = ("query", "key", "value").index(name) * config.dim
        part = jax.tree.map(lambda x: x[..., here : here + config.dim], last.attn.qkv)
        tokens = linear(part, layer_norm(last.norm1, tokens, epsilon=NORM_EPSILON))
    return Features(tokens[:, 0], tokens[:, 1 + config.registers :])


def grid_of(image: Shaped[Array, "height width 3"]) -> tuple[int, int]:
    """Rows and columns of patches."""
    return image.shape[0] // PATCH_SIZE, image.shape[1] // PATCH_SIZE


def embed(
    params: ViT, image: Float[Array, "height width 3"], config: ViTConfig
) -> Float[Array, "token dim"]:
    """Class token, registers and patches with their positions; registers have none."""
    rows, columns = grid_of(image)
    pixels = image.reshape(rows, PATCH_SIZE, columns, PATCH_SIZE, 3).transpose(0, 2, 1, 3, 4)
    patches = linear(params.patch_embed, pixels.reshape(rows * columns, -1))
    positions = interpolate_positions(params.pos_embed, (rows, columns), config)
    class_token = (params.cls_token + params.pos_embed_cls)[None]
    placed = widen(patches) + positions.reshape(rows * columns, -1)
    return jnp.concatenate([class_token, params.register_tokens, placed]).astype(image.dtype)


def run_blocks(
    params: ViT,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: ViTConfig,
    *,
    keeps: str = "products",
) -> Float[Array, "image token dim"]:
    """All blocks in turn, by one compiled body; `keeps` is `ModelConfig.keeps`."""

    def body(
        carry: Float[Array, "image token dim"], one: Block
    ) -> tuple[Float[Array, "image token dim"], None]:
        return block(one, carry, grid, config), None

    # prevent_cse=False: in a scan nothing can undo the saving.
    body = jax.checkpoint(body, prevent_cse=False, policy=choose("keeps", keeps, _POLICIES))
    stacks = params.blocks if isinstance(params.blocks, tuple) else (params.blocks,)
    for stack in stacks:
        tokens, _ = jax.lax.scan(body, tokens, stack)
    return tokens


def block(
    params: Block, tokens: Float[Array, "image token dim"], grid: tuple[int, int], config: ViTConfig
) -> Float[Array, "image token dim"]:
    """One block (paper Eq. 2), with LayerScale over MLP and adapter alike, as in CricaVPR."""
    normed = layer_norm(params.norm1, tokens, epsilon=NORM_EPSILON)
    attended = attention(params.attn, normed, config.heads, key=None)
    tokens = (widen(tokens) + params.ls1 * widen(attended)).astype(tokens.dtype)
    tokens = checkpoint_name(tokens, "attended")
    normed = layer_norm(params.norm2, tokens, epsilon=NORM_EPSILON)
    update = feed_forward(params.mlp, normed)
    if params.adapter is not None:
        update = update + config.adapter.alpha * adapter(params.adapter, normed, grid)
    return (widen(tokens) + params.ls2 * widen(update)).astype(tokens.dtype)


def feed_forward(params: Mlp | SwiGlu, x: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """GELU network, or SwiGLU (Shazeer 2020) where the parameters are its.

    All tokens are rows of one matrix: as a product leaves it, XLA can write GELU over it.
    """
    rows = x.reshape(-1, x.shape[-1])
    if isinstance(params, Mlp):
        y = linear(params.fc2, gelu(checkpoint_name(linear(params.fc1, rows), "hidden")))
    else:
        gate, value = jnp.split(checkpoint_name(linear(params.w12, rows), "hidden"), 2, axis=-1)
        y = linear(params.w3, jax.nn.silu(gate) * value)
    return y.reshape(x.shape)


def interpolate_positions(
    positions: Float[Array, "grid grid dim"], grid: tuple[int, int], config: ViTConfig
) -> Float[Array, "rows columns dim"]:
    """Resize the stored grid of position embeddings as the public models do.

    Bicubic interpolation is linear and separable: two small matrix products, whose constants are
    made while tracing, so one set of weights serves every image size. Models without registers use
    torch's bicubic (a = -0.75) with the scale (size + 0.1) / grid; those with registers its
    antialiased one (a = -0.5) at the exact scale.
    """
    side = positions.shape[0]
    if grid == (side, side):
        return positions
    weights = _antialias_weights if config.registers else _bicubic_weights
    rows, columns = (jnp.asarray(weights(side, size), positions.dtype) for size in grid)
    precision = jax.lax.Precision.HIGHEST
    return jnp.einsum("ri,cj,ijd->rcd", rows, columns, positions, precision=precision)


def _cubic(x: np.ndarray, a: float) -> np.ndarray:
    """Keys' cubic convolution kernel."""
    x = np.abs(x)
    near = (a + 2) * x**3 - (a + 3) * x**2 + 1
    far = a * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


@functools.cache
def _bicubic_weights(source: int, target: int) -> np.ndarray:
    """(target, source) weights of torch's bicubic upsampling, borders replicated."""
    scale = source / (target + 0.1)
    centres = (np.arange(target) + 0.5) * scale - 0.5
    weights = np.zeros((target, source))
    for row, centre in enumerate(centres):
        taps = math.floor(centre) + np.arange(-1, 3)
        np.add.at(weights[row], np.clip(taps, 0, source - 1), _cubic(centre - taps, -0.75))
    return weights


@functools.cache
def _antialias_weights(source: int, target: int) -> np.ndarray:
    """(target, source) weights of torch's antialiased bicubic, wider where it shrinks."""
    scale = source / target
    stretch = max(scale, 1.0)
    centres = (np.arange(target) + 0.5) * scale
    weights = _cubic((np.arange(source) + 0.5 - centres[:, None]) / stretch, -0.5)
    return weights / weights.sum(axis=1, keepdims=True)
