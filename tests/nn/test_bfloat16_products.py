"""Products of a bfloat16 model on a CPU: none is widened to float32, which has no fast unit there.

XLA's library refuses some orders of axes, and XLA then widens a bfloat16 product without a word.
"""

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.attention import dot_product_attention
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.layers import Linear, linear
from crisalad_jax.nn.model import cast_params, describe
from crisalad_jax.training.step import init_train_state, step_config, train_step
from tests.conftest import RECIPE, random_params

WIDE_ON_PURPOSE = (
    *("ri,cj,ijk->rck", "ri,cj,ijd->rcd", "...nm,...nd->...md", "(jvp())/", "jvp()/"),
    "jit(_solve)/",
)
"""The resizing of pixels and of positions, SALAD's sum over patches, the loss's similarities, and
Sinkhorn's products with ones, which XLA makes of its sums, by their names; XLA of jax 0.10 leaves
the last without one."""
BATCH = 8
"""Images: attention across two is too small for the library, which XLA then does not ask."""


def wide_products(program: Callable[..., Any], *arguments: Any) -> list[str]:
    """The names of the compiled products with a float32 operand."""
    text = jax.jit(program).lower(*arguments).compile().as_text()
    found = []
    for computation in re.split(r"\n(?=(?:ENTRY )?%?[\w.-]+ \()", text):
        types = dict(re.findall(r"%([\w.-]+) = (\w+)\[", computation))
        for line in computation.splitlines():
            if product := re.search(r" (?:dot|convolution)\((.*?)\)", line):
                operands = [name.strip().lstrip("%") for name in product[1].split(",")]
                assert all(name in types for name in operands), line
                if "f32" in [types[name] for name in operands]:
                    name = re.search(r'op_name="(.*?)"', line)
                    found.append(name[1] if name else "")
    assert " dot(" in text
    return found


def sample(*shape: int) -> jax.Array:
    return jax.random.normal(jax.random.key(len(shape)), shape)


def test_a_float32_product_is_seen() -> None:
    x = sample(48, 48).astype(jnp.bfloat16)
    refused = lambda x: jnp.matmul(x.T, x, preferred_element_type=jnp.float32)  # noqa: E731
    assert len(wide_products(refused, x)) == 1
    assert not wide_products(lambda x: jnp.matmul(x, x, preferred_element_type=jnp.float32), x)


def test_a_linear_layer_both_ways() -> None:
    x, params = sample(3, 24, 16).astype(jnp.bfloat16), Linear(sample(16, 32), sample(32))

    def gradients(params: Linear, x: jax.Array) -> Any:
        loss = lambda params, x: jnp.sin(linear(params, x).astype(jnp.float32)).sum()  # noqa: E731
        return jax.grad(loss, argnums=(0, 1))(params, x)

    assert not wide_products(gradients, params, x)
    assert_near(gradients(params, x), gradients(params, x.astype(jnp.float32)))


@pytest.mark.parametrize("masking", [False, True], ids=["whole", "masked and dropped"])
def test_attention_both_ways(masking: bool) -> None:
    parts = [sample(2, 7, 3, 8).astype(jnp.bfloat16) + number for number in range(3)]
    mask = jnp.asarray(np.tri(7, dtype=bool)) if masking else None
    dropped = 2.0 * (sample(2, 3, 7, 7) > 0) if masking else None

    def gradients(*parts: jax.Array) -> Any:
        def loss(*parts: jax.Array) -> jax.Array:
            mixed = dot_product_attention(*parts, mask=mask, dropout_mask=dropped)
            return jnp.sin(mixed.astype(jnp.float32)).sum()

        return jax.grad(loss, argnums=(0, 1, 2))(*parts)

    assert not wide_products(gradients, *parts)
    assert_near(gradients(*parts), gradients(*(part.astype(jnp.float32) for part in parts)))


def test_a_model_describes() -> None:
    config = dataclasses.replace(PRESETS["tiny"], compute_dtype="bfloat16")
    params = cast_params(random_params(config), config)
    images = np.zeros((BATCH, *config.image_size, 3), np.uint8)
    names = wide_products(lambda params, images: describe(params, images, config), params, images)
    assert not unexpected(names)


def test_what_a_loop_keeps_for_the_gradient_stays_narrow() -> None:
    """XLA would widen the whole stack of it before the loop backward."""
    config = ViTConfig(dim=32, depth=3, heads=2, mlp_ratio=3.0, adapter="none")
    params = config.init(jax.random.key(0))
    images = jnp.ones((BATCH, 28, 42, 3), jnp.bfloat16)

    def total(images: jax.Array) -> jax.Array:
        return config.apply(params, images)[0].patches.astype(jnp.float32).sum()

    program = jax.jit(jax.grad(total)).lower(images).compile().as_text() or ""
    tokens = 1 + 2 * 3
    for kept in (f"3,{BATCH},{tokens},96", f"3,{BATCH * tokens},96"):  # qkv, hidden
        assert re.search(rf"(u|bf)16\[{kept}\]", program)
        assert f"f32[{kept}]" not in program


@pytest.mark.slow
def test_a_training_step() -> None:
    model = dataclasses.replace(PRESETS["tiny"], compute_dtype="bfloat16")
    recipe = dataclasses.replace(RECIPE, model=model)
    config = step_config(recipe, steps=100)
    state, frozen = init_train_state(random_params(model), "adapters,head", config)
    images, labels = np.zeros((BATCH, *model.image_size, 3), np.uint8), np.arange(BATCH) // 2

    def step(state: Any, frozen: Any, images: Any) -> Any:
        key, valid = jax.random.key(0), jnp.ones(BATCH, bool)
        return train_step(state, frozen, images, jnp.asarray(labels), valid, key, config)

    assert not unexpected(wide_products(step, state, frozen, images))


def unexpected(names: list[str]) -> list[str]:
    return [name for name in names if name and not any(part in name for part in WIDE_ON_PURPOSE)]


def assert_near(found: Any, expected: Any) -> None:
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        a, b = (np.asarray(x, np.float64).ravel() for x in (ours, theirs))
        # bfloat16 keeps 8 bits: some products of numbers that are each off by up to 2^-9.
        assert np.linalg.norm(a - b) < 0.02 * np.linalg.norm(b)
