"""Adapters as parts: a user's own, in recipes, and what is refused."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.adapters.lora import LoraConfig
from crisalad_jax.nn.backbones.vit import ViTConfig, block
from tests.conftest import MODEL


@pytest.fixture
def own(own_parts: Any) -> type:
    """Register an adapter with every hook, whose constant parameters are known."""

    @cj.register_adapter("own")
    @dataclasses.dataclass(frozen=True)
    class Own(cj.Adapter):
        """Add constants."""

        extra: int = 0

        def init(self, key: Any, shape: Any) -> Any:
            return jnp.zeros(shape.dim)

        def linear_update(self, params: Any, name: str, x: Any) -> Any:
            return jnp.full((*x.shape[:-1], 16 + self.extra), 0.5) if name == "proj" else None

        def attention_update(self, params: Any, attended: Any, info: Any) -> Any:
            return params + attended

        def mlp_update(self, params: Any, tokens: Any, info: Any) -> Any:
            return jnp.full_like(tokens, 3.0), params

    return Own


def test_hooks_add_where_they_say(own: type) -> None:
    """With a silent block x' = x + 2 (b + 0.5) + p of proj's bias b; then 3 more."""
    config = ViTConfig(dim=16, depth=1, heads=2, adapter="own")
    one = jax.tree.map(lambda leaf: leaf[0], config.init(jax.random.key(0)).blocks)
    silent = jax.tree.map(lambda leaf: jnp.zeros_like(leaf), one)
    attn = dataclasses.replace(
        silent.attn, proj=dataclasses.replace(silent.attn.proj, bias=jnp.full(16, 0.25))
    )
    ones = jnp.ones(16)
    params = dataclasses.replace(silent, attn=attn, ls1=ones, ls2=ones, adapter=jnp.arange(16.0))
    tokens = jnp.ones((1, 7, 16))
    found = jax.jit(lambda params, x: block(params, x, TokenInfo((2, 3)), config)[0])(
        params, tokens
    )
    expected = 1 + 2 * 0.75 + np.arange(16) + 3
    np.testing.assert_array_equal(found, np.broadcast_to(expected, (1, 7, 16)))


def test_what_a_hook_returns_is_checked(own: Any) -> None:
    config = dataclasses.replace(
        MODEL, backbone=ViTConfig(dim=16, depth=1, heads=2, adapter=own(1))
    )
    config = dataclasses.replace(config, aggregator="gem", cross_image="none")
    params = cj.init_crisalad(jax.random.key(0), config)
    images = np.zeros((1, *config.input_size, 3), np.uint8)
    with pytest.raises(
        cj.InputError, match=r"^adapter own: found to return float32\[1,.*,17\], exp"
    ):
        cj.describe(params, images, config)


def test_recipes_take_an_adapter() -> None:
    lora = cj.recipe("b14", "crisalad+lora")
    assert (lora.model.backbone.adapter.part_name, lora.trainable) == ("lora", "adapters,head")
    # SALAD's own blocks stay frozen then: the adapters train in their place.
    assert cj.recipe("b14", "salad+lora").trainable == "adapters,head"
    assert cj.recipe("b14", "crisalad+adapter:none").trainable == "head"
    assert cj.recipe("tiny", "scratch+mlp").trainable == "all"
    with pytest.raises(
        cj.InputError, match=r"found adapter 'mlp' for backbone resnet, expected a v"
    ):
        cj.recipe("b14", "cosplace+mlp")


def test_an_adapter_that_would_not_train_is_refused() -> None:
    params = cj.init_crisalad(jax.random.key(5), MODEL)
    with pytest.raises(cj.InputError, match=r"^trainable: found 'head', which leaves .*adapter"):
        cj.split_params(params, MODEL, "head")
    # Trained ones may stay as they are, where that is said.
    trained, _ = cj.split_params(params, MODEL, "head,-adapters")
    assert not jax.tree.leaves(trained.backbone)


@pytest.mark.usefixtures("own_parts")
def test_an_adapter_that_does_nothing_is_refused() -> None:
    @cj.register_adapter("test-idle")
    @dataclasses.dataclass(frozen=True)
    class Idle(cj.Adapter):
        def init(self, key, shape):
            return {"a": jnp.zeros(shape.dim)}

        def mlp_updat(self, params, tokens, grid, *, length=None, valid=None):
            return params["a"], params

    with pytest.raises(cj.InputError, match=r"adapter: found .*Idle\(\), expected one with a m"):
        ViTConfig(adapter="test-idle")


@pytest.mark.usefixtures("own_parts")
def test_a_merge_that_is_another_layer_is_told() -> None:
    @cj.register_adapter("test-half")
    @dataclasses.dataclass(frozen=True)
    class Half(LoraConfig):
        def merge(self, params, name, layer):
            weight = 0.5 * layer.weight + 0.5 * super().merge(params, name, layer).weight
            return dataclasses.replace(layer, weight=weight)

    backbone: Any = MODEL.backbone
    config = dataclasses.replace(MODEL, backbone=dataclasses.replace(backbone, adapter=Half()))
    params = cj.init_crisalad(jax.random.key(0), config)
    params = jax.tree.map(lambda leaf: leaf + 0.1, params)
    with pytest.raises(cj.InputError, match=r"test-half: found .* to disagree in layer qkv"):
        cj.merge_adapters(cj.Model(params, config))
