"""Programs for accelerators that are not here: every model traces, and what they compute with.

Nothing is compiled. A GPU's attention refuses some shapes while it is traced, a kernel too.
"""

import dataclasses
import functools
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from crisalad_jax.nn.backbones.vit import VisionTransformer
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import describe, parameter_shapes
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.training.recipes import RECIPES, recipe
from crisalad_jax.utils import compiler
from crisalad_jax.utils.target import CPU, GPU, PORTABLE, TPU, Target, lowering_for

ACCELERATORS = pytest.mark.parametrize("chosen", [GPU, TPU], ids=lambda each: each.platform)
FUSED = {"gpu": "dot_product_attention_bwd", "tpu": "pallas_call"}


def with_registers(model: ModelConfig, count: int = 4) -> ModelConfig:
    return dataclasses.replace(model, backbone=dataclasses.replace(model.backbone, registers=count))


def models() -> dict[str, ModelConfig]:
    """Every preset, with registers too, and every recipe, by name; equal ones count once."""
    found = dict(PRESETS)
    found |= {f"{name}, registers": with_registers(PRESETS[name]) for name in ("s14", "b14")}
    found["DINOv3"] = dataclasses.replace(PRESETS["b14"], image_size=(256, 256), backbone="dinov3")
    found |= {name: recipe("b14", name).model for name in RECIPES}
    # All in bfloat16, for which attention is fused on both; the presets' own type is below.
    half = {name: dataclasses.replace(m, compute_dtype="bfloat16") for name, m in found.items()}
    once = {model: name for name, model in reversed(half.items())}
    return {name: model for model, name in once.items()} | {"b14, float32": PRESETS["b14"]}


MODELS = models()
BACKBONES = {"tiny", "g14", "b14, registers", "DINOv3", "b14, float32"}
"""What differs before the head; other sizes and the recipes' heads are among the slow tests."""


def sizes(model: ModelConfig) -> list[tuple[int, int]]:
    """A size with an odd number of tokens and one with an even number, where there is a choice."""
    side = model.backbone.patch_size
    if not isinstance(model.backbone, VisionTransformer) or model.aggregator.fixed_grid:
        return [model.input_size]
    smaller = (model.input_size[0] - side, model.input_size[1] - side)
    found = [model.input_size, smaller]
    counts = {1 + model.backbone.registers + math.prod(model.backbone.grid(x)) for x in found}
    assert {count % 2 for count in counts} == {0, 1}
    return found


@ACCELERATORS
@pytest.mark.parametrize(
    "name",
    [name if name in BACKBONES else pytest.param(name, marks=pytest.mark.slow) for name in MODELS],
)
def test_every_model_traces_for_accelerators(name: str, chosen: Target) -> None:
    """Its description and the gradient of it, which a GPU's attention restricts more."""
    model = MODELS[name]
    params = parameter_shapes(model)

    def total(params: Any, images: jax.Array) -> jax.Array:
        return describe(params, images, model).sum()

    for size in sizes(model):
        images = jax.ShapeDtypeStruct((2, *size, 3), jnp.uint8)
        with lowering_for(chosen):
            described = jax.eval_shape(functools.partial(describe, config=model), params, images)
            program, slopes = jax.make_jaxpr(jax.grad(total), return_shape=True)(params, images)
        assert described.shape == (2, model.descriptor_dim)
        assert jax.tree.structure(slopes) == jax.tree.structure(params)
        if isinstance(model.backbone, VisionTransformer):
            fuses = chosen == TPU or model.compute_dtype == "bfloat16"
            assert (FUSED[chosen.platform] in str(program)) == fuses


SMALL = dataclasses.replace(
    PRESETS["tiny"],
    projection=ProjectionConfig(dim=16),
    backbone=dataclasses.replace(PRESETS["tiny"].backbone, adapter="multi-resolution"),
)
"""With convolutions, SALAD's plan, an encoder and a projection."""
PRODUCT = re.compile(r"stablehlo\.(?:dot_general|convolution).*")


def products(chosen: Target, model: ModelConfig, *, gradient: bool) -> list[tuple[str, str]]:
    """The type of the operands of each product of a program, and its precision."""
    params = parameter_shapes(model)
    images = jax.ShapeDtypeStruct((2, *model.input_size, 3), jnp.uint8)

    @functools.partial(compiler.jit, static_argnames="config")
    def program(params: Any, images: jax.Array, config: ModelConfig) -> Any:
        def total(params: Any) -> jax.Array:
            return describe(params, images, config).sum()

        return jax.grad(total)(params) if gradient else describe(params, images, config)

    with lowering_for(chosen):
        text = program.lower(params, images, model).as_text()  # pyright: ignore
    found = []
    for line in PRODUCT.findall(text):
        words = set(re.findall(r"\b(DEFAULT|HIGH|HIGHEST)\b", line))
        operands = line.rsplit(" : (", 1)[1].split(") ->")[0]
        kinds = set(re.findall(r"tensor<(?:\d+x)*(\w+)>", operands))
        assert len(words) == len(kinds) == 1
        found.append((kinds.pop(), words.pop()))
    assert len(found) > 20
    return found


@pytest.mark.parametrize("chosen", [GPU, TPU, PORTABLE], ids=lambda each: each.platform)
@pytest.mark.parametrize("gradient", [False, True], ids=["describe", "gradient"])
def test_float32_is_float32_on_every_platform(chosen: Target, gradient: bool) -> None:
    """The plan's product, the projection and the convolutions too."""
    assert set(products(chosen, SMALL, gradient=gradient)) == {("f32", "HIGHEST")}


@ACCELERATORS
@pytest.mark.parametrize("gradient", [False, True], ids=["describe", "gradient"])
def test_bfloat16_is_multiplied_in_one_pass(chosen: Target, gradient: bool) -> None:
    half = dataclasses.replace(SMALL, compute_dtype="bfloat16")
    found = products(chosen, half, gradient=gradient)
    assert set(found) == {("bf16", "DEFAULT"), ("f32", "HIGHEST")}


@pytest.mark.parametrize(("word", "expected"), [("high", "HIGH"), ("default", "DEFAULT")])
def test_a_model_may_take_less(word: Any, expected: str) -> None:
    """What always needs float32, such as resized positions, is not asked."""
    found = products(GPU, dataclasses.replace(SMALL, precision=word), gradient=True)
    assert ("f32", expected) in found
    assert set(found) <= {("f32", expected), ("f32", "HIGHEST")}


def test_a_cpu_has_one_precision() -> None:
    less = dataclasses.replace(SMALL, precision="default")
    assert products(CPU, less, gradient=True) == products(CPU, SMALL, gradient=True)
