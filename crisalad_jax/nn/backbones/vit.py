"""DINOv2's vision transformer ViT/14 (Oquab et al. 2023; registers: Darcet et al. 2024).

Written from the papers and the behaviour of facebookresearch/dinov2, whose golden outputs it meets.
The blocks are DINOv3's too, whose other parts are in `dinov3.py`.
"""

import abc
import dataclasses
import functools
import itertools
import math
import operator
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import choose, require, require_positive
from crisalad_jax.config.part import non_semantic_field
from crisalad_jax.nn import draw
from crisalad_jax.nn.adapter import (
    Adapter,
    AdapterConfig,
    SerialParallelAdapter,
    SideAdapter,
    adapter,
    init_adapter,
    train_adapter,
)
from crisalad_jax.nn.attention import (
    Attention,
    Rotation,
    attention,
    first_token_attention,
    padded_length,
)
from crisalad_jax.nn.backbones.base import BACKBONES, Backbone, FeatureRequest, Features
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    at_least_float32,
    gelu,
    init_layer_norm,
    init_small_linear,
    layer_norm,
    linear,
    split_statistics,
)
from crisalad_jax.utils.pytree import pytree_dataclass

NORM_EPSILON = 1e-6
_PRODUCTS = ("qkv", "attended", "hidden", "down", "mixed")
"""Results of a block's large products and the tokens between its halves, by their names."""
_POLICIES = {
    "dots": jax.checkpoint_policies.save_only_these_names(*_PRODUCTS),
    "full": jax.checkpoint_policies.nothing_saveable,
    "none": jax.checkpoint_policies.everything_saveable,
}


@pytree_dataclass
class Mlp:
    """Feed-forward network: fc1, GELU, fc2."""

    fc1: Linear
    fc2: Linear


@pytree_dataclass
class SwiGlu:
    """Feed-forward network of ViT-g: w12 computes gate and value side by side, w3 projects."""

    w12: Linear
    w3: Linear


@pytree_dataclass
class Block:
    """One transformer block; `ls1` and `ls2` are LayerScale's gains."""

    norm1: LayerNorm
    attn: Attention
    ls1: Float[Array, "*stack dim"]
    norm2: LayerNorm
    mlp: Mlp | SwiGlu
    ls2: Float[Array, "*stack dim"]
    adapter: Adapter | None


@pytree_dataclass
class ViT:
    """The backbone. In `blocks` every leaf has a leading depth axis.

    A tuple of such stacks runs in sequence. Training uses it to exclude frozen blocks from the
    gradient where only the last ones train. Rotary positions have no parameters: `pos_embed_cls`
    and `pos_embed` are None. Without registers `register_tokens` is None.
    """

    patch_embed: Linear
    """Linear layer whose weight's rows are a patch's pixels in (row, column, channel) order."""
    cls_token: Float[Array, " dim"]
    register_tokens: Float[Array, "register dim"] | None
    pos_embed_cls: Float[Array, " dim"] | None
    pos_embed: Float[Array, "grid grid dim"] | None
    blocks: Block | tuple[Block, ...]
    norm: LayerNorm


Carry = Float[Array, "image token dim"] | tuple[Array, Array]
"""Tokens that run through the blocks, with those on the path of side adapters if there is one."""


