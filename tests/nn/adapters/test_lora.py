"""LoRA against torch: a block with W x + alpha / rank B A x, its gradients, and the merge."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional as F

import crisalad_jax as cj
from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.adapters.lora import LoraConfig
from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config
from crisalad_jax.nn.backbones.vit import NORM_EPSILON, VisionTransformer, ViTConfig, block
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import MODEL

LORA = LoraConfig(rank=3, alpha=6.0, layers=("qkv", "proj", "fc1", "fc2"))
HEADS = 2


def random_like(tree: Any, seed: int) -> Any:
    """Draw all leaves from a normal distribution of deviation 0.3."""
    leaves, structure = jax.tree.flatten(tree)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    drawn = [0.3 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(structure, drawn)


def torch_block(t: Any, x: torch.Tensor) -> torch.Tensor:
    """DINOv2's block, where every linear layer has an update of LoRA."""

    def layer(name: str, params: Any, x: torch.Tensor) -> torch.Tensor:
        a, b = t.adapter[name].down.weight.T, t.adapter[name].up.weight.T
        return F.linear(x, params.weight.T, params.bias) + 6 / 3 * F.linear(F.linear(x, a), b)

    def norm(params: Any, x: torch.Tensor) -> torch.Tensor:
        return F.layer_norm(x, x.shape[-1:], params.weight, params.bias, NORM_EPSILON)

    qkv = layer("qkv", t.attn.qkv, norm(t.norm1, x))
    q, k, v = (part.unflatten(-1, (HEADS, -1)).mT for part in qkv.chunk(3, dim=-1))
    q, k, v = (part.permute(0, 3, 1, 2) for part in (q, k, v))  # image, head, token, number
    mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
    x = x + t.ls1 * layer("proj", t.attn.proj, mixed)
    hidden = F.gelu(layer("fc1", t.mlp.fc1, norm(t.norm2, x)))
    return x + t.ls2 * layer("fc2", t.mlp.fc2, hidden)


def test_a_block_and_its_gradients_equal_torchs() -> None:
    config = ViTConfig(dim=16, depth=1, heads=HEADS, mlp_ratio=2.0, adapter=LORA)
    one = jax.tree.map(lambda leaf: leaf[0], config.init(jax.random.key(0)).blocks)
    params = random_like(one, 1)
    tokens, weights = random_like((jnp.zeros((2, 7, 16)),) * 2, 2)

    def loss(adapter: Any, tokens: jax.Array) -> tuple[jax.Array, jax.Array]:
        y, _ = block(
            dataclasses.replace(params, adapter=adapter), tokens, TokenInfo((2, 3)), config
        )
        return (y * weights).sum(), y

    grads, found = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(params.adapter, tokens)

    t = jax.tree.map(lambda leaf: torch.tensor(np.array(leaf), requires_grad=True), params)
    x = torch.tensor(np.array(tokens), requires_grad=True)
    expected = torch_block(t, x)
    (expected * torch.tensor(np.array(weights))).sum().backward()
    # Sums of at most 48 products of order 1, in float32.
    np.testing.assert_allclose(found, expected.detach(), rtol=1e-5, atol=2e-6)
    theirs = {name: leaf.grad for name, leaf in named_leaves(t.adapter).items()}
    assert len(theirs) == 8
    for name, leaf in (named_leaves(grads[0]) | {"tokens": grads[1]}).items():
        np.testing.assert_allclose(leaf, (theirs | {"tokens": x.grad})[name], rtol=1e-4, atol=1e-5)


def adapted(backbone: VisionTransformer) -> tuple[cj.Model, np.ndarray]:
    """Make a model with random updates, and two images."""
    config = dataclasses.replace(
        MODEL, backbone=backbone, image_size=(6 * backbone.patch_size,) * 2
    )
    params = cj.init_crisalad(jax.random.key(0), config)
    blocks = params.backbone.blocks
    blocks = dataclasses.replace(blocks, adapter=random_like(blocks.adapter, 3))
    params = dataclasses.replace(
        params, backbone=dataclasses.replace(params.backbone, blocks=blocks)
    )
    images = np.random.default_rng(0).integers(0, 256, (2, *config.image_size, 3), dtype=np.uint8)
    return cj.Model(params, config), images


