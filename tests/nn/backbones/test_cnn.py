"""ResNet and VGG: grids, maxima, parameters and work as published, and what they refuse.

parity/test_cnn.py compares outputs and gradients with torch, parity/test_zoo.py with public code.
"""

import dataclasses
import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from crisalad_jax.nn.aggregators.vlad import AnyLocConfig
from crisalad_jax.nn.backbones import stages
from crisalad_jax.nn.backbones.base import Backbone, FeatureSpec
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.stages import StagedBackbone
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.convolutions import ConvNorm, conv_norm, init_he_conv, max_pool
from crisalad_jax.nn.costs import count_macs
from crisalad_jax.nn.layers import BatchNorm, Conv
from crisalad_jax.nn.model import check_params, describe
from crisalad_jax.training.trainable import count_trainable, merge_params, split_params
from crisalad_jax.utils.errors import InputError
from tests.conftest import assert_equal, random_params

BARE = "none"
SMALL = ModelConfig(
    image_size=(37, 52),
    backbone=ResNetConfig(layers=18, stages=2),
    aggregator="gem",
    cross_image=BARE,
)


def model(backbone: Backbone) -> ModelConfig:
    return ModelConfig(backbone=backbone, aggregator="gem", cross_image=BARE)


def macs(backbone: StagedBackbone) -> int:
    """Multiply-accumulates of one image of 224 x 224."""
    params = jax.eval_shape(backbone.init, jax.random.key(0))
    image = jax.ShapeDtypeStruct((1, 224, 224, 3), jnp.float32)

    def apply(p, x):
        return backbone.apply(p, x, FeatureSpec(), remat="none", valid=None)[0].patches

    return count_macs(apply, params, image).total()


def count_learnt(backbone: StagedBackbone) -> int:
    shapes = jax.eval_shape(backbone.init, jax.random.key(0))
    leaves = jax.tree_util.tree_leaves_with_path(shapes)
    return sum(leaf.size for path, leaf in leaves if "running" not in str(path[-1]))


@pytest.mark.parametrize(
    ("backbone", "classifier", "parameters", "gmacs"),
    [
        # torchvision's pages: all parameters, and "GFLOPS", which are multiply-accumulates.
        (ResNetConfig(layers=18), (512, 1000), 11_689_512, 1.81),
        (ResNetConfig(layers=50), (2048, 1000), 25_557_032, 4.09),
        (ResNetConfig(layers=101), (2048, 1000), 44_549_160, 7.80),
        # Of the paper's 138 M parameters 123,642,856 are the classifier's, by its shapes.
        (VggConfig(), (25_088, 4096, 4096, 1000), 138_357_544, 15.47),
    ],
)
def test_published_parameters_and_work(
    backbone: StagedBackbone, classifier: tuple[int, ...], parameters: int, gmacs: float
) -> None:
    products = sum(a * b for a, b in itertools.pairwise(classifier))
    assert count_learnt(backbone) + products + sum(classifier[1:]) == parameters
    assert (macs(backbone) + products) / 1e9 == pytest.approx(gmacs, abs=0.01)


def test_a_narrower_resnet_has_the_parameters_of_its_widths() -> None:
    """One stage of width 32: a kernel of 7 x 7, four of 3 x 3, a scale and a shift after each."""
    backbone = ResNetConfig(layers=18, stages=1, width=32)
    assert count_learnt(backbone) == 7 * 7 * 3 * 32 + 4 * 3 * 3 * 32 * 32 + 5 * 2 * 32
    assert backbone.dim == 32


@pytest.mark.parametrize("size", [(32, 64), (37, 52), (33, 65)])
@pytest.mark.parametrize("backbone", [SMALL.backbone, ResNetConfig(layers=18), VggConfig()])
def test_the_grid_is_that_of_the_features(backbone: StagedBackbone, size: tuple[int, int]) -> None:
    params = jax.eval_shape(backbone.init, jax.random.key(0))
    images = jax.ShapeDtypeStruct((2, *size, 3), jnp.float32)

    def apply(p, x):
        return backbone.apply(p, x, FeatureSpec(), remat="none", valid=None)[0]

    features = jax.eval_shape(apply, params, images)
    assert features.patches.shape == (2, math.prod(backbone.grid(size)), backbone.dim)
    assert features.class_token.shape == (2, 0)