@dataclasses.dataclass(frozen=True)
class VisionTransformer(Backbone):
    """What DINOv2's and DINOv3's transformers share: all but positions, and how a block attends."""

    inserts: ClassVar[bool] = True
    attends: ClassVar[bool] = True
    norm_epsilon: ClassVar[float] = NORM_EPSILON
    """Added to the variance in every layer norm."""
    token_deviation: ClassVar[float] = 1e-6
    """Standard deviation of an untrained class token and registers."""
    heads: int = 12
    mlp_ratio: float = 4.0
    ffn: Literal["mlp", "swiglu"] = "mlp"
    registers: int = 0
    layer_scale_init: float = non_semantic_field(1.0)
    adapter: AdapterConfig = AdapterConfig()

    def __post_init__(self) -> None:
        """Check the ranges."""
        name = type(self).__name__
        require_positive(self, "dim", "depth", "heads", "mlp_ratio")
        require(
            self.registers >= 0,
            f"{name}.registers: found {self.registers}, expected at least 0",
        )
        require(
            self.dim % self.heads == 0,
            f"{name}.dim: found {self.dim}, expected a multiple of the {self.heads} heads",
        )
        require(
            self.hidden >= 1,
            f"{name}.mlp_ratio: found {self.mlp_ratio}, expected a hidden width of at least 1",
        )
        self.adapter.width(self.dim)

    @property
    def hidden(self) -> int:
        """Hidden width of the feed-forward network; SwiGLU's 2/3 round up to a multiple of 8."""
        hidden = int(self.dim * self.mlp_ratio)
        return (int(hidden * 2 / 3) + 7) // 8 * 8 if self.ffn == "swiglu" else hidden

    @property
    def adapter_dim(self) -> int:
        """Width of the adapter's bottleneck."""
        return self.adapter.width(self.dim)

    @property
    def extras(self) -> str:
        """Registers and the kind of adapter."""
        return f", {self.registers} registers, adapter {self.adapter.kind}"

    @abc.abstractmethod
    def init_positions(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, " dim"] | None, Float[Array, "grid grid dim"] | None]:
        """Draw `ViT.pos_embed_cls` and `ViT.pos_embed`."""

    @abc.abstractmethod
    def add_positions(
        self, params: ViT, patches: Float[Array, "*batch patch dim"], grid: tuple[int, int]
    ) -> tuple[Float[Array, " dim"], Float[Array, "*batch patch dim"]]:
        """Return the class token and the embedded patches, with their positions added if any."""

    def rotation(self, grid: tuple[int, int]) -> Rotation | None:
        """Return the patches' angles, by which every block rotates queries and keys; or None."""
        return None

    def attention_of(self, layer: Block) -> Attention:
        """Return the parameters that a block attends by."""
        return layer.attn

    def init(self, key: PRNGKeyArray) -> ViT:
        """Draw parameters as published before training: linears of deviation 0.02, biases 0."""
        return init_vit(key, self)

    def apply(
        self,
        params: ViT,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
    ) -> Features:
        """Return the features of normalised images whose sides are multiples of a patch's."""
        return vit(params, images, self, request, remat=remat)

    def apply_training(
        self,
        params: ViT,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
        valid: Bool[Array, " image"],
    ) -> tuple[Features, ViT]:
        """Return the features of a training batch, and the statistics of adapters' batch norms."""
        return train_vit(params, images, self, request, remat=remat, valid=valid)

    def split_blocks(self, params: ViT, first: int) -> ViT:
        """Cut the stack of blocks in two."""
        stack = _one_stack(params)
        halves = slice(first), slice(first, None)
        parts = tuple(jax.tree.map(operator.itemgetter(half), stack) for half in halves)
        return dataclasses.replace(params, blocks=parts)

    def adopt(self, config: Any, params: ViT, fresh: ViT) -> tuple[Any, ViT]:
        """Take the fresh adapters where the other's are of another kind or size."""
        if config.adapter == self.adapter:
            return config, params
        blocks = dataclasses.replace(_one_stack(params), adapter=_one_stack(fresh).adapter)
        changed = dataclasses.replace(config, adapter=self.adapter)
        return changed, dataclasses.replace(params, blocks=blocks)

    def join_blocks(self, params: ViT) -> ViT:
        """Join the stacks of blocks into one."""
        if isinstance(params.blocks, Block):
            return params
        stack = jax.tree.map(lambda *parts: jnp.concatenate(parts), *params.blocks)
        return dataclasses.replace(params, blocks=stack)


