"""SelaVPR: a generalised mean, and local features for re-ranking (Lu et al., ICLR 2024)."""

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.gem import START, gem
from crisalad_jax.nn.aggregators.salad import Fol
from crisalad_jax.nn.backbones.base import Backbone, Features, Grid, Patches
from crisalad_jax.nn.convolutions import Map
from crisalad_jax.nn.layers import (
    Conv,
    Keys,
    at_least_float32,
    init_transposed_conv,
    l2_normalise,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

SCALE = 2
"""Stride of both transposed convolutions."""


@pytree_dataclass
class SelaVpr:
    """The exponent of the generalised mean, and two transposed convolutions of 3 x 3."""

    p: Float[Array, ""]
    upconv1: Conv
    upconv2: Conv


@AGGREGATORS.register("selavpr", tiny={"hidden": 32, "local": 16})
class SelaVprConfig(Aggregator):
    """SelaVPR's global and local features (Lu et al., ICLR 2024).

    Example:
        >>> SelaVprConfig().local_grid((16, 16))
        (61, 61)
    """

    hidden: PositiveInt = 256
    """Number of channels between the transposed convolutions."""
    local: PositiveInt = 128
    """Width of a local feature."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)

    def local_grid(self, grid: Grid) -> tuple[int, int]:
        """Return the rows and columns of local features for a grid of patches."""
        rows, columns = (SCALE * (SCALE * (side - 1)) + 1 for side in grid)
        return rows, columns

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> SelaVpr:
        """Draw the convolutions as torch does, and set the exponent to 3."""
        first, second = random_init.split(key)
        return SelaVpr(
            p=random_init.full((), START),
            upconv1=init_transposed_conv(first, 3, backbone.dim, self.hidden),
            upconv2=init_transposed_conv(second, 3, self.hidden, self.local),
        )

    def apply(self, params: SelaVpr, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the generalised mean of patches; in training, also local features for the loss."""
        tokens = Tokens.of_global(gem(features.patches, params.p))
        if key is None:
            return tokens
        dense = local_features(params, features.patches, grid)
        return tokens._replace(dense=dense.reshape(*dense.shape[:-3], -1, self.local))


def local_features(
    params: SelaVpr | Fol, patches: Patches, grid: Grid
) -> Float[Array, "*batch rows columns local"]:
    """Upsample the patches to a finer grid of unit-length local features, in at least float32.

    Args:
        params: parameters of the aggregator: two transposed convolutions, with a ReLU between.
        patches: output of the backbone's last layer norm.
        grid: rows and columns of patches; n of them become 4 n - 3.
    """
    maps = patches.reshape(-1, *grid, patches.shape[-1])
    maps = jax.nn.relu(upconv(params.upconv1, maps))
    maps = l2_normalise(at_least_float32(upconv(params.upconv2, maps)))
    return maps.reshape(*patches.shape[:-2], *maps.shape[1:])


def upconv(params: Conv, x: Map) -> Map:
    """Apply a transposed convolution, like torch's `nn.ConvTranspose2d(3, stride=2, padding=1)`.

    It is computed as a convolution with the flipped kernel, after zeros are put between the pixels
    of `x`. The axes of the weight are row, column, input channel, output channel.
    """
    assert params.bias is not None
    y = jax.lax.conv_general_dilated(
        x,
        params.weight[::-1, ::-1].astype(x.dtype),
        window_strides=(1, 1),
        padding=((1, 1), (1, 1)),
        lhs_dilation=(SCALE, SCALE),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return (at_least_float32(y) + params.bias).astype(x.dtype)
