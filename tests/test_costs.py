"""Costs against the paper's Table 3, a count by hand, and the compiled program's own products."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from crisalad_jax.config import (
    PRESETS,
    AdapterConfig,
    AnyLocConfig,
    BoqConfig,
    ConvApConfig,
    CosPlaceConfig,
    CrossImageConfig,
    MixVprConfig,
    ModelConfig,
    TransVprConfig,
    ViTConfig,
)
from crisalad_jax.costs import adapter_macs, aggregator_macs, paper_adapter_macs, part_costs
from crisalad_jax.model import alone, describe, init_crisalad
from crisalad_jax.nn.aggregators import aggregate, init_aggregator
from crisalad_jax.nn.vit import Features


def with_adapter(kind: str) -> ModelConfig:
    backbone = dataclasses.replace(PRESETS["b14"].backbone, adapter=AdapterConfig(kind=kind))
    return dataclasses.replace(PRESETS["b14"], backbone=backbone)


def test_table_3() -> None:
    assert paper_adapter_macs(PRESETS["b14"]) == 39_223_296
    costs = {cost.part: cost for cost in part_costs(PRESETS["b14"])}
    assert costs["adapters"].parameters == 12 * 741_504
    assert paper_adapter_macs(with_adapter("multi-resolution")) == 44_236_800


def test_one_adapter_by_hand() -> None:
    """257 tokens down and up, 256 patches through 9 taps and a 384 x 384 product."""
    by_hand = 257 * 768 * 384 * 2 + 256 * (9 * 384 + 384 * 384)
    assert adapter_macs(PRESETS["b14"]) == by_hand == 190_218_240


def test_the_other_adapters_by_hand() -> None:
    """CricaVPR's branches: 384 -> 192, and twice 384 -> 24 and then 3 x 3 or 5 x 5 to 96."""
    linears = 257 * 768 * 384 * 2
    branches = 384 * 192 + 2 * 384 * 24 + (9 + 25) * 24 * 96
    assert adapter_macs(with_adapter("multi-resolution")) == linears + 256 * branches
    assert adapter_macs(with_adapter("mlp")) == linears


def test_parameters_of_the_public_backbone() -> None:
    """dinov2_vitb14's checkpoint holds 86,580,480 numbers, of them 768 of a mask token."""
    costs = {cost.part: cost.parameters for cost in part_costs(PRESETS["b14"])}
    assert costs["backbone blocks"] + costs["backbone embedding, norm"] == 86_580_480 - 768


def _products(jaxpr: Any, times: int = 1) -> int:
    """Multiply-accumulates of every dot_general, scans multiplied out."""
    total = 0
    for equation in jaxpr.eqns:
        inner = (
            times * equation.params.get("length", 1) if equation.primitive.name == "scan" else times
        )
        for value in equation.params.values():
            if hasattr(value, "jaxpr"):
                total += _products(value.jaxpr, inner)
            elif hasattr(value, "eqns"):
                total += _products(value, inner)
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left = equation.invars[0].aval.shape
            out = equation.outvars[0].aval.shape
            total += times * math.prod(out) * math.prod(left[i] for i in contracted)
    return total


SMALL = ModelConfig(
    image_size=(84, 126),
    backbone=ViTConfig(dim=32, depth=3, heads=2, position_grid=4),
    salad=dataclasses.replace(PRESETS["tiny"].salad, clusters=8),
    conv_ap=ConvApConfig(channels=20, side=3),
    cosplace=CosPlaceConfig(dim=20),
    mixvpr=MixVprConfig(channels=20, rows=3, depth=3),
    boq=BoqConfig(channels=128, queries=7, rows=5),
    encoder=CrossImageConfig(heads=2, feedforward=24),
)
PLAIN = dataclasses.replace(
    SMALL,
    backbone=dataclasses.replace(SMALL.backbone, adapter=AdapterConfig(kind="none")),
    encoder=CrossImageConfig(layers=0),
)


@pytest.mark.parametrize(
    ("aggregator", "once"),
    [
        ("salad", 0),
        ("gem", 0),
        ("conv-ap", 0),
        ("cosplace", 0),
        ("mixvpr", 0),
        # Of each block's 7 queries: inputs and outputs, scores and sums, and questions.
        ("boq", 2 * (5 * 7 * 128**2 + 2 * 7**2 * 128)),
    ],
)
def test_an_aggregators_count_is_its_programs(aggregator: Any, once: int) -> None:
    """`once` is what does not depend on the image: not counted."""
    images, (rows, columns) = 3, (6, 9)
    config = dataclasses.replace(SMALL, aggregator=aggregator, encoder=CrossImageConfig(layers=0))
    params = jax.eval_shape(lambda key: init_aggregator(key, config), jax.random.key(0))
    features = Features(
        jax.ShapeDtypeStruct((images, 32), jnp.float32),
        jax.ShapeDtypeStruct((images, rows * columns, 32), jnp.float32),
    )
    program = jax.make_jaxpr(
        lambda params, features: aggregate(params, features, (rows, columns), config, key=None)
    )(params, features)
    # The 3 x 3 convolution is no dot_general.
    convolution = rows * columns * 9 * 32 * 128 if aggregator == "boq" else 0
    counted = _products(program.jaxpr) + images * convolution
    assert counted == images * aggregator_macs(config) + once


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        dataclasses.replace(
            SMALL,
            backbone=dataclasses.replace(
                SMALL.backbone, ffn="swiglu", registers=4, adapter=AdapterConfig(kind="none")
            ),
            encoder=CrossImageConfig(layers=0),
        ),
        dataclasses.replace(
            SMALL,
            aggregator="gem-pyramid",
            backbone=dataclasses.replace(SMALL.backbone, adapter=AdapterConfig(kind="mlp")),
        ),
        dataclasses.replace(PLAIN, aggregator="netvlad"),
        dataclasses.replace(PLAIN, aggregator="anyloc", anyloc=AnyLocConfig(7, -1, "value")),
        dataclasses.replace(PLAIN, aggregator="anyloc", anyloc=AnyLocConfig(7, 1, "token")),
        dataclasses.replace(
            PLAIN, aggregator="transvpr", transvpr=TransVprConfig(levels=3, dim=24)
        ),
    ],
    ids=[
        *("adapters, encoder", "swiglu, registers, neither", "pyramid, mlp"),
        *("netvlad", "anyloc, values", "anyloc, tokens", "transvpr"),
    ],
)
def test_count_equals_the_programs_products(config: ModelConfig) -> None:
    images = 3
    params = jax.eval_shape(lambda key: init_crisalad(key, config), jax.random.key(0))
    pixels = jax.ShapeDtypeStruct((images, *config.image_size, 3), jnp.float32)
    program = jax.make_jaxpr(lambda p, x: describe(p, x, config, mask=alone(images)))(
        params, pixels
    )
    counted = _products(program.jaxpr)
    # Position interpolation is products too, once a batch; depthwise taps are not dot_generals.
    rows, columns = (side // 14 for side in config.image_size)
    grid, dim = config.backbone.position_grid, config.backbone.dim
    orders = {
        columns * grid * grid * dim + rows * grid * columns * dim,
        rows * grid * grid * dim + rows * grid * columns * dim,
    }
    taps = 0
    if config.backbone.adapter.kind == "depthwise":
        taps = config.backbone.depth * rows * columns * 9 * config.backbone.adapter_dim
    ours = images * (sum(cost.macs for cost in part_costs(config, images=images)) - taps)
    assert counted - ours in orders
