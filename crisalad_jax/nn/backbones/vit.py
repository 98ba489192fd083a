"""DINOv2's vision transformer ViT/14 (Oquab et al. 2023; registers: Darcet et al. 2024).

Written from the papers and the behaviour of facebookresearch/dinov2, whose outputs it reproduces.
DINOv3 has the same blocks; its other parts are in `dinov3.py`.
"""

import dataclasses
import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import (
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    require,
    require_field,
)
from crisalad_jax.config.part import OrName, non_semantic_field
from crisalad_jax.config.registry import part_field, resolve_names
from crisalad_jax.nn import random_init
from crisalad_jax.nn.adapters import ADAPTERS, Adapter, BlockShape, TokenInfo
from crisalad_jax.nn.adapters.base import HOOKS
from crisalad_jax.nn.adapters.bottleneck import NoAdapter
from crisalad_jax.nn.attention import (
    Attention,
    Rotation,
    attention,
    attention_weights,
    first_token_attention,
    part_of_qkv,
)
from crisalad_jax.nn.attention_fused import padded_length
from crisalad_jax.nn.backbones.base import (
    BACKBONES,
    Backbone,
    Features,
    FeatureSpec,
    Grid,
    Patches,
    Pixels,
    TokenBatch,
    Valid,
)
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    LinearUpdate,
    adapted_linear,
    at_least_float32,
    gelu,
    init_layer_norm,
    init_small_linear,
    layer_norm,
    linear,
    merge_statistics,
    no_update,
    split_statistics,
)
from crisalad_jax.nn.products import keep
from crisalad_jax.utils.pytree import expect_like, pytree_dataclass

NORM_EPSILON = 1e-6
_PRODUCTS = ("qkv", "attended", "hidden", "down", "mixed")
"""Names of the results of a block's large products, and of the tokens between its halves."""
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
    """Feed-forward network of ViT-g, SwiGLU: w12 computes gate and value together, w3 projects."""

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
    adapter: Any
    """Parameters of `VisionTransformer.adapter`; None if the block has none."""


@pytree_dataclass
class ViT:
    """Parameters of the backbone.

    Leaves of `blocks` have a leading depth axis, which is shorter for adapters if only the last
    blocks have one. `blocks` may also be a tuple of such stacks, which run in sequence: training
    uses a tuple to exclude frozen blocks from the gradient if only the last ones train. With rotary
    positions, which have no parameters, `pos_embed_cls` and `pos_embed` are None. Without
    registers, `register_tokens` is None.
    """

    patch_embed: Linear
    """Linear layer; its weight's rows are a patch's pixels in (row, column, channel) order."""
    cls_token: Float[Array, " dim"]
    register_tokens: Float[Array, "register dim"] | None
    pos_embed_cls: Float[Array, " dim"] | None
    pos_embed: Float[Array, "grid grid dim"] | None
    blocks: Block | tuple[Block, ...]
    norm: LayerNorm