@BACKBONES.register("vit")
@dataclasses.dataclass(frozen=True)
class ViTConfig(VisionTransformer):
    """A DINOv2 vision transformer with patches of 14 x 14 (Oquab et al. 2023)."""

    position_grid: int = 37
    """Side of the stored grid of position embeddings (37 in the public checkpoints: 518 / 14)."""
    position_resize: Literal["dinov2", "plain"] = "dinov2"
    """Resizing of that grid to an image's: as DINOv2's models do, which antialias where there are
    registers; or plain, never antialiased."""
    position_init: Literal["random", "sincos"] = non_semantic_field("random")
    """Initialisation of the position embeddings where no weights are loaded."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        require_positive(self, "position_grid")
        require(
            self.position_init != "sincos" or self.dim % 4 == 0,
            f"ViTConfig.dim: found {self.dim}, expected a multiple of 4 for a sin-cos start",
        )

    def init_positions(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, " dim"], Float[Array, "grid grid dim"]]:
        """Draw the patches' positions, or make sine-cosine codes; the class token's are 0."""
        side = self.position_grid
        if self.position_init == "sincos":
            positions = jax.device_put(_sincos_positions(side, self.dim).astype(np.float32))
        else:
            positions = draw.normal(key, (side, side, self.dim), scale=0.02)
        return draw.zeros(self.dim), positions

    def add_positions(
        self, params: ViT, patches: Float[Array, "*batch patch dim"], grid: tuple[int, int]
    ) -> tuple[Float[Array, " dim"], Float[Array, "*batch patch dim"]]:
        """Add the class token's position to it, and the resized grid of positions to patches."""
        assert params.pos_embed_cls is not None
        assert params.pos_embed is not None
        positions = interpolate_positions(params.pos_embed, grid, self)
        class_token = params.cls_token + params.pos_embed_cls
        return class_token, at_least_float32(patches) + positions.reshape(patches.shape[-2:])


def _one_stack(params: ViT) -> Block:
    assert isinstance(params.blocks, Block)  # only training cuts the stack
    return params.blocks


def init_vit(key: PRNGKeyArray, config: VisionTransformer) -> ViT:
    """Draw parameters as published before training: linears normal of deviation 0.02, biases 0."""
    patch_key, class_key, register_key, position_key, block_key = draw.split(key, 5)
    dim, deviation = config.dim, config.token_deviation
    pos_embed_cls, pos_embed = config.init_positions(position_key)
    return ViT(
        patch_embed=init_small_linear(patch_key, 3 * config.patch_size**2, dim),
        cls_token=draw.normal(class_key, (dim,), scale=deviation),
        register_tokens=draw.normal(register_key, (config.registers, dim), scale=deviation)
        if config.registers
        else None,
        pos_embed_cls=pos_embed_cls,
        pos_embed=pos_embed,
        blocks=draw.stacked(
            functools.partial(_init_block, config=config), draw.split(block_key, config.depth)
        ),
        norm=init_layer_norm(dim),
    )


def _init_block(key: PRNGKeyArray, config: VisionTransformer) -> Block:
    qkv, proj, first, second, adapter_key = draw.split(key, 5)
    dim, hidden = config.dim, config.hidden
    if config.ffn == "swiglu":
        mlp = SwiGlu(
            init_small_linear(first, dim, 2 * hidden), init_small_linear(second, hidden, dim)
        )
    else:
        mlp = Mlp(init_small_linear(first, dim, hidden), init_small_linear(second, hidden, dim))
    return Block(
        norm1=init_layer_norm(dim),
        attn=Attention(init_small_linear(qkv, dim, 3 * dim), init_small_linear(proj, dim, dim)),
        ls1=draw.full((dim,), config.layer_scale_init),
        norm2=init_layer_norm(dim),
        mlp=mlp,
        ls2=draw.full((dim,), config.layer_scale_init),
        adapter=init_adapter(adapter_key, dim, config.adapter),
    )


