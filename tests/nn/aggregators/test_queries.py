"""BoQ against torch's own transformer modules, under the names of the public checkpoints."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from crisalad_jax.checkpoints.formats import public_shapes, to_state
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators.base import to_descriptor
from crisalad_jax.nn.aggregators.queries import Boq, BoqConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import extract_features
from tests.conftest import random_params

CONFIG = ModelConfig(
    image_size=(28, 42),
    backbone=ViTConfig(
        dim=12, depth=1, heads=1, position_grid=2, adapter=AdapterConfig(kind="none")
    ),
    # Two heads.
    aggregator=BoqConfig(channels=128, queries=3, layers=2, rows=5),
    cross_image=CrossImageConfig(layers=0),
)


class Published(nn.Module):
    """The equations of the paper's section 3, in the names that public checkpoints have."""

    def __init__(self, dim: int, config: BoqConfig) -> None:
        super().__init__()
        width, heads = config.channels, config.heads
        self.proj_c = nn.Conv2d(dim, width, 3, padding=1)
        self.norm_input = nn.LayerNorm(width)
        self.boqs = nn.ModuleList()
        for _ in range(config.layers):
            block = nn.Module()
            block.encoder = nn.TransformerEncoderLayer(width, heads, 4 * width, 0.0)
            block.queries = nn.Parameter(torch.zeros(1, config.queries, width))
            block.self_attn = nn.MultiheadAttention(width, heads)
            block.norm_q = nn.LayerNorm(width)
            block.cross_attn = nn.MultiheadAttention(width, heads)
            block.norm_out = nn.LayerNorm(width)
            self.boqs.append(block)
        self.fc = nn.Linear(config.layers * config.queries, config.rows)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """(batch, dim, rows, columns) to (batch, descriptor); tokens come first inside."""
        x = self.norm_input(self.proj_c(maps).flatten(2).permute(2, 0, 1))
        found = []
        for block in self.boqs:
            x = block.encoder(x)
            queries = block.queries.permute(1, 0, 2).expand(-1, x.shape[1], -1)
            queries = block.norm_q(queries + block.self_attn(queries, queries, queries)[0])
            found.append(block.norm_out(block.cross_attn(queries, x, x)[0]))
        return F.normalize(self.fc(torch.cat(found).permute(1, 2, 0)).flatten(1), dim=1)


def test_the_descriptor_is_torchs() -> None:
    params = random_params(CONFIG)
    state = to_state(params, CONFIG, "reference", {})
    theirs = Published(12, CONFIG.aggregator)
    theirs.load_state_dict(
        {
            name.removeprefix("aggregator."): torch.tensor(array)
            for name, array in state.items()
            if name.startswith("aggregator.")
        }
    )
    patches = np.random.default_rng(0).normal(size=(2, 6, 12)).astype(np.float32)
    expected = theirs(torch.tensor(patches).mT.unflatten(2, (2, 3)))

    features = Features(jnp.zeros((2, 12)), jnp.asarray(patches))

    @jax.jit
    def descriptors(params: Boq, features: Features) -> jax.Array:
        tokens = CONFIG.aggregator.apply(params, features, (2, 3), key=None)
        return jax.vmap(lambda one: to_descriptor(one, CONFIG.aggregator))(tokens)

    assert isinstance(params.aggregator, Boq)
    found = descriptors(params.aggregator, features)
    assert found.shape == (2, CONFIG.descriptor_dim) == (2, 5 * 128)
    # Entries of 0.04 after two blocks of float32 sums.
    np.testing.assert_allclose(found, expected.detach(), atol=1e-6)


def test_the_published_model_has_12288_numbers_and_these_parameters() -> None:
    """The sizes of the public checkpoint on DINOv2 ViT-B/14, whose names and shapes torch tells."""
    config = ModelConfig(
        image_size=(322, 322), aggregator="boq", cross_image=CrossImageConfig(layers=0)
    )
    assert config.descriptor_dim == 12_288
    assert config.aggregator.heads == 6
    with torch.device("meta"):
        theirs = Published(768, config.aggregator).state_dict()
    found = {
        name.removeprefix("aggregator."): shape
        for name, shape in public_shapes(config, "reference").items()
        if name.startswith("aggregator.")
    }
    assert found == {name: tuple(tensor.shape) for name, tensor in theirs.items()}


def test_patches_go_through_the_last_norm_only_if_asked_for() -> None:
    params = random_params(CONFIG)
    images = np.random.default_rng(0).integers(0, 256, (2, 28, 42, 3), np.uint8)
    asked = dataclasses.replace(CONFIG.aggregator, last_norm=True)
    without = extract_features(params, images, CONFIG).patches
    found = extract_features(params, images, dataclasses.replace(CONFIG, aggregator=asked)).patches
    norm = params.backbone.norm
    weight, bias = (torch.tensor(np.asarray(x)) for x in (norm.weight, norm.bias))
    expected = F.layer_norm(torch.tensor(np.asarray(without)), (12,), weight, bias, 1e-6)
    # Float32's rounding in one layer norm.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(without - found).max() > 0.1


@pytest.mark.slow
def test_it_starts_as_torch_does() -> None:
    """Queries normal of deviation 1; attention Glorot-uniform with zero biases."""
    config = BoqConfig(channels=64, queries=40, layers=1)
    init = jax.jit(lambda key: config.init(key, CONFIG.backbone, CONFIG.grid))
    params = init(jax.random.key(0))
    assert isinstance(params, Boq)
    (block,) = params.boqs
    np.testing.assert_allclose(jnp.std(block.queries), 1, rtol=0.06)  # of 2,560 draws: 1.4 %
    for attention in (block.self_attn, block.cross_attn, block.encoder.attn):
        bound = np.sqrt(6 / (64 + 3 * 64))
        assert 0.99 * bound < jnp.abs(attention.qkv.weight).max() <= bound
        for layer in (attention.qkv, attention.proj):
            assert layer.bias is not None
            assert not layer.bias.any()