@dataclasses.dataclass(frozen=True)
class VisionTransformer(Backbone):
    """Base of DINOv2's and DINOv3's transformers, which differ in positions and attention."""

    supports_prompt_tokens: ClassVar[bool] = True
    exposes_cls_attention: ClassVar[bool] = True
    norm_epsilon: ClassVar[float] = NORM_EPSILON
    """Constant added to the variance in every layer norm."""
    token_deviation: ClassVar[float] = 1e-6
    """Standard deviation of the initial class token and registers."""
    heads: PositiveInt = 12
    mlp_ratio: PositiveFloat = 4.0
    ffn: Literal["mlp", "swiglu"] = "mlp"
    registers: NonNegativeInt = 0
    layer_scale_init: float = non_semantic_field(1.0)
    adapter: OrName[Adapter] = part_field(ADAPTERS, "depthwise")
    """Registered adapter of every block, or its name."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        resolve_names(self)
        words = f"a multiple of the {self.heads} heads"
        require_field(self, "dim", self.dim % self.heads == 0, words)
        adapter, few = self.adapter, self.adapter.last is not None
        acts = isinstance(adapter, NoAdapter) or adapter.has(*HOOKS)
        require_field(self, "adapter", acts, f"one with a method {', '.join(HOOKS)}")
        words = f"one in all blocks, because {adapter.part_name} has prompts"
        require_field(self, "adapter", not (few and adapter.has("prompts")), words)
        adapter.check(self.block_shape)

    @property
    def hidden(self) -> int:
        """Feed-forward width dim * mlp_ratio; SwiGLU: 2/3 of it, rounded up to a multiple of 8."""
        hidden = int(self.dim * self.mlp_ratio)
        return (int(hidden * 2 / 3) + 7) // 8 * 8 if self.ffn == "swiglu" else hidden

    @property
    def block_shape(self) -> BlockShape:
        """Sizes of a block, for its adapter."""
        dim, hidden, swiglu = self.dim, self.hidden, self.ffn == "swiglu"
        first, second = ("w12", "w3") if swiglu else ("fc1", "fc2")
        mlp = {first: (dim, 2 * hidden if swiglu else hidden), second: (hidden, dim)}
        return BlockShape(dim, {"qkv": (dim, 3 * dim), "proj": (dim, dim), **mlp})

    @property
    def side_paths(self) -> int:
        """Number of side paths of its adapters."""
        return self.adapter.paths

    @property
    def extras(self) -> str:
        """The number of registers, and the adapter."""
        return f", {self.registers} registers, adapter {self.adapter.part_name}"

    def init_positions(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, " dim"] | None, Float[Array, "grid grid dim"] | None]:
        """Draw `ViT.pos_embed_cls` and `ViT.pos_embed`; by default there are none."""
        return None, None

    def add_positions(
        self, params: ViT, patches: Patches, grid: Grid
    ) -> tuple[Float[Array, " dim"], Patches]:
        """Return the class token and the embedded patches, with any positions added."""
        return params.cls_token, patches

    def rotation(self, grid: Grid) -> Rotation | None:
        """Return the angles by which every block rotates the patches' queries and keys, or None."""
        return None

    def attention_of(self, layer: Block) -> Attention:
        """Return the parameters of a block's attention."""
        return layer.attn

    def init(self, key: PRNGKeyArray) -> ViT:
        """Draw parameters as published: linear layers of standard deviation 0.02, biases of 0."""
        patch, first, register, position, block = random_init.split(key, 5)
        deviation, normal = self.token_deviation, random_init.normal
        pos_embed_cls, pos_embed = self.init_positions(position)
        registers = normal(register, (self.registers, self.dim), scale=deviation)
        return ViT(
            patch_embed=init_small_linear(patch, 3 * self.patch_size**2, self.dim),
            cls_token=normal(first, (self.dim,), scale=deviation),
            register_tokens=registers if self.registers else None,
            pos_embed_cls=pos_embed_cls,
            pos_embed=pos_embed,
            blocks=self._init_blocks(random_init.split(block, self.depth)),
            norm=init_layer_norm(self.dim),
        )

    def _init_blocks(self, keys: Sequence[PRNGKeyArray]) -> Block:
        last = self.adapter.last
        if last is None:
            return random_init.stacked(self._init_block, keys)
        bare = dataclasses.replace(self, adapter="none")

        def adapter_of(key: PRNGKeyArray) -> Any:
            return self.adapter.init(random_init.split(key, 5)[-1], self.block_shape)

        adapters = random_init.stacked(adapter_of, keys[-last:])
        blocks = random_init.stacked(bare._init_block, keys)
        return dataclasses.replace(blocks, adapter=adapters)

    def _init_block(self, key: PRNGKeyArray) -> Block:
        qkv, proj, first, second, adapter_key = random_init.split(key, 5)
        dim, shape = self.dim, self.block_shape
        layers = [
            init_small_linear(layer_key, *sizes)
            for layer_key, sizes in zip(
                (qkv, proj, first, second), shape.linears.values(), strict=True
            )
        ]
        return Block(
            norm1=init_layer_norm(dim),
            attn=Attention(*layers[:2]),
            ls1=random_init.full((dim,), self.layer_scale_init),
            norm2=init_layer_norm(dim),
            mlp=SwiGlu(*layers[2:]) if self.ffn == "swiglu" else Mlp(*layers[2:]),
            ls2=random_init.full((dim,), self.layer_scale_init),
            adapter=self.adapter.init(adapter_key, shape),
        )

    def apply(
        self,
        params: ViT,
        images: Pixels,
        request: FeatureSpec = FeatureSpec(),
        *,
        remat: str = "dots",
        valid: Valid = None,
    ) -> tuple[Features, ViT]:
        """Compute features of normalised images whose sides are multiples of the patch size.

        Levels are concatenated, to a width of levels times `dim`. The class token is that of the
        last level. With several levels the stack of blocks is cut at each, which in inference needs
        memory for a second copy of its parameters. Blocks after the last level are not run.

        Args:
            params: parameters of the backbone.
            images: normalised pixels.
            request: the features to return.
            remat: see `ModelConfig.remat`.
            valid: mask of the images whose statistics the adapters' batch norms use, if all blocks
                are run; None uses the stored ones, without updating them.

        Returns:
            (features, updated): `updated` is `params`, or, if `valid` is given and all blocks are
            run, that tree with the new running statistics, and None for all other leaves.

        Raises:
            InputError: during tracing, if levels are out of order or exceed the number of blocks,
                or if more than one of these is used: levels or a facet, inserted tokens, the class
                token's attention, adapters on a side path.
        """
        levels = _checked_levels(request, self)
        stacks = params.blocks if isinstance(params.blocks, tuple) else (params.blocks,)
        depth, grid = self.depth, self.grid((images.shape[1], images.shape[2]))
        ends = list(levels)
        if request.facet != "token":
            ends = [levels[0] - 1]
        elif request.inserted is not None:
            ends = [request.insertion or 0, depth]
        elif request.class_attention:
            ends = [depth - 1, depth]
        is_whole = ends[-1] == depth
        valid = valid if is_whole else None
        tokens = embed(params, images, self)
        outputs, measured, attended, front = [], [], None, 0
        for begin, end in itertools.pairwise((0, *ends)):
            part, count = _between(stacks, begin, end), None
            if not is_whole and len(ends) == len(stacks) == 1:
                part, count = stacks, end
            tokens, statistics = run_blocks(
                part, tokens, grid, self, remat=remat, valid=valid, count=count, path=request.path
            )
            measured += statistics
            if end in levels:
                outputs.append(tokens)
            elif request.facet != "token":
                outputs.append(_facet(_block_at(stacks, end), tokens, self, request.facet))
            elif request.inserted is not None:
                front = len(request.inserted)
                first = jnp.broadcast_to(
                    request.inserted, (tokens.shape[0], *request.inserted.shape)
                )
                tokens = jnp.concatenate([first.astype(tokens.dtype), tokens], axis=1)
            else:  # the block's own attention does not store its weights: recompute a row
                layer = _block_at(stacks, end)
                shares = self._attention_by(first_token_attention, layer, tokens, grid)
                attended = shares.sum(axis=-2)[:, 1 + self.registers :]
        if request.norm:
            outputs = [layer_norm(params.norm, x, epsilon=self.norm_epsilon) for x in outputs]
        features = Features(
            outputs[-1][:, front],
            jnp.concatenate([x[:, front + 1 + self.registers :] for x in outputs], axis=-1),
            None if request.inserted is None else outputs[-1][:, :front],
            attended,
        )
        return features, params if valid is None else _statistics(params, measured)

    def attention_maps(
        self, params: ViT, images: Pixels, block: int
    ) -> Float[Array, "image head token token"]:
        """Compute the attention of the block with index `block`; see `nn.model.attention_maps`."""
        stack, grid = _one_stack(params), self.grid((images.shape[1], images.shape[2]))
        _checked_levels(FeatureSpec(class_attention=True), self)  # refuses the same adapters
        tokens, _ = run_blocks([stack], embed(params, images, self), grid, self, count=block)
        return self._attention_by(attention_weights, _block_at([stack], block), tokens, grid)

    def _attention_by(
        self, weigh: Callable[..., Array], layer: Block, tokens: TokenBatch, grid: Grid
    ) -> Array:
        """Compute a block's attention weights by `weigh`: for the first token, or for all."""
        with jax.named_scope("blocks"):
            normed = layer_norm(layer.norm1, tokens, epsilon=self.norm_epsilon)
            attn, rotation = self.attention_of(layer), self.rotation(grid)
            update = _update_of(layer, self)
            return weigh(attn, normed, self.heads, rotation=rotation, update=update)

    @property
    def trains(self) -> tuple[str, ...]:
        """Name pattern of the adapters' parameters; empty without adapters."""
        if isinstance(self.adapter, NoAdapter):
            return ()
        return ("blocks.*.adapter",) if self.adapter.last is None else ("blocks*.adapter",)

    def split_blocks(self, params: ViT, cuts: Sequence[int]) -> ViT:
        """Cut the stack of blocks before the blocks of these indices, into a tuple of stacks."""
        stack, ends = _one_stack(params), itertools.pairwise((0, *cuts, self.depth))
        return dataclasses.replace(params, blocks=tuple(_cut(stack, *pair) for pair in ends))

    def adapt_checkpoint(self, config: Any, params: ViT, fresh: ViT) -> tuple[Any, ViT]:
        """Replace the other backbone's adapters by the fresh ones if kind or settings differ."""
        if config.adapter == self.adapter:
            return config, params
        blocks = dataclasses.replace(_one_stack(params), adapter=_one_stack(fresh).adapter)
        changed = dataclasses.replace(config, adapter=self.adapter)
        return changed, dataclasses.replace(params, blocks=blocks)

    def merge_adapters(self, params: ViT) -> tuple[Any, ViT]:
        """Return (backbone, params) with the adapters merged into the linear layers they update."""
        adapter = self.adapter
        require(
            adapter.has("merge"),
            f"merge_adapters: found adapter {adapter.part_name}, expected one such as lora",
        )

        def merged(layer: Block) -> Block:
            def each(part: Any) -> Any:
                layers = {
                    field.name: adapter.merge(layer.adapter, field.name, getattr(part, field.name))
                    for field in dataclasses.fields(part)
                }
                return dataclasses.replace(part, **layers)

            return dataclasses.replace(
                layer, attn=each(layer.attn), mlp=each(layer.mlp), adapter=None
            )

        stack = _one_stack(params)
        first, depth = _unadapted(stack), self.depth
        adapted = _cut(stack, first, depth)
        blocks = jax.vmap(merged)(adapted)
        _check_merged(_block_at([adapted], 0), _block_at([blocks], 0), self)
        if first:
            before = dataclasses.replace(_cut(stack, 0, first), adapter=None)
            blocks = _joined([before, blocks])
        plain = dataclasses.replace(self, adapter="none")
        return plain, dataclasses.replace(params, blocks=blocks)

    def join_blocks(self, params: ViT) -> ViT:
        """Join the stacks of blocks into one."""
        if isinstance(params.blocks, Block):
            return params
        return dataclasses.replace(params, blocks=_joined(params.blocks))


