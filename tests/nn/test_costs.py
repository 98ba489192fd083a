"""Costs against the paper's Table 3, and counts by hand.

`part_costs` counts in the program itself; here are the formulas.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig, ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig, GemConfig, GemPyramidConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.pair_vpr import PairVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig, EdtFormerConfig
from crisalad_jax.nn.aggregators.salad import FolConfig
from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.aggregators.vlad import (
    AnyLocConfig,
    NetVladConfig,
    SuperVladConfig,
    VladBuffConfig,
)
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.costs import adapter_macs, count_macs, paper_adapter_macs, part_costs
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.sinkhorn import SinkhornConfig

LINEARS = 257 * 768 * 384 * 2
"""An adapter's projections down and up, of 257 tokens."""


def macs_of(config: ModelConfig, images: int = 1) -> dict[str, int]:
    return {cost.part: cost.macs for cost in part_costs(config, images=images)}


@pytest.mark.parametrize(
    ("kind", "macs", "paper"),
    [
        # 256 patches through 9 taps and a 384 x 384 product; the paper's Table 3.
        ("depthwise", LINEARS + 256 * (9 * 384 + 384 * 384), 39_223_296),
        # CricaVPR's branches: 384 -> 192, and twice 384 -> 24 and then 3 x 3 or 5 x 5 to 96.
        (
            "multi-resolution",
            LINEARS + 256 * (384 * 192 + 2 * 384 * 24 + (9 + 25) * 24 * 96),
            44_236_800,
        ),
        ("mlp", LINEARS, 2 * 768 * 384),
        # Slow: the whole backbone is compiled, for a path that costs as much as "mlp".
        pytest.param("side", LINEARS, 2 * 768 * 384, marks=pytest.mark.slow),
        ("serial-parallel", 2 * LINEARS, 4 * 768 * 384),
    ],
)
def test_one_blocks_adapters_by_hand(kind: Any, macs: int, paper: int) -> None:
    backbone = dataclasses.replace(PRESETS["b14"].backbone, adapter=kind)
    config = dataclasses.replace(PRESETS["b14"], backbone=backbone)
    assert adapter_macs(config) == macs
    assert paper_adapter_macs(config, macs) == paper


def test_loras_and_prompts_cost_by_hand() -> None:
    """LoRA of rank 8 at 257 tokens; ten prompts through the block's linears and its attention."""

    def macs(name: str) -> int:
        backbone = dataclasses.replace(PRESETS["b14"].backbone, adapter=name)
        return adapter_macs(dataclasses.replace(PRESETS["b14"], backbone=backbone))

    assert macs("lora") == 257 * 8 * (768 + 3 * 768 + 768 + 768)
    assert macs("prompts") == 10 * 12 * 768**2 + 2 * 768 * (267**2 - 257**2)


def test_parameters_of_the_public_backbone() -> None:
    """dinov2_vitb14's checkpoint holds 86,580,480 numbers, of them 768 of a mask token."""
    costs = {cost.part: cost.parameters for cost in part_costs(PRESETS["b14"])}
    assert costs["backbone blocks"] + costs["backbone embedding, norm"] == 86_580_480 - 768


ROWS, COLUMNS, DIM = 6, 9, 32
PATCHES = ROWS * COLUMNS
SMALL = ModelConfig(
    image_size=(14 * ROWS, 14 * COLUMNS),
    backbone=ViTConfig(dim=DIM, depth=3, heads=2, position_grid=4),
    aggregator=dataclasses.replace(PRESETS["tiny"].aggregator, clusters=8),
    cross_image=CrossImageConfig(heads=2, feedforward=24),
)
PLAIN = dataclasses.replace(
    SMALL,
    backbone=dataclasses.replace(SMALL.backbone, adapter="none"),
    cross_image="none",
)


def salad_by_hand(transport: int = 3 * 2 * PATCHES * 8) -> int:
    """Its three networks, the sums of patches, and two products an iteration of the transport.

    The dustbin's column is summed by itself: no product.
    """
    hidden = 128
    networks = DIM * hidden + hidden * 64 + PATCHES * (2 * DIM * hidden + hidden * (32 + 8))
    return networks + PATCHES * 8 * 32 + transport


def boq_by_hand() -> int:
    """Of channels 128, 7 queries, 5 rows and 2 blocks; the queries' own look is made once."""
    width, queries = 128, 7
    layer = PATCHES * 4 * width**2 + 2 * PATCHES**2 * width + PATCHES * 2 * width * 4 * width
    asking = PATCHES * 2 * width**2 + 2 * queries * PATCHES * width + queries * width**2
    return PATCHES * 9 * DIM * width + 2 * (layer + asking) + 5 * 2 * queries * width


