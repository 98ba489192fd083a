"""ResNet (He et al., CVPR 2016), in torchvision's form: the stride is in the 3 x 3 convolution."""

import dataclasses
from collections.abc import Iterator
from typing import Any, Literal

import jax
from jaxtyping import PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require_range
from crisalad_jax.nn import random_init
from crisalad_jax.nn.backbones.base import BACKBONES, Grid, Valid
from crisalad_jax.nn.backbones.stages import Stage, StagedBackbone, Stages
from crisalad_jax.nn.convolutions import ConvNorm, Map, conv_norm, init_conv_norm, max_pool
from crisalad_jax.utils.pytree import pytree_dataclass

Layers = Literal[18, 50, 101, 152]
BLOCKS: dict[Layers, tuple[int, ...]] = {
    18: (2, 2, 2, 2),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
    152: (3, 8, 36, 3),
}
"""Number of residual blocks in each stage, by the number of layers."""
STEM_SIDE = 7
"""Side of the first convolution's kernel."""


@pytree_dataclass
class Residual:
    """A residual block: convolutions, and a shortcut where the shape changes."""

    convs: tuple[ConvNorm, ...]
    """Two 3 x 3 convolutions; or a 1 x 1, a 3 x 3, and a 1 x 1 to four times the width."""
    shortcut: ConvNorm | None


@BACKBONES.register("resnet", tiny={"layers": 18, "stages": 2})
class ResNetConfig(StagedBackbone):
    """A ResNet (He et al., CVPR 2016), for images of any size."""

    layers: Layers = 50
    """Number of layers. 18 has blocks of two convolutions, the others of three."""
    stages: int = 4
    """Number of stages to use, from the first."""
    width: PositiveInt = 64
    """Width of the first convolution and inside the blocks of the first stage; published: 64."""

    def __post_init__(self) -> None:
        """Check the range."""
        require_range(self, 1, 4, "stages")

    @property
    def depth(self) -> int:
        """Number of stages."""
        return self.stages

    @property
    def dim(self) -> int:
        """Width of a feature."""
        return self.widths(self.stages - 1)[-1]

    @property
    def patch_size(self) -> int:
        """Distance between neighbouring features in pixels."""
        return 2 ** (self.stages + 1)

    @property
    def extras(self) -> str:
        """Number of layers, and the width if it is not the published one, for a summary."""
        width = "" if self.width == 64 else f" of width {self.width}"
        return f", ResNet-{self.layers}{width}"

    def widths(self, stage: int) -> tuple[int, ...]:
        """Return the widths of a block's convolutions in stage `stage`, counted from 0."""
        width = self.width * 2**stage
        return (width, width) if self.layers == 18 else (width, width, 4 * width)

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return the rows and columns of features: every halving rounds up."""
        height, width = image_size
        return -(-height // self.patch_size), -(-width // self.patch_size)

    def init(self, key: PRNGKeyArray) -> Stages:
        """Draw parameters as torchvision initialises them."""
        stem_key, *keys = random_init.split(key, 1 + self.stages)
        return Stages(
            init_conv_norm(stem_key, STEM_SIDE, 3, self.width),
            tuple(Stage(tuple(self._init_stage(keys[i], i))) for i in range(self.stages)),
        )

    def adapt_checkpoint(self, config: Any, params: Stages, fresh: Any) -> tuple[Any, Stages]:
        """Take the first stages of a backbone with more of them: torchvision's files have four."""
        stages = min(config.stages, self.stages)
        blocks: Any = params.blocks[:stages]
        changed = dataclasses.replace(config, stages=stages)
        return changed, dataclasses.replace(params, blocks=blocks)

    def _init_stage(self, key: PRNGKeyArray, stage: int) -> Iterator[Residual]:
        d_in = self.widths(stage - 1)[-1] if stage else self.width
        kernels = (3, 3) if self.layers == 18 else (1, 3, 1)
        for block_key in random_init.split(key, BLOCKS[self.layers][stage]):
            shortcut_key, *keys = random_init.split(block_key, 4)
            widths = self.widths(stage)
            shapes = zip(keys, kernels, (d_in, *widths), widths, strict=False)
            convs = tuple(init_conv_norm(*shape) for shape in shapes)
            changes = d_in != widths[-1]
            shortcut = init_conv_norm(shortcut_key, 1, d_in, widths[-1]) if changes else None
            yield Residual(convs, shortcut)
            d_in = widths[-1]

    def run_stem(self, params: ConvNorm, images: Map, valid: Valid) -> tuple[Map, ConvNorm]:
        """Apply the 7 x 7 convolution and 3 x 3 max pooling, each of which halves the grid."""
        x, params = conv_norm(params, images, valid, stride=2)
        return max_pool(jax.nn.relu(x), 3, padding=1), params

    def run_stage(self, number: int, params: Stage, x: Map, valid: Valid) -> tuple[Map, Stage]:
        """Run the blocks; the first one halves the grid, except in the first stage."""
        layers = []
        for i, block in enumerate(params.layers):
            x, block = residual(block, x, valid, stride=2 if number and not i else 1)
            layers.append(block)
        return x, Stage(tuple(layers))


def residual(params: Residual, x: Map, valid: Valid, *, stride: int) -> tuple[Map, Residual]:
    """Add the output of the convolutions to the input; the first 3 x 3 convolution has the stride.

    Returns:
        (y, updated): the output after a ReLU, and the block, updated as in `conv_norm`.
    """
    y, convs, shortcut = x, [], params.shortcut
    strided = next(i for i, each in enumerate(params.convs) if each.conv.weight.shape[0] == 3)
    for i, layer in enumerate(params.convs):
        y = jax.nn.relu(y) if i else y
        y, layer = conv_norm(layer, y, valid, stride=stride if i == strided else 1)
        convs.append(layer)
    if shortcut is not None:
        x, shortcut = conv_norm(shortcut, x, valid, stride=stride)
    return jax.nn.relu(x + y), Residual(tuple(convs), shortcut)