@BACKBONES.register("vit")
class ViTConfig(VisionTransformer):
    """A DINOv2 vision transformer with patches of 14 x 14 (Oquab et al. 2023).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(backbone=ViTConfig(dim=384, heads=6)).patches
        256
    """

    position_grid: PositiveInt = 37
    """Side of the stored grid of position embeddings (37 in the public checkpoints: 518 / 14)."""
    position_resize: Literal["dinov2", "plain"] = "dinov2"
    """How the grid of position embeddings is resized to the patches of an image: "dinov2"
    antialiases if there are registers, "plain" never does."""
    position_init: Literal["random", "sincos"] = non_semantic_field("random")
    """Initialisation of the position embeddings if no weights are loaded."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        fits = self.position_init != "sincos" or self.dim % 4 == 0
        require_field(self, "dim", fits, "a multiple of 4 for position_init 'sincos'")

    def init_positions(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, " dim"], Float[Array, "grid grid dim"]]:
        """Draw the positions of patches, or compute sine-cosine codes; the class token gets 0."""
        side = self.position_grid
        if self.position_init == "sincos":
            positions = jax.device_put(_sincos_positions(side, self.dim).astype(np.float32))
        else:
            positions = random_init.normal(key, (side, side, self.dim), scale=0.02)
        return random_init.zeros(self.dim), positions

    def add_positions(
        self, params: ViT, patches: Patches, grid: Grid
    ) -> tuple[Float[Array, " dim"], Patches]:
        """Add its position to the class token, and the resized grid of positions to the patches."""
        assert params.pos_embed_cls is not None
        assert params.pos_embed is not None
        positions = interpolate_positions(params.pos_embed, grid, self)
        class_token = params.cls_token + params.pos_embed_cls
        return class_token, at_least_float32(patches) + positions.reshape(patches.shape[-2:])


def _one_stack(params: ViT) -> Block:
    assert isinstance(params.blocks, Block)  # only training cuts the stack
    return params.blocks


def _sincos_positions(side: int, dim: int) -> np.ndarray:
    """Make fixed 2-D sine-cosine codes (MoCo v3): half the width for rows, half for columns."""
    frequencies = 1e4 ** -(np.arange(dim // 4) / (dim // 4))
    angles = np.arange(side)[:, None] * frequencies
    code = np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)
    rows = np.broadcast_to(code[:, None], (side, side, dim // 2))
    columns = np.broadcast_to(code[None], (side, side, dim // 2))
    return np.concatenate([rows, columns], axis=-1)


def _statistics(params: ViT, measured: Sequence[Block]) -> ViT:
    """Return the running statistics of blocks, in stacks like those of `params`."""
    blocks: Any = _joined(measured)
    if isinstance(params.blocks, tuple):
        # Only adapters have statistics.
        rows = (len(stack.ls1) - _unadapted(stack) for stack in params.blocks)
        cuts = 0, *itertools.accumulate(rows)
        blocks = tuple(_rows(blocks, *pair) for pair in itertools.pairwise(cuts))
    return split_statistics(dataclasses.replace(params, blocks=blocks))[0]


def _checked_levels(request: FeatureSpec, config: VisionTransformer) -> tuple[int, ...]:
    """Return the numbers of blocks after which features are taken."""
    levels = request.levels_of(config.depth)
    special = {
        "levels or a facet": levels != (config.depth,) or request.facet != "token",
        "inserted tokens": request.inserted is not None,
        "the class token's attention": request.class_attention,
        "adapters on a side path": config.adapter.has("side_path"),
    }
    if request.class_attention:
        special["adapters with prompts"] = config.adapter.has("prompts")
    found = [name for name, is_asked in special.items() if is_asked]
    require(len(found) < 2, f"features: found {' and '.join(found)}, expected only one of these")
    return levels


def _rows(tree: Any, begin: int, end: int) -> Any:
    return jax.tree.map(operator.itemgetter(slice(begin, end)), tree)


def _cut(stack: Block, begin: int, end: int) -> Block:
    """Return the blocks with numbers from `begin` to `end` - 1, with their adapters."""
    first = _unadapted(stack)
    if first == 0:
        return _rows(stack, begin, end)
    adapter = _rows(stack.adapter, max(begin - first, 0), max(end - first, 0))
    blocks = _rows(dataclasses.replace(stack, adapter=None), begin, end)
    return dataclasses.replace(blocks, adapter=adapter)


def _unadapted(stack: Block) -> int:
    """Return how many leading blocks of a stack lack the adapter that later ones have."""
    leaves = jax.tree.leaves(stack.adapter)
    return len(stack.ls1) - len(leaves[0]) if leaves else 0


def _adapter_of(layer: Block, config: VisionTransformer) -> Adapter:
    """Return a block's adapter, which is `NoAdapter` if only later blocks have one."""
    has = layer.adapter is not None or config.adapter.last is None
    return config.adapter if has else NoAdapter()