def _sincos_positions(side: int, dim: int) -> np.ndarray:
    """Make fixed 2-D sine-cosine codes (MoCo v3): half the width for rows, half for columns."""
    frequencies = 1e4 ** -(np.arange(dim // 4) / (dim // 4))
    angles = np.arange(side)[:, None] * frequencies
    code = np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)
    rows = np.broadcast_to(code[:, None], (side, side, dim // 2))
    columns = np.broadcast_to(code[None], (side, side, dim // 2))
    return np.concatenate([rows, columns], axis=-1)


def vit(
    params: ViT,
    images: Float[Array, "image height width 3"],
    config: VisionTransformer,
    request: FeatureRequest = FeatureRequest(),
    *,
    remat: str = "dots",
) -> Features:
    """Compute features of a batch of normalised images whose sides are multiples of a patch's.

    Levels are concatenated, to a width of levels times dim. The class token is the last level's.
    With several levels the stack of blocks is cut at each, which for inference needs the memory of
    its parameters once more. Blocks after the last level are not run.

    Raises:
        InputError: while tracing, levels that are not in order or more than there are blocks,
            several levels of a facet or without the last block, or, of adapters on a path beside
            the blocks, other tokens than the last block's, inserted ones, or the class token's
            attention.
    """
    return train_vit(params, images, config, request, remat=remat, valid=None)[0]


def train_vit(
    params: ViT,
    images: Float[Array, "image height width 3"],
    config: VisionTransformer,
    request: FeatureRequest,
    *,
    remat: str,
    valid: Bool[Array, " image"] | None,
) -> tuple[Features, ViT]:
    """Compute the features of a training batch, by the batch norms' statistics of the batch.

    Args:
        params: see `vit`.
        images: see `vit`.
        config: see `vit`.
        request: see `vit`; of a facet the stored statistics are taken, and stay.
        remat: `ModelConfig.remat`.
        valid: which images the statistics are taken of. None takes the stored ones, which stay.

    Returns:
        (features, statistics): a tree of the structure of `params`, which holds the updated running
        statistics, and None for all other leaves.

    Raises:
        InputError: as `vit`.
    """
    levels = (config.depth,) if request.levels is None else request.levels
    require(
        levels[0] > 0 and levels[-1] <= config.depth and list(levels) == sorted(set(levels)),
        f"levels: found {levels}, expected numbers of blocks in order, 1 to {config.depth}",
    )
    require(
        config.adapter.kind != "side" or request.facet != "token" or levels == (config.depth,),
        f"levels: found {levels} with adapters beside the blocks, expected the last alone, "
        f"{config.depth}",
    )
    tokens = embed(params, images, config)
    grid = config.grid((images.shape[1], images.shape[2]))
    blocks, outputs, attended = params.blocks, [], None
    if request.inserted is not None:
        tokens, measured = _with_inserted(
            params, tokens, grid, config, request, remat=remat, valid=valid
        )
        blocks = _as_cut(measured, params.blocks)
        outputs.append(tokens)
    elif request.class_attention:
        tokens, measured, attended = _with_class_attention(
            params, tokens, grid, config, request, remat=remat, valid=valid
        )
        blocks = _as_cut(measured, params.blocks)
        outputs.append(tokens)
    elif request.facet == "token" and levels[-1] == config.depth:
        measured = []
        for stack_group in _cut_at(params.blocks, levels):
            tokens, parts = _run_stacks(stack_group, tokens, grid, config, remat=remat, valid=valid)
            measured += parts
            outputs.append(tokens)
        blocks = _as_cut(measured, params.blocks)
    else:
        require(
            len(levels) == 1,
            f"levels: found {levels}, expected one of a facet, and several of tokens alone, up to "
            f"the last block {config.depth}",
        )
        outputs.append(_facet(params, tokens, grid, config, levels[0], request.facet))
    if request.norm:
        outputs = [layer_norm(params.norm, level, epsilon=config.norm_epsilon) for level in outputs]
    front = 0 if request.inserted is None else len(request.inserted)
    patches = [level[:, front + 1 + config.registers :] for level in outputs]
    joined = patches[0] if len(patches) == 1 else jnp.concatenate(patches, axis=-1)
    inserted = None if request.inserted is None else outputs[-1][:, :front]
    statistics, _ = split_statistics(dataclasses.replace(params, blocks=blocks))
    return Features(outputs[-1][:, front], joined, inserted, attended), statistics


def _with_inserted(
    params: ViT,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    request: FeatureRequest,
    *,
    remat: str,
    valid: Bool[Array, " image"] | None,
) -> tuple[Float[Array, "image all dim"], list[Block]]:
    """Run all blocks, with the requested tokens in front after the first `request.insertion`."""
    assert request.insertion is not None
    assert request.inserted is not None
    require(
        config.adapter.kind != "side" and request.levels is None and request.facet == "token",
        "features: found inserted tokens with levels, a facet or adapters beside the blocks, "
        "expected none of these",
    )
    before, after = _cut_at(params.blocks, (request.insertion, config.depth))
    run = functools.partial(_run_stacks, grid=grid, config=config, remat=remat, valid=valid)
    tokens, first = run(before, tokens)
    front = jnp.broadcast_to(request.inserted, (tokens.shape[0], *request.inserted.shape))
    tokens, last = run(after, jnp.concatenate([front.astype(tokens.dtype), tokens], axis=1))
    return tokens, first + last


def _with_class_attention(
    params: ViT,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    request: FeatureRequest,
    *,
    remat: str,
    valid: Bool[Array, " image"] | None,
) -> tuple[Float[Array, "image token dim"], list[Block], Float[Array, "image patch"]]:
    """Run all blocks, and return how much of each patch the last one's class token takes.

    The shares are summed over heads. The blocks' own attention does not keep its weights, so that
    one row of them is computed a second time.
    """
    require(
        config.adapter.kind != "side" and request.levels is None and request.facet == "token",
        "features: found the class token's attention with levels, a facet or adapters beside the "
        "blocks, expected none of these",
    )
    before, after = _cut_at(params.blocks, (config.depth - 1, config.depth))
    run = functools.partial(_run_stacks, grid=grid, config=config, remat=remat, valid=valid)
    tokens, first = run(before, tokens)
    with jax.named_scope("blocks"):
        last = jax.tree.map(operator.itemgetter(-1), after[-1])
        normed = layer_norm(last.norm1, tokens, epsilon=config.norm_epsilon)
        attn, rotation = config.attention_of(last), config.rotation(grid)
        shares = first_token_attention(attn, normed, config.heads, rotation=rotation).sum(axis=-2)
    tokens, final = run(after, tokens)
    return tokens, first + final, shares[:, 1 + config.registers :]


def _cut_at(
    blocks: Block | tuple[Block, ...], depths: Sequence[int]
) -> Iterator[tuple[Block, ...]]:
    """Yield the stacks of blocks between each of `depths` and the one before."""
    stacks = blocks if isinstance(blocks, tuple) else (blocks,)
    if len(depths) == 1:
        yield stacks
        return
    for begin, end in itertools.pairwise((0, *depths)):
        parts, start = [], 0
        for stack in stacks:
            chosen = slice(max(begin - start, 0), max(end - start, 0))
            parts.append(jax.tree.map(operator.itemgetter(chosen), stack))
            start += len(stack.ls1)
        yield tuple(part for part in parts if len(part.ls1))


def _as_cut(parts: Sequence[Block], blocks: Block | tuple[Block, ...]) -> Any:
    """Join parts of a stack of blocks in order, and cut the whole as `blocks` are cut."""
    whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    if isinstance(blocks, Block):
        return whole
    ends = itertools.accumulate(len(stack.ls1) for stack in blocks)
    return tuple(
        jax.tree.map(operator.itemgetter(slice(begin, end)), whole)
        for begin, end in itertools.pairwise((0, *ends))
    )


def _facet(
    params: ViT,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    level: int,
    name: str,
) -> Float[Array, "image token dim"]:
    """Compute a facet of the last of `level` blocks; the blocks after it are not run.

    The facets are queries, keys and values of the block's attention, with heads side by side and
    not rotated, or its output tokens (AnyLoc: Keetha et al. 2023).
    """
    stack = _one_stack(params)

    def numbered(number: Int[Array, ""] | int) -> Block:
        # Index the stack: a slice of it to scan over would copy its weights.
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, number, 0, False), stack)

    tokens, length = _padded(tokens, config)

    def body(
        carry: Float[Array, "image token dim"], number: Int[Array, ""]
    ) -> tuple[Float[Array, "image token dim"], None]:
        return block(numbered(number), carry, grid, config, length=length), None

    whole = level if name == "token" else level - 1
    with jax.named_scope("blocks"):
        tokens, _ = jax.lax.scan(body, tokens, jnp.arange(whole))
        tokens = tokens[:, :length]
        if name == "token":
            return tokens
        last = numbered(level - 1)
        here = ("query", "key", "value").index(name) * config.dim
        qkv = config.attention_of(last).qkv
        part = jax.tree.map(lambda x: x[..., here : here + config.dim], qkv)
        return linear(part, layer_norm(last.norm1, tokens, epsilon=config.norm_epsilon))


def embed(
    params: ViT, images: Float[Array, "*batch height width 3"], config: VisionTransformer
) -> Float[Array, "*batch token dim"]:
    """Embed images: class token, registers and patches, with their positions added if any."""
    *batch, height, width, _ = images.shape
    rows, columns = config.grid((height, width))
    size = config.patch_size
    pixels = images.reshape(*batch, rows, size, columns, size, 3).swapaxes(-4, -3)
    patches = linear(params.patch_embed, pixels.reshape(*batch, rows * columns, 3 * size**2))
    class_token, placed = config.add_positions(params, patches, (rows, columns))
    first = class_token[None]
    if params.register_tokens is not None:
        first = jnp.concatenate([first, params.register_tokens])
    first = jnp.broadcast_to(first, (*batch, *first.shape))
    return jnp.concatenate([first, placed], axis=-2).astype(images.dtype)


def run_blocks(
    params: ViT,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    *,
    remat: str = "dots",
) -> Float[Array, "image token dim"]:
    """Run all blocks in turn with one compiled body; `remat` is `ModelConfig.remat`."""
    stacks = params.blocks if isinstance(params.blocks, tuple) else (params.blocks,)
    return _run_stacks(stacks, tokens, grid, config, remat=remat, valid=None)[0]


def _run_stacks(
    stacks: Sequence[Block],
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    *,
    remat: str,
    valid: Bool[Array, " image"] | None,
) -> tuple[Float[Array, "image token dim"], list[Block]]:
    """Run stacks of blocks in turn; return the tokens and each stack's running statistics.

    Side adapters have a path beside the blocks, from which the tokens come. After every block its
    adapter takes the sum of both paths. Between the first and the last block the tokens are padded
    as `attention` needs them on this platform.
    """
    tokens, length = _padded(tokens, config)

    def body(carry: Carry, layer: Block) -> tuple[Carry, Block]:
        if isinstance(carry, jax.Array):
            return train_block(layer, carry, grid, config, valid, length=length)
        tokens, beside = carry
        layer_alone = dataclasses.replace(layer, adapter=None)
        tokens = block(layer_alone, tokens, grid, config, length=length)
        carry = tokens, _beside(layer, tokens + beside, grid, config, length)
        return carry, split_statistics(layer)[0]

    # prevent_cse=False: inside a scan, CSE cannot undo the remat.
    body = jax.checkpoint(body, prevent_cse=False, policy=choose("remat", remat, _POLICIES))
    statistics = []
    carry: Carry = (tokens, tokens) if config.adapter.kind == "side" else tokens
    with jax.named_scope("blocks"):
        for stack in stacks:
            carry, measured = jax.lax.scan(body, carry, stack)
            statistics.append(measured)
    tokens = carry if isinstance(carry, jax.Array) else carry[1]
    return tokens[:, :length], statistics


def _padded(
    tokens: Float[Array, "image token dim"], config: VisionTransformer
) -> tuple[Float[Array, "image padded dim"], int | None]:
    """Return tokens with padding after them, and their number; None where none is needed."""
    count = tokens.shape[1]
    more = padded_length(count, tokens.dtype, config.dim, config.heads) - count
    if not more:
        return tokens, None
    return jnp.pad(tokens, ((0, 0), (0, more), (0, 0))), count


def _beside(
    layer: Block,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    length: int | None,
) -> Float[Array, "image token dim"]:
    """Apply a block's side adapter, with its skip."""
    assert isinstance(layer.adapter, SideAdapter)
    with jax.named_scope("adapter"):
        adapted = adapter(layer.adapter, tokens, grid, length=length)
        update = config.adapter.alpha * at_least_float32(adapted)
        return (at_least_float32(tokens) + update).astype(tokens.dtype)


def block(
    params: Block,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    *,
    length: int | None = None,
) -> Float[Array, "image token dim"]:
    """Run one block (paper Eq. 2), with LayerScale on MLP plus adapter, as in CricaVPR."""
    return train_block(params, tokens, grid, config, None, length=length)[0]


def train_block(
    params: Block,
    tokens: Float[Array, "image token dim"],
    grid: tuple[int, int],
    config: VisionTransformer,
    valid: Bool[Array, " image"] | None,
    *,
    length: int | None = None,
) -> tuple[Float[Array, "image token dim"], Block]:
    """Run one block on a training batch.

    Args:
        params: the block.
        tokens: of a batch of images.
        grid: rows and columns of patches.
        config: the backbone.
        valid: which images the batch norms' statistics are taken of; None takes the stored ones.
        length: number of first tokens that are no padding; None is all.

    Returns:
        (tokens, statistics): the second as `train_vit` returns it.
    """
    normed = layer_norm(params.norm1, tokens, epsilon=config.norm_epsilon)
    attn, rotation = config.attention_of(params), config.rotation(grid)
    attended = attention(attn, normed, config.heads, length=length, rotation=rotation, key=None)
    beside = params.adapter
    if isinstance(beside, SerialParallelAdapter):
        with jax.named_scope("adapter"):
            attended = attended + adapter(beside.serial, attended, grid, length=length)
        beside = beside.parallel
    tokens = (at_least_float32(tokens) + params.ls1 * at_least_float32(attended)).astype(
        tokens.dtype
    )
    tokens = checkpoint_name(tokens, "attended")
    normed = layer_norm(params.norm2, tokens, epsilon=config.norm_epsilon)
    update = feed_forward(params.mlp, normed)
    if beside is not None:
        with jax.named_scope("adapter"):
            if valid is None or isinstance(params.adapter, SerialParallelAdapter):
                adapted = adapter(beside, normed, grid, length=length)
            else:
                adapted, trained = train_adapter(beside, normed, grid, valid, length=length)
                params = dataclasses.replace(params, adapter=trained)
            update = update + config.adapter.alpha * adapted
    tokens = (at_least_float32(tokens) + params.ls2 * at_least_float32(update)).astype(tokens.dtype)
    return tokens, split_statistics(params)[0]


def feed_forward(params: Mlp | SwiGlu, x: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Apply the feed-forward network: GELU, or SwiGLU (Shazeer 2020) if `params` are its.

    All tokens are rows of one matrix, so that XLA can write GELU over the product in place.
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
    computed while tracing. One set of weights therefore serves every image size. Models without
    registers use torch's bicubic (a = -0.75) with the scale (size + 0.1) / grid. Models with
    registers use its antialiased one (a = -0.5) at the exact scale, but see `position_resize`.
    """
    side = positions.shape[0]
    if grid == (side, side):
        return positions
    antialias = config.registers and config.position_resize == "dinov2"
    weights = _antialias_weights if antialias else _bicubic_weights
    rows, columns = (jnp.asarray(weights(side, size), positions.dtype) for size in grid)
    precision = jax.lax.Precision.HIGHEST
    return jnp.einsum("ri,cj,ijd->rcd", rows, columns, positions, precision=precision)


def _cubic(x: np.ndarray, a: float) -> np.ndarray:
    """Evaluate Keys' cubic convolution kernel."""
    x = np.abs(x)
    near = (a + 2) * x**3 - (a + 3) * x**2 + 1
    far = a * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


@functools.cache
def _bicubic_weights(source: int, target: int) -> np.ndarray:
    """Compute (target, source) weights of torch's bicubic upsampling, with replicated borders."""
    scale = source / (target + 0.1)
    centres = (np.arange(target) + 0.5) * scale - 0.5
    weights = np.zeros((target, source))
    for row, centre in enumerate(centres):
        taps = math.floor(centre) + np.arange(-1, 3)
        np.add.at(weights[row], np.clip(taps, 0, source - 1), _cubic(centre - taps, -0.75))
    return weights


@functools.cache
def _antialias_weights(source: int, target: int) -> np.ndarray:
    """Compute (target, source) weights of torch's antialiased bicubic, wider when shrinking."""
    scale = source / target
    stretch = max(scale, 1.0)
    centres = (np.arange(target) + 0.5) * scale
    weights = _cubic((np.arange(source) + 0.5 - centres[:, None]) / stretch, -0.5)
    return weights / weights.sum(axis=1, keepdims=True)
