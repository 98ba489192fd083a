"""Compare models over ResNet and VGG with the torch reference: descriptors and all gradients.

In float64 both sides agree up to some hundred roundings of 1e-16, and no ReLU or maximum switches
sides; a wrong stride, padding, epsilon or axis shows at 1e-2 and more.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax import describe
from crisalad_jax.checkpoints.formats import to_state
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, attend_across_images, tokens_and_statistics
from parity.cases.case import LAYOUT, build, convert

BOUND = 1e-11
"""A thousand times the float64 error here; the float32 error would be 1e-7."""
SIZE = (37, 52)
"""Sides that no stride divides evenly."""


@pytest.mark.parametrize(
    ("backbone", "aggregator"),
    [
        (ResNetConfig(layers=18, stages=3), CosPlaceConfig(dim=20)),
        pytest.param(
            ResNetConfig(stages=2),
            MixVprConfig(channels=20, rows=3, depth=2),
            marks=pytest.mark.slow,
        ),
        pytest.param(ResNetConfig(layers=101), ConvApConfig(channels=8), marks=pytest.mark.slow),
        pytest.param(VggConfig(), NetVladConfig(clusters=5), marks=pytest.mark.slow),
    ],
    ids=["CosPlace, ResNet-18", "MixVPR, ResNet-50", "Conv-AP, ResNet-101", "NetVLAD, VGG-16"],
)
def test_descriptors_and_gradients(backbone: Backbone, aggregator: Aggregator) -> None:
    config = ModelConfig(
        image_size=SIZE,
        backbone=backbone,
        aggregator=aggregator,
        cross_image="none",
    )
    rng = np.random.default_rng(0)
    model = build(config, "float64", rng)
    images = rng.normal(size=(2, *SIZE, 3))
    slopes = rng.normal(size=(2, config.descriptor_dim))
    theirs = model(torch.from_numpy(images).permute(0, 3, 1, 2))
    (theirs * torch.from_numpy(slopes)).sum().backward()
    expected = {n: p.grad.numpy() for n, p in model.named_parameters() if p.grad is not None}

    with jax.enable_x64(True):
        params, extras = convert(model)

        def weighed(params: object) -> tuple[jax.Array, jax.Array]:
            found = describe(params, jnp.asarray(images), model.config)
            return (found * slopes).sum(), found

        gradients, found = jax.grad(weighed, has_aux=True)(params)
        ours = to_state(gradients, model.config, LAYOUT, extras)
    np.testing.assert_allclose(found, theirs.detach().numpy(), atol=BOUND)
    assert len(expected) > 20
    for name, gradient in expected.items():
        error = np.linalg.norm(ours[name] - gradient)
        # The gradient of a bias before a norm is only rounding, so the scale is the whole gradient.
        assert error < BOUND * np.linalg.norm(gradient) + 1e-14, name


@pytest.mark.slow
def test_a_training_batch_is_normalised_as_torch_does() -> None:
    """Descriptors, gradients through batch statistics, and the updated running statistics."""
    config = ModelConfig(
        image_size=SIZE,
        backbone=ResNetConfig(layers=18, stages=2),
        aggregator=CosPlaceConfig(dim=20),
        cross_image="none",
    )
    rng = np.random.default_rng(0)
    model = build(config, "float64", rng).train()
    images = rng.normal(size=(3, *SIZE, 3))
    slopes = rng.normal(size=(3, config.descriptor_dim))
    with jax.enable_x64(True):
        params, extras = convert(model)

        def weighed(params: Crisalad) -> tuple[jax.Array, tuple[jax.Array, Crisalad]]:
            tokens, statistics = tokens_and_statistics(
                params, jnp.asarray(images), model.config, valid=jnp.ones(3, bool)
            )
            found = attend_across_images(params, tokens, model.config)
            return (found * slopes).sum(), (found, statistics)

        gradients, (found, statistics) = jax.grad(weighed, has_aux=True)(params)
        ours = to_state(gradients, model.config, LAYOUT, extras)
        after = to_state(eqx.combine(statistics, params), model.config, LAYOUT, extras)
    theirs = model(torch.from_numpy(images).permute(0, 3, 1, 2))
    (theirs * torch.from_numpy(slopes)).sum().backward()
    np.testing.assert_allclose(found, theirs.detach().numpy(), atol=BOUND)
    scale = max(float(p.grad.norm()) for p in model.parameters() if p.grad is not None)
    for name, parameter in model.named_parameters():
        if parameter.grad is not None:
            error = np.linalg.norm(ours[name] - parameter.grad.numpy())
            assert error < BOUND * scale, name
    moved = 0
    for name, buffer in model.named_buffers():
        if "running" in name:
            np.testing.assert_allclose(after[name], buffer.numpy(), rtol=BOUND, atol=BOUND)
            moved += bool((buffer.numpy() != extras.get(name, 0)).any())
    assert moved == 2 * 10  # a norm for each of ten convolutions