def _joined(stacks: Sequence[Block]) -> Block:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *stacks)


def _between(stacks: Sequence[Block], begin: int, end: int) -> Sequence[Block]:
    """Return the blocks with numbers from `begin` to `end` - 1, counted from 0."""
    parts = []
    for stack in stacks:
        size = len(stack.ls1)
        if begin < size and end > 0:
            parts.append(_cut(stack, max(begin, 0), min(end, size)))
        begin, end = begin - size, end - size
    return parts


def _block_at(stacks: Sequence[Block], number: int) -> Block:
    (one,) = _between(stacks, number, number + 1)
    one = dataclasses.replace(one, adapter=None) if _unadapted(one) else one
    return jax.tree.map(operator.itemgetter(0), one)


def _facet(layer: Block, tokens: TokenBatch, config: VisionTransformer, name: str) -> TokenBatch:
    """Compute queries, keys or values of a block's attention (AnyLoc: Keetha et al. 2023).

    Heads are concatenated, and not rotated.
    """
    number = ("query", "key", "value").index(name)
    normed = layer_norm(layer.norm1, tokens, epsilon=config.norm_epsilon)
    return part_of_qkv(config.attention_of(layer), number, normed, _update_of(layer, config))


def embed(
    params: ViT, images: Float[Array, "*batch height width 3"], config: VisionTransformer
) -> Float[Array, "*batch token dim"]:
    """Embed images as tokens: class token, registers and patches, with any positions added."""
    *batch, height, width, _ = images.shape
    grid, size = config.grid((height, width)), config.patch_size
    pixels = images.reshape(*batch, grid[0], size, grid[1], size, 3).swapaxes(-4, -3)
    patches = linear(params.patch_embed, pixels.reshape(*batch, math.prod(grid), 3 * size**2))
    class_token, placed = config.add_positions(params, patches, grid)
    first = class_token[None]
    if params.register_tokens is not None:
        first = jnp.concatenate([first, params.register_tokens])
    first = jnp.broadcast_to(first, (*batch, *first.shape))
    return jnp.concatenate([first, placed], axis=-2).astype(images.dtype)


