"""DINOv3's vision transformer ViT/16 (Siméoni et al. 2025), without augmentation of positions.

Written from the paper and the behaviour of Hugging Face's DINOv3ViTModel, whose outputs it
reproduces. Differences from DINOv2: patches of 16 x 16, rotary positions, keys without a bias, and
the epsilon of the layer norms.
"""

import functools
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from crisalad_jax.config.checks import NonNegativeInt, require_field
from crisalad_jax.nn.attention import Attention, Rotation
from crisalad_jax.nn.backbones.base import BACKBONES, Grid
from crisalad_jax.nn.backbones.vit import Block, VisionTransformer
from crisalad_jax.nn.layers import Linear

PERIOD_BASE = 100.0
"""Limit of the longest rotary period; the shortest is 1, half the side of an image."""


@BACKBONES.register(
    "dinov3",
    tiny={"dim": 128, "depth": 4, "heads": 4},
    s14={"dim": 384, "heads": 6},
    l14={"dim": 1024, "depth": 24, "heads": 16},
    g14={"dim": 1280, "depth": 32, "heads": 20, "ffn": "swiglu", "mlp_ratio": 6.0},
)
class DinoV3Config(VisionTransformer):
    """A DINOv3 vision transformer with patches of 16 x 16 (Siméoni et al. 2025).

    Queries and keys are rotated by the row and column of their patch. The default is ViT-B/16. The
    preset g14 is ViT-H+/16, the largest distilled model.
    """

    patch_size: ClassVar[int] = 16
    norm_epsilon: ClassVar[float] = 1e-5
    token_deviation: ClassVar[float] = 0.02
    registers: NonNegativeInt = 4

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        fits = self.dim // self.heads % 4 == 0
        require_field(self, "heads", fits, f"a divisor of a fourth of dim ({self.dim})")

    def rotation(self, grid: Grid) -> Rotation:
        """Return the cosines and sines of the patches' angles; see `rotary_angles`."""
        return _rotation(grid, self.dim // self.heads)

    def attention_of(self, layer: Block) -> Attention:
        """Return a block's attention with the keys' bias set to 0, so that it has no gradient.

        With rotated keys a bias would not cancel in the softmax.
        """
        qkv = layer.attn.qkv
        assert qkv.bias is not None
        queries, keys, values = jnp.split(qkv.bias, 3, axis=-1)
        bias = jnp.concatenate([queries, jnp.zeros_like(keys), values], axis=-1)
        return Attention(Linear(qkv.weight, bias), layer.attn.proj)


def rotary_periods(head_dim: int) -> np.ndarray:
    """Return the head_dim / 4 periods of a head, from 1 towards `PERIOD_BASE`."""
    return PERIOD_BASE ** (np.arange(head_dim // 4) * 4 / head_dim)


def rotary_angles(grid: Grid, head_dim: int) -> np.ndarray:
    """Compute the angles of each patch: first those of its row, then those of its column.

    An angle is 2 pi x / period, where x is the position of the patch's centre along a side of the
    image, which spans -1 to 1 whatever its length.

    Args:
        grid: rows and columns of patches.
        head_dim: width of an attention head.

    Returns:
        The angles in radians, of shape (patch, head_dim / 2); patches are in row order.

    Example:
        >>> rotary_angles((1, 2), 4).round(3).tolist()
        [[0.0, -3.142], [0.0, 3.142]]
    """
    periods = rotary_periods(head_dim)
    rows, columns = (
        2 * np.pi * ((2 * np.arange(side) + 1) / side - 1)[:, None] / periods for side in grid
    )
    shape = (*grid, len(periods))
    both = np.broadcast_to(rows[:, None], shape), np.broadcast_to(columns[None], shape)
    return np.concatenate(both, axis=-1).reshape(-1, 2 * len(periods))


@functools.cache
def _rotation(grid: Grid, head_dim: int) -> Rotation:
    """Compute cosines and sines in float64 on the host, as constants of the program."""
    angles = rotary_angles(grid, head_dim)
    return Rotation(np.cos(angles), np.sin(angles))
