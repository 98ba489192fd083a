"""What a model costs: parameters and multiply-accumulates by part, from its configuration alone."""

import math
from typing import NamedTuple

from crisalad_jax.config import PATCH_SIZE, ModelConfig
from crisalad_jax.model import parameter_shapes
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
    counts = dict.fromkeys(macs, 0)
    for name, leaf in named_leaves(parameter_shapes(config)).items():
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
    patches = config.patches
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
        "aggregator": aggregator_macs(config),
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


def aggregator_macs(config: ModelConfig) -> int:
    """Multiply-accumulates an image of the aggregator; pooling and sums of classes have none.

    What BoQ's queries say to each other is the same for all images, computed once, and left out.
    """
    counts = {
        "salad": _salad_macs,
        "conv-ap": _conv_ap_macs,
        "cosplace": lambda config: config.backbone.dim * config.cosplace.dim,
        "mixvpr": _mixvpr_macs,
        "boq": _boq_macs,
        "netvlad": _vlad_macs,
        "anyloc": _vlad_macs,
        "transvpr": _transvpr_macs,
    }
    return counts[config.aggregator](config) if config.aggregator in counts else 0


def _vlad_macs(config: ModelConfig) -> int:
    """A product to share patches out, and one to sum them up."""
    return 2 * config.patches * config.shape.tokens * config.backbone.dim


def _conv_ap_macs(config: ModelConfig) -> int:
    """As we compute it: the regions' means first, then the convolution."""
    return config.conv_ap.side**2 * config.backbone.dim * config.conv_ap.channels


def _mixvpr_macs(config: ModelConfig) -> int:
    dim, patches, mixvpr = config.backbone.dim, config.patches, config.mixvpr
    mixers = mixvpr.depth * dim * 2 * patches**2
    return mixers + patches * mixvpr.channels * (dim + mixvpr.rows)


def _boq_macs(config: ModelConfig) -> int:
    patches, boq = config.patches, config.boq
    width, queries = boq.channels, boq.queries
    layer = patches * 12 * width**2 + 2 * patches**2 * width
    asking = patches * 2 * width**2 + 2 * queries * patches * width + queries * width**2
    convolution = patches * 9 * config.backbone.dim * width
    return convolution + boq.layers * (layer + asking + queries * boq.rows * width)


def _salad_macs(config: ModelConfig) -> int:
    dim, salad, patches = config.backbone.dim, config.salad, config.patches
    networks = salad.hidden * (2 * dim + salad.cluster_dim + salad.scores)
    sums = salad.clusters * salad.cluster_dim
    return salad.hidden * (dim + salad.token_dim) + patches * (networks + sums)


def _transvpr_macs(config: ModelConfig) -> int:
    transvpr, patches = config.transvpr, config.patches
    wide = transvpr.levels * config.backbone.dim
    return patches * wide * (transvpr.levels + 1) + wide * transvpr.dim


def adapter_macs(config: ModelConfig) -> int:
    """True multiply-accumulates of one adapter and one image: linears at every token."""
    backbone = config.backbone
    patches = config.patches
    tokens = 1 + backbone.registers + patches
    width = backbone.adapter_dim
    return 2 * tokens * backbone.dim * width + patches * _convolution_macs(config)


def paper_adapter_macs(config: ModelConfig) -> int:
    """The paper's count (Table 3: 39.223 M): convolutions at every patch, each linear only once."""
    backbone = config.backbone
    patches = config.patches
    return 2 * backbone.dim * backbone.adapter_dim + patches * _convolution_macs(config)


def _convolution_macs(config: ModelConfig) -> int:
    width = config.backbone.adapter_dim
    if config.backbone.adapter.kind == "mlp":
        return 0
    if config.backbone.adapter.kind == "multi-resolution":
        half, quarter, narrow = width // 2, width // 4, width // 16
        return width * (half + 2 * narrow) + (3**2 + 5**2) * narrow * quarter
    return config.backbone.adapter.kernel_size**2 * width + width**2