def run_blocks(
    stacks: Sequence[Block],
    tokens: TokenBatch,
    grid: Grid,
    config: VisionTransformer,
    *,
    remat: str = "dots",
    valid: Valid = None,
    count: int | None = None,
    path: int = 0,
) -> tuple[TokenBatch, list[Block]]:
    """Run stacks of blocks in sequence, each with one compiled body.

    An adapter may have a side path, whose tokens are then returned (`Adapter.side_path`), or
    prepend prompts, which are dropped at the end. Between the first and the last block the tokens
    are padded as `attention` needs on this platform.

    Args:
        stacks: blocks whose leaves have a leading depth axis.
        tokens: tokens of a batch of images, from `embed` or an earlier call.
        grid: rows and columns of patches.
        config: configuration of the backbone.
        remat: see `ModelConfig.remat`.
        valid: see `VisionTransformer.apply`.
        count: number of leading blocks of a single stack to run; None runs all. They are indexed,
            because a slice of the stack would copy its weights.
        path: index of the adapters' side path to run.

    Returns:
        (tokens, statistics): `statistics` has a stack of running statistics for each of `stacks`.
    """
    front = 0
    if config.adapter.has("prompts"):
        prompts: Any = jax.eval_shape(lambda: config.adapter.prompts(_block_at(stacks, 0).adapter))
        wanted = jax.ShapeDtypeStruct((prompts.shape[0], config.dim), jnp.float32)
        expect_like(f"adapter {config.adapter.part_name}", prompts, wanted)
        front = prompts.shape[0]
    tokens = jnp.pad(tokens, ((0, 0), (front, 0), (0, 0))) if front else tokens
    real = tokens.shape[1]
    padding = padded_length(real, tokens.dtype, config.dim, config.heads) - real
    info = TokenInfo(grid, real if padding else None, valid)
    tokens = jnp.pad(tokens, ((0, 0), (0, padding), (0, 0))) if padding else tokens

    def body(carry: tuple[Array, Array | None], layer: Block) -> tuple[Any, Block]:
        tokens, side = carry
        if front:
            tokens = _with_prompts(tokens, layer, config)
        tokens, statistics = block(layer, tokens, info, config)
        if side is not None:
            layer = merge_statistics(statistics, layer)
            own = layer.adapter if config.adapter.paths == 1 else layer.adapter[path]
            with jax.named_scope("adapter"):
                after, updated = config.adapter.side_path(own, side, tokens, info)
            expect_like(f"adapter {config.adapter.part_name}", after, side)
            if config.adapter.paths > 1:
                updated = (*layer.adapter[:path], updated, *layer.adapter[path + 1 :])
            side, (statistics, _) = (
                after,
                split_statistics(dataclasses.replace(layer, adapter=updated)),
            )
        return (tokens, side), statistics

    # prevent_cse=False: inside a scan, CSE cannot undo the remat.
    body = jax.checkpoint(body, prevent_cse=False, policy=_POLICIES[remat])
    side, statistics = None, []
    with jax.named_scope("blocks"):
        for stack in stacks:
            size, first = len(stack.ls1), _unadapted(stack)
            end = size if count is None else count
            is_whole = count is None and first in (0, size)
            for start, stop in ((0, min(first, end)), (first, end)):
                if start >= stop:
                    continue
                part = dataclasses.replace(stack, adapter=None) if start < first else stack
                if start == first and config.adapter.has("side_path") and side is None:
                    side = tokens
                if is_whole:
                    (tokens, side), measured = jax.lax.scan(body, (tokens, side), part)
                else:
                    # Slices of a stack would copy its weights.
                    (tokens, side), measured = jax.lax.scan(
                        lambda carry, at, part=part: body(carry, _layer_at(part, at)),
                        (tokens, side),
                        jnp.arange(start, stop),
                    )
                if start == first:
                    statistics.append(measured)
    return (tokens if side is None else side)[:, front : info.length], statistics