GATED = ("qkv", "w12", "w3")


@pytest.mark.parametrize(
    "backbone",
    [
        pytest.param(dataclasses.replace(MODEL.backbone, adapter=LORA), marks=pytest.mark.slow),
        pytest.param(
            DinoV3Config(dim=32, depth=2, heads=2, ffn="swiglu", adapter=LoraConfig(layers=GATED)),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["vit", "dinov3"],
)
def test_a_merged_model_has_the_same_descriptors(backbone: VisionTransformer) -> None:
    model, images = adapted(backbone)
    merged = cj.merge_adapters(model)
    assert merged.config.backbone == dataclasses.replace(backbone, adapter="none")
    assert not [name for name in named_leaves(merged.params) if "adapter" in name]
    found = cj.describe(merged.params, images, merged.config)
    # Unit vectors in float32.
    np.testing.assert_allclose(found, cj.describe(model.params, images, model.config), atol=1e-6)
    bare = dataclasses.replace(
        model.params.backbone,
        blocks=dataclasses.replace(model.params.backbone.blocks, adapter=None),
    )
    plain = dataclasses.replace(model.params, backbone=bare)
    change = cj.describe(plain, images, merged.config) - found
    assert abs(change).max() > 1e-3  # the updates do something
    # What is read from inside a block has them too.
    pixels = jnp.asarray(images, jnp.float32) / 255
    for request in (
        FeatureSpec((1,), facet="key", norm=False),
        FeatureSpec(class_attention=True),
    ):
        inside, expected = (
            jax.jit(functools.partial(each.config.backbone.apply, request=request))(
                each.params.backbone, pixels
            )[0]
            for each in (model, merged)
        )
        # Tokens of order 1, and shares of at most 2 heads.
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=2e-5), inside, expected)


def test_an_untrained_update_is_0() -> None:
    """B starts at 0, A within 1 / sqrt(d_in) (torch's linear layer, as loralib)."""
    shape = ViTConfig(dim=64, heads=2).block_shape
    params = LoraConfig(rank=16).init(jax.random.key(0), shape)
    assert params.keys() == {"qkv", "proj"}
    assert params["qkv"].up.weight.shape == (16, 192)
    for each in params.values():
        assert not each.up.weight.any()
        assert 0.9 / 8 < abs(each.down.weight).max() <= 1 / 8


def test_no_gradient_has_the_size_of_a_weight() -> None:
    """Of qkv and proj at 64 wide the backward pass multiplies no (64, 192) or (64, 64) matrix."""
    config = ViTConfig(dim=64, depth=1, heads=2, adapter="lora")
    params = jax.eval_shape(config.init, jax.random.key(0))
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), params.blocks)

    def loss(adapter: Any, frozen: Any, tokens: jax.Array) -> jax.Array:
        return block(
            dataclasses.replace(frozen, adapter=adapter), tokens, TokenInfo((2, 3)), config
        )[0].sum()

    tokens = jax.ShapeDtypeStruct((5, 7, 64), jnp.float32)
    program = jax.make_jaxpr(jax.grad(loss))(one.adapter, one, tokens)
    made = {equation.outvars[0].aval.shape for equation in program.eqns}
    assert (8, 192) in made or (192, 8) in made  # a gradient of B
    assert not made & {(64, 192), (192, 64), (64, 64)}


@pytest.mark.parametrize(
    ("layers", "words"),
    [
        (("w12",), r"found \('w12',\), expected some of qkv, proj, fc1, fc2, each once"),
        (("qkv", "qkv"), "each once"),
        ((), "each once"),
    ],
)
def test_layers_that_a_block_lacks_are_refused(layers: Any, words: str) -> None:
    with pytest.raises(cj.InputError, match=f"^LoraConfig.layers: .*{words}"):
        ViTConfig(adapter=LoraConfig(layers=layers))


def test_only_updates_of_weights_merge() -> None:
    config = MODEL
    params = cj.init_crisalad(jax.random.key(0), config)
    with pytest.raises(cj.InputError, match=r"^merge_adapters: found adapter depthwise, expected"):
        cj.merge_adapters(cj.Model(params, config))