def mixvpr_by_hand() -> int:
    """Of channels 20, 3 rows and 3 mixers."""
    return 3 * 2 * DIM * PATCHES**2 + PATCHES * DIM * 20 + 20 * PATCHES * 3


def edtformer_by_hand() -> int:
    """Of width 24, 7 queries, 20 channels, 3 rows and 2 layers, over the class token as well.

    What the queries say to each other, and ask, does not depend on the image in the first layer.
    """
    width, queries, tokens = 24, 7, PATCHES + 1
    asking = tokens * 2 * width**2 + 2 * queries * tokens * width + queries * width**2
    among = queries * 4 * width**2 + 2 * queries**2 * width
    layers = 2 * asking + among + queries * width**2
    return tokens * DIM * width + layers + queries * width * 20 + 20 * queries * 3


AGGREGATORS: dict[str, tuple[Any, int]] = {
    "salad": (SMALL.aggregator, salad_by_hand()),
    # Sums of exponentials are no products.
    "salad, log": (
        dataclasses.replace(SMALL.aggregator, sinkhorn=SinkhornConfig(domain="log")),
        salad_by_hand(0),
    ),
    # A score more of each patch.
    "salad, token": (
        dataclasses.replace(SMALL.aggregator, dustbin="token"),
        salad_by_hand() + PATCHES * 128,
    ),
    # A row more of the transport.
    "salad, row and column": (
        dataclasses.replace(SMALL.aggregator, dustbin="row and column"),
        salad_by_hand(3 * 2 * (PATCHES + 1) * 8),
    ),
    "gem": (GemConfig(), 0),
    "gem-pyramid": (GemPyramidConfig(), 0),
    "class-token": (ClassTokenConfig(), 0),
    "conv-ap": (ConvApConfig(channels=20, side=3), 9 * DIM * 20),
    "cosplace": (CosPlaceConfig(dim=20), DIM * 20),
    "mixvpr": (MixVprConfig(channels=20, rows=3, depth=3), mixvpr_by_hand()),
    "boq": (BoqConfig(channels=128, queries=7, rows=5), boq_by_hand()),
    # Scores, and sums by them.
    "netvlad": (NetVladConfig(clusters=5), 2 * PATCHES * DIM * 5),
    "anyloc": (AnyLocConfig(clusters=7, layer=-1), 2 * PATCHES * DIM * 7),
    # Six score, four are summed.
    "supervlad": (SuperVladConfig(clusters=4, ghosts=2), PATCHES * DIM * (6 + 4)),
    # Three levels score each patch three times, and are summed up once; then a linear layer.
    "transvpr": (
        TransVprConfig(levels=3, dim=24),
        PATCHES * 3 * DIM * 3 + PATCHES * 3 * DIM + 3 * DIM * 24,
    ),
    "edtformer": (
        EdtFormerConfig(width=24, heads=2, queries=7, channels=20, rows=3),
        edtformer_by_hand(),
    ),
    # The blocks do all the work.
    "aggregation-tokens": (AggregationTokensConfig(tokens=3, insertion=1), 0),
    # The reduction; then scores, sums by them, and each patch beside all others.
    "vlad-buff": (
        VladBuffConfig(clusters=5, reduced=12),
        PATCHES * DIM * 12 + 2 * PATCHES * 12 * 5 + PATCHES**2 * 12,
    ),
    # A descriptor needs no local features.
    "selavpr": (SelaVprConfig(hidden=8, local=4), 0),
    # Nor the decoder: one linear layer.
    "pair-vpr": (PairVprConfig(dim=24, width=16, layers=2), DIM * 24),
    # SALAD's; the dustbin comes from the backbone.
    "fol": (
        FolConfig(clusters=8, cluster_dim=32, token_dim=64, hidden=128),
        salad_by_hand(),
    ),
}


@pytest.mark.parametrize("name", AGGREGATORS)
def test_an_aggregator_by_hand(name: str) -> None:
    part, by_hand = AGGREGATORS[name]
    config = dataclasses.replace(PLAIN, aggregator=part)
    assert macs_of(config)["aggregator"] == by_hand