def _with_prompts(tokens: TokenBatch, layer: Block, config: VisionTransformer) -> TokenBatch:
    """Replace the first tokens with a block's prompts."""
    prompts = config.adapter.prompts(layer.adapter)
    assert prompts is not None
    first = jnp.broadcast_to(prompts.astype(tokens.dtype), (tokens.shape[0], *prompts.shape))
    return jnp.concatenate([first, tokens[:, len(prompts) :]], axis=1)


def _layer_at(stack: Block, number: Int[Array, ""]) -> Block:
    def at(tree: Any, number: Array) -> Any:
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, number, 0, False), tree)

    if first := _unadapted(stack):
        bare = at(dataclasses.replace(stack, adapter=None), number)
        return dataclasses.replace(bare, adapter=at(stack.adapter, number - first))
    return at(stack, number)


def block(
    params: Block, tokens: TokenBatch, info: TokenInfo, config: VisionTransformer
) -> tuple[TokenBatch, Block]:
    """Run one block (paper Eq. 2), with LayerScale on the sum of MLP and adapter, as in CricaVPR.

    Args:
        params: parameters of one block, without a depth axis.
        tokens: tokens of a batch of images.
        info: grid, padding and valid images of these tokens.
        config: configuration of the backbone.

    Returns:
        (tokens, statistics): `statistics` is a block of running statistics, with None elsewhere.
    """
    adapter = _adapter_of(params, config)
    normed = layer_norm(params.norm1, tokens, epsilon=config.norm_epsilon)
    attn, rotation = config.attention_of(params), config.rotation(info.grid)
    linear_update = _update_of(params, config)
    attended = attention(
        attn, normed, config.heads, length=info.length, rotation=rotation, update=linear_update
    )
    with jax.named_scope("adapter"):
        extra = adapter.attention_update(params.adapter, attended, info)
        attended = _added(attended, extra, config)
    tokens = keep(_residual(tokens, params.ls1, attended), "attended")
    normed = layer_norm(params.norm2, tokens, epsilon=config.norm_epsilon)
    update = feed_forward(params.mlp, normed, linear_update)
    with jax.named_scope("adapter"):
        extra, updated = adapter.mlp_update(params.adapter, normed, info)
        update = _added(update, extra, config)
    if updated is not params.adapter:
        params = dataclasses.replace(params, adapter=updated)
    tokens = _residual(tokens, params.ls2, update)
    with jax.named_scope("adapter"):
        extra = adapter.output_update(params.adapter, tokens, info)
        tokens = _added(tokens, extra, config)
    return tokens, split_statistics(params)[0]


