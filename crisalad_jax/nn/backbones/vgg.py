"""VGG-16 (Simonyan and Zisserman, ICLR 2015) up to its last convolution, as in NetVLAD."""

import itertools
from typing import ClassVar

import jax
from jaxtyping import PRNGKeyArray

from crisalad_jax.nn import random_init
from crisalad_jax.nn.backbones.base import BACKBONES, Grid, Valid
from crisalad_jax.nn.backbones.stages import Stage, StagedBackbone, Stages
from crisalad_jax.nn.convolutions import Map, init_he_conv, max_pool
from crisalad_jax.nn.layers import conv

WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Widths of the 3 x 3 convolutions of each stage."""


@BACKBONES.register("vgg")
class VggConfig(StagedBackbone):
    """VGG-16 without its last ReLU and max pooling (Simonyan and Zisserman, ICLR 2015)."""

    patch_size: ClassVar[int] = 16
    """Distance between neighbouring features in pixels."""
    depth: ClassVar[int] = len(WIDTHS)
    """Number of stages."""
    dim: ClassVar[int] = WIDTHS[-1][-1]
    """Width of a feature."""

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return the rows and columns of features: every halving rounds down."""
        height, width = image_size
        return height // self.patch_size, width // self.patch_size

    def init(self, key: PRNGKeyArray) -> Stages:
        """Draw parameters as torchvision initialises them."""
        widths = list(itertools.chain.from_iterable(WIDTHS))
        pairs = zip(random_init.split(key, len(widths)), (3, *widths), widths, strict=False)
        layers = iter([init_he_conv(each, 3, a, b, bias=True) for each, a, b in pairs])
        return Stages(None, tuple(Stage(tuple(itertools.islice(layers, len(w)))) for w in WIDTHS))

    def run_stage(self, number: int, params: Stage, x: Map, valid: Valid) -> tuple[Map, Stage]:
        """Pool (except in the first stage), and run the convolutions; the last has no ReLU."""
        x = max_pool(x, 2) if number else x
        for i, layer in enumerate(params.layers):
            x = conv(layer, x)
            if (number, i) != (len(WIDTHS) - 1, len(params.layers) - 1):
                x = jax.nn.relu(x)
        return x, params