@pytest.mark.parametrize(("ffn", "registers"), [("mlp", 4), ("swiglu", 0)])
def test_the_backbone_by_hand(ffn: Any, registers: int) -> None:
    """Three blocks of attention and network over all tokens; the embedding over the patches."""
    backbone = dataclasses.replace(SMALL.backbone, ffn=ffn, registers=registers)
    costs = macs_of(dataclasses.replace(SMALL, backbone=backbone))
    tokens = 1 + registers + PATCHES
    # Two thirds of 128, up to a multiple of 8, are 88: gates and values, and one product back.
    network = {"mlp": 2 * 128, "swiglu": 3 * 88}[ffn]
    attention = tokens * 4 * DIM**2 + 2 * tokens**2 * DIM
    assert costs["backbone blocks"] == 3 * (attention + tokens * DIM * network)
    assert costs["backbone embedding, norm"] == PATCHES * 3 * 14**2 * DIM
    narrow = DIM // 2
    adapter = tokens * 2 * DIM * narrow + PATCHES * (9 * narrow + narrow**2)
    assert costs["adapters"] == 3 * adapter


@pytest.mark.parametrize(("images", "global_token"), [(1, True), (5, False)])
def test_the_encoder_by_hand(images: int, global_token: bool) -> None:
    """Each of an image's 8 tokens of 32 numbers, and 2 of the global one's 64, sees `images`."""
    across = dataclasses.replace(SMALL.cross_image, global_token=global_token)
    config = dataclasses.replace(SMALL, cross_image=across)
    tokens = 8 + 2 * global_token
    by_hand = 2 * tokens * (4 * 32**2 + 2 * images * 32 + 2 * 32 * 24)
    assert macs_of(config, images)["cross-image encoder"] == by_hand


def test_b14_by_hand() -> None:
    """The paper's model: 256 patches, 64 clusters, and their 66 tokens in the encoder."""
    costs = macs_of(PRESETS["b14"])
    attention = 257 * 4 * 768**2 + 2 * 257**2 * 768
    assert costs["backbone blocks"] == 12 * (attention + 257 * 2 * 768 * 3072)
    assert costs["adapters"] == 12 * 190_218_240
    assert costs["backbone embedding, norm"] == 256 * 588 * 768
    networks = 768 * 512 + 512 * 256 + 256 * (2 * 768 * 512 + 512 * (128 + 64))
    assert costs["aggregator"] == networks + 256 * 64 * 128 + 3 * 2 * 256 * 64
    assert costs["cross-image encoder"] == 2 * 66 * (4 * 128**2 + 2 * 128 + 2 * 128 * 2048)


def test_a_model_of_float64_costs_the_same() -> None:
    tiny = PRESETS["tiny"]
    assert part_costs(dataclasses.replace(tiny, compute_dtype="float64")) == part_costs(tiny)


def test_parameters_are_counted_by_part() -> None:
    shapes = parameter_shapes(SMALL)
    total = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    counts = {cost.part: cost.parameters for cost in part_costs(SMALL)}
    assert sum(counts.values()) == total
    # Without a bias, but the two convolutions'.
    assert counts["adapters"] == 3 * (2 * 32 * 16 + 9 * 16 + 16 + 16 * 16 + 16)
    assert counts["aggregator"] == sum(x.size for x in jax.tree.leaves(shapes.aggregator))


def test_what_a_program_counts() -> None:
    """Products, convolutions, so many times a scan; of a choice the cheaper way; no sums."""
    x, y = jnp.zeros((2, 3)), jnp.zeros((3, 4))
    assert count_macs(jnp.matmul, x, y).total() == 24
    assert count_macs(lambda x, y: (x @ y).sum() + x.sum(), x, y).total() == 24

    def scanned(x: Any, y: Any) -> Any:
        return jax.lax.scan(lambda carry, _: (carry, carry @ y), x, length=5)[1]

    assert count_macs(scanned, x, y).total() == 5 * 24
    assert count_macs(jax.checkpoint(scanned), x, y).total() == 5 * 24

    def twice(x: Any, y: Any) -> Any:
        return x @ y + (2 * x) @ y

    def chosen(way: Any, x: Any, y: Any) -> Any:
        return jax.lax.cond(way, jnp.matmul, twice, x, y)

    assert count_macs(twice, x, y).total() == 48
    assert count_macs(chosen, True, x, y).total() == 24
    image, kernel = jnp.zeros((1, 5, 6, 3)), jnp.zeros((3, 3, 3, 7))

    def convolved(image: Any, kernel: Any) -> Any:
        names = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(image, kernel, (1, 1), "SAME", dimension_numbers=names)

    assert count_macs(convolved, image, kernel).total() == 5 * 6 * 9 * 3 * 7