def _update_of(layer: Block, config: VisionTransformer) -> LinearUpdate:
    """Return the function that computes an adapter's updates of a block's linear layers."""
    sizes, where = config.block_shape.linears, f"adapter {config.adapter.part_name}"

    def update(name: str, x: Array) -> Array | None:
        with jax.named_scope("adapter"):
            extra = _adapter_of(layer, config).linear_update(layer.adapter, name, x)
        if extra is not None:
            wanted = jax.ShapeDtypeStruct((*x.shape[:-1], sizes[name][1]), x.dtype)
            expect_like(where, extra, wanted)
        return extra

    return update


def _check_merged(layer: Block, merged: Block, config: VisionTransformer) -> None:
    """Check that a block's merged linear layers match the original ones with their updates."""
    update = _update_of(layer, config)
    for name, (width, _) in config.block_shape.linears.items():
        part = "attn" if hasattr(layer.attn, name) else "mlp"
        before, after = (getattr(getattr(each, part), name) for each in (layer, merged))
        x = jnp.linspace(-1.0, 1.0, width)[None]
        expected, found = adapted_linear(name, before, x, update), linear(after, x)
        require(
            bool(jnp.allclose(found, expected, rtol=1e-3, atol=1e-3 * jnp.abs(expected).max())),
            f"adapter {config.adapter.part_name}: found `merge` and `linear_update` to disagree "
            f"in layer {name}, expected the same layer",
        )