@pytest.mark.parametrize(("sides", "tied"), [((7, 10), True), ((8, 9), False), ((3, 3), True)])
@pytest.mark.parametrize(
    ("size", "stride", "padding"), [(3, 2, 1), (2, 2, 0), (3, 2, 0), (3, 3, 1), (3, 1, 1)]
)
def test_maxima_and_their_gradient_are_torchs(
    size: int, stride: int, padding: int, sides: tuple[int, int], tied: bool
) -> None:
    """Of equal pixels, as behind a ReLU, the first has it in both."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, *sides, 3)).astype(np.float32)
    x = np.round(np.maximum(x, 0)) if tied else x
    images = torch.from_numpy(x).permute(0, 3, 1, 2).requires_grad_()
    pooled = F.max_pool2d(images, size, stride, padding)
    change = rng.integers(-4, 5, tuple(pooled.shape)).astype(np.float32)  # sums are exact
    pooled.backward(torch.from_numpy(change))
    maxima, to_images = jax.vjp(
        lambda x: max_pool(x, size, stride=stride, padding=padding), jnp.asarray(x)
    )
    np.testing.assert_array_equal(maxima, pooled.detach().permute(0, 2, 3, 1))
    (found,) = to_images(jnp.asarray(change.transpose(0, 2, 3, 1)))
    assert images.grad is not None
    np.testing.assert_array_equal(found, images.grad.permute(0, 2, 3, 1))


@pytest.mark.parametrize("bias", [False, True])
def test_a_folded_norm_is_torchs_convolution_and_norm(bias: bool) -> None:
    rng = np.random.default_rng(0)
    x, weight = rng.normal(size=(2, 9, 8, 3)), rng.normal(size=(3, 3, 3, 5))
    own = rng.normal(size=5) if bias else None
    gain, shift, mean, variance = rng.uniform(0.01, 1, (4, 5))
    with jax.enable_x64(True):
        params = ConvNorm(
            Conv(jnp.asarray(weight), None if own is None else jnp.asarray(own)),
            BatchNorm(*map(jnp.asarray, (gain, shift, mean, variance))),
        )
        found, _ = conv_norm(params, jnp.asarray(x), stride=2)
    first, kernel, *rest = map(torch.from_numpy, (x, weight, mean, variance, gain, shift))
    convolved = F.conv2d(
        first.permute(0, 3, 1, 2),
        kernel.permute(3, 2, 0, 1),
        None if own is None else torch.from_numpy(own),
        stride=2,
        padding=1,
    )
    # Sums of 27 products of order 1 in float64.
    np.testing.assert_allclose(
        found, F.batch_norm(convolved, *rest).permute(0, 2, 3, 1), atol=1e-12
    )


def test_convolutions_start_as_he_et_al() -> None:
    weight = init_he_conv(jax.random.key(0), 3, 64, 128).weight
    # 73,728 draws: a deviation is known to 0.3 %, of which 1 % is four.
    assert float(weight.std()) == pytest.approx(math.sqrt(2 / (9 * 128)), rel=0.01)


def test_the_last_stages_train_by_themselves() -> None:
    params = random_params(SMALL)
    trainable, frozen = split_params(params, SMALL, "last-1-blocks,head")
    assert trainable.backbone.stem.conv.weight is None
    *first, _ = trainable.backbone.blocks
    assert first
    assert jax.tree.leaves(first) == []
    # Two blocks of 128 channels, the first with a shortcut, without the norms' statistics; GeM's p.
    convolutions = 64 * 128 * 9 + 3 * 128 * 128 * 9 + 64 * 128
    assert count_trainable(SMALL, "last-1-blocks,head") == convolutions + 5 * 2 * 128 + 1
    merged = merge_params(trainable, frozen, SMALL)
    jax.tree.map(np.testing.assert_array_equal, merged, params)
    check_params(merged, SMALL)


def test_a_batch_is_its_images_and_bfloat16_is_near() -> None:
    params = random_params(SMALL)
    images = np.random.default_rng(0).integers(0, 256, (2, 37, 52, 3)).astype(np.uint8)
    both = describe(params, images, SMALL)
    # Sums of one program, in other batches.
    np.testing.assert_allclose(describe(params, images[1:], SMALL)[0], both[1], atol=2e-6)
    half = describe(params, images, dataclasses.replace(SMALL, compute_dtype="bfloat16"))
    assert half.dtype == jnp.float32
    # 8 bits of mantissa through ten layers.
    assert float((half * both).sum(axis=1).min()) > 0.999
    assert np.abs(half - both).max() > 1e-5
    full = dataclasses.replace(SMALL, remat="full")
    np.testing.assert_array_equal(describe(params, images, full), both)


@pytest.mark.parametrize(
    ("aggregator", "words"),
    [
        (AnyLocConfig(clusters=4, layer=-1), "facets of attention"),
        (AnyLocConfig(clusters=4, layer=-2, facet="token"), "features of other blocks"),
    ],
)
def test_what_a_convolutional_backbone_lacks_is_refused(aggregator: Any, words: str) -> None:
    with pytest.raises(InputError, match=f"found resnet for aggregator anyloc, .* {words}"):
        dataclasses.replace(SMALL, aggregator=aggregator)


def test_a_number_of_stages() -> None:
    with pytest.raises(InputError, match=r"ResNetConfig.stages: found 5, expected 1 to 4"):
        ResNetConfig(stages=5)


def test_a_batch_in_parts_is_the_whole_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU; parts of two images have the features of all at once."""
    params = random_params(SMALL)
    images = np.random.default_rng(0).normal(size=(6, *SMALL.image_size, 3)).astype(np.float32)
    found = {}
    for parts in (1, 3, 6):
        monkeypatch.setattr(stages, "parts_for_caches", lambda images, at_once, n=parts: n)
        how = {"request": FeatureSpec(), "remat": "none", "valid": None}
        apply = jax.jit(functools.partial(SMALL.backbone.apply, **how))
        assert apply.trace(params.backbone, images).jaxpr.pretty_print().count(" scan[") == (
            parts > 1
        )
        found[parts] = apply(params.backbone, images)[0].patches
        # A gradient is of the batch as a whole, whose program is the same.
        slope = jax.grad(lambda params, apply=apply: apply(params, images)[0].patches.sum())
        program = jax.make_jaxpr(slope)(params.backbone).pretty_print()
        assert " scan[" not in program
        found["slope", parts] = slope(params.backbone)
    for parts in (3, 6):
        assert_equal(found["slope", parts], found["slope", 1])
        # Float32, of sums of thousands in another order; 1e-6 of the largest is measured.
        largest = np.abs(found[1]).max()
        np.testing.assert_allclose(found[parts] / largest, found[1] / largest, atol=4e-6, rtol=0)
