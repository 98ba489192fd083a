"""What a model costs: parameters and multiply-accumulates by part, from its configuration alone."""

import functools
import math
from typing import NamedTuple

import jax

from crisalad_jax.config import PATCH_SIZE, ModelConfig
from crisalad_jax.model import init_crisalad
from crisalad_jax.pytree import named_leaves


class PartCost(NamedTuple):
    """One row of the table."""

    part: str
    parameters: int
    macs: int
    """Multiply-accumulates an image in matrix products and convolutions."""


def part_costs(config: ModelConfig, *, images: int = 1) -> list[PartCost]:
    """Parameters and multiply-accumulates of each part, per image at `config.image_size`.

    `images` is how many look at each other in the cross-image encoder, whose attention is the only
    cost that depends on it.
    """
    macs = _macs(config, images)
    template = jax.eval_shape(functools.partial(init_crisalad, config=config), jax.random.key(0))
    counts = dict.fromkeys(macs, 0)
    for name, leaf in named_leaves(template).items():
        counts[_part_of(name)] += math.prod(leaf.shape)
    return [PartCost(part, counts[part], macs[part]) for part in macs]


def _part_of(name: str) -> str:
    if name.startswith("encoder."):
        return "cross-image encoder"
    if name.startswith("aggregator."):
        return "aggregator"
    if ".adapter." in name:
        return "adapters"
    return "backbone blocks" if name.startswith("backbone.blocks.") else "backbone embedding, norm"


def _macs(config: ModelConfig, images: int) -> dict[str, int]:
    backbone, encoder = config.backbone, config.encoder
    patches = math.prod(config.image_size) // PATCH_SIZE**2
    tokens = 1 + backbone.registers + patches
    dim, hidden = backbone.dim, backbone.hidden
    depth, part_block = _blocks_run(config)
    products = 3 if backbone.ffn == "swiglu" else 2
    attention = 4 * tokens * dim**2 + 2 * tokens**2 * dim
    block = attention + products * tokens * dim * hidden
    costs = {
        "backbone embedding, norm": patches * 3 * PATCH_SIZE**2 * dim,
        "backbone blocks": depth * block + part_block * tokens * dim**2,
        "adapters": 0,
        "aggregator": _aggregator_macs(config, patches),
        "cross-image encoder": 0,
    }
    if backbone.adapter.kind != "none":
        costs["adapters"] = depth * adapter_macs(config)
    if encoder.layers:
        shape = config.shape
        width = shape.token_dim
        pieces = shape.tokens + (shape.global_dim // width if encoder.global_token else 0)
        per_token = 4 * width**2 + 2 * width * encoder.feedforward + 2 * images * width
        costs["cross-image encoder"] = encoder.layers * pieces * per_token
    return costs


def _blocks_run(config: ModelConfig) -> tuple[int, int]:
    """How many blocks are run whole, and whether a third of another's first product is.

    All, but for AnyLoc, which looks no further than the block of its facet.
    """
    if config.aggregator != "anyloc":
        return config.backbone.depth, 0
    number = config.anyloc.block(config.backbone.depth)
    return (number + 1, 0) if config.anyloc.facet == "token" else (number, 1)


def _aggregator_macs(config: ModelConfig, patches: int) -> int:
    if config.aggregator == "salad":
        return _salad_macs(config, patches)
    if config.aggregator in ("netvlad", "anyloc"):
        # A product to share patches out, and one to sum them up.
        return 2 * patches * config.shape.tokens * config.backbone.dim
    if config.aggregator == "transvpr":
        return _transvpr_macs(config, patches)
    return 0


def _salad_macs(config: ModelConfig, patches: int) -> int:
    dim, salad = config.backbone.dim, config.salad
    networks = salad.hidden * (2 * dim + salad.cluster_dim + salad.scores)
    sums = salad.clusters * salad.cluster_dim
    return salad.hidden * (dim + salad.token_dim) + patches * (networks + sums)


def _transvpr_macs(config: ModelConfig, patches: int) -> int:
    transvpr = config.transvpr
    wide = transvpr.levels * config.backbone.dim
    return patches * wide * (transvpr.levels + 1) + wide * transvpr.dim


def adapter_macs(config: ModelConfig) -> int:
    """True multiply-accumulates of one adapter and one image: linears at every token."""
    backbone = config.backbone
    patches = math.prod(config.image_size) // PATCH_SIZE**2
    tokens = 1 + backbone.registers + patches
    width = backbone.adapter_dim
    return 2 * tokens * backbone.dim * width + patches * _convolution_macs(config)


def paper_adapter_macs(config: ModelConfig) -> int:
    """The paper's count (Table 3: 39.223 M): convolutions at every patch, each linear only once."""
    backbone = config.backbone
    patches = math.prod(config.image_size) // PATCH_SIZE**2
    return 2 * backbone.dim * backbone.adapter_dim + patches * _convolution_macs(config)


def _convolution_macs(config: ModelConfig) -> int:
    width = config.backbone.adapter_dim
    if config.backbone.adapter.kind == "mlp":
        return 0
    if config.backbone.adapter.kind == "multi-resolution":
        half, quarter, narrow = width // 2, width // 4, width // 16
        return width * (half + 2 * narrow) + (3**2 + 5**2) * narrow * quarter
    return config.backbone.adapter.kernel_size**2 * width + width**2