def _added(x: TokenBatch, update: TokenBatch | None, config: VisionTransformer) -> TokenBatch:
    """Add the update that an adapter's hook returned, if any."""
    if update is None:
        return x
    expect_like(f"adapter {config.adapter.part_name}", update, x)
    return x + update


def _residual(tokens: TokenBatch, gain: float | Array, update: TokenBatch) -> TokenBatch:
    total = at_least_float32(tokens) + gain * at_least_float32(update)
    return total.astype(tokens.dtype)


def feed_forward(
    params: Mlp | SwiGlu, x: Float[Array, "*batch dim"], update: LinearUpdate = no_update
) -> Float[Array, "*batch dim"]:
    """Apply the feed-forward network: GELU for `Mlp`, SwiGLU (Shazeer 2020) for `SwiGlu`.

    All tokens are rows of one matrix, so that XLA can compute GELU in place.
    """
    rows = x.reshape(-1, x.shape[-1])
    if isinstance(params, Mlp):
        hidden = keep(adapted_linear("fc1", params.fc1, rows, update), "hidden")
        y = adapted_linear("fc2", params.fc2, gelu(hidden), update)
    else:
        hidden = keep(adapted_linear("w12", params.w12, rows, update), "hidden")
        gate, value = jnp.split(hidden, 2, axis=-1)
        y = adapted_linear("w3", params.w3, jax.nn.silu(gate) * value, update)
    return y.reshape(x.shape)


def interpolate_positions(
    positions: Float[Array, "grid grid dim"], grid: Grid, config: ViTConfig
) -> Float[Array, "rows columns dim"]:
    """Resize the stored grid of position embeddings as the public models do.

    Bicubic interpolation is linear and separable: two small matrix products, whose constants are
    computed during tracing. One stored grid therefore serves every image size. Models without
    registers use torch's bicubic (a = -0.75) with the scale (size + 0.1) / grid. Models with
    registers use the antialiased bicubic (a = -0.5) at the exact scale; see `position_resize`.
    """
    antialias = config.registers and config.position_resize == "dinov2"
    return resize_grid(positions, grid, _antialias_weights if antialias else bicubic_weights)


def resize_grid(
    positions: Float[Array, "grid grid dim"],
    grid: Grid,
    weights: Callable[[int, int], Float[np.ndarray, "target source"]],
) -> Float[Array, "rows columns dim"]:
    """Resize a square grid by two products with the matrices `weights(side, new_side)`."""
    side = positions.shape[0]
    if grid == (side, side):
        return positions
    rows, columns = (jnp.asarray(weights(side, size), positions.dtype) for size in grid)
    return jnp.einsum("ri,cj,ijd->rcd", rows, columns, positions, precision="highest")


def _cubic(x: np.ndarray, a: float) -> np.ndarray:
    """Evaluate Keys' cubic convolution kernel."""
    x = np.abs(x)
    near = (a + 2) * x**3 - (a + 3) * x**2 + 1
    far = a * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


@functools.cache
def bicubic_weights(source: int, target: int, more: float = 0.1) -> np.ndarray:
    """Compute the (target, source) matrix of torch's bicubic upsampling, with replicated borders.

    The scale is that of a target longer by `more` pixels, as in DINOv2.
    """
    scale = source / (target + more)
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
