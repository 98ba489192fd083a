"""Adapters parallel to a block's MLP: the paper's (section 3.2), and the two others of its Table 2.

Parameter names are CricaVPR's; for the other two adapters they follow the same pattern.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.nn.backbones.vit import ViTConfig
from parity.reference.layers import BatchNorm2d, Conv2d, Linear

BATCH_NORM_EPSILON = 1e-3


class MlpAdapter(nn.Module):
    """Down, ReLU, up, without mixing neighbours. The up-projection starts at 0."""

    def __init__(self, dim: int, width: int, *, bias: bool = True) -> None:
        """Make an adapter for tokens of `dim` with a bottleneck of `width`."""
        super().__init__()
        self.D_fc1 = Linear(dim, width, bias=bias)
        self.D_fc2 = Linear(width, dim, bias=bias)
        for parameter in self.D_fc2.parameters():
            nn.init.zeros_(parameter)

    def forward(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Map (batch, token, dim) to the same shape; the last rows x columns tokens are patches."""
        hidden = F.relu(self.D_fc1(tokens))
        return self.D_fc2(self.mix(hidden, grid))

    def mix(self, hidden: Tensor, grid: tuple[int, int]) -> Tensor:
        """Mix tokens at the bottleneck: the identity here."""
        return hidden


def over_grid(
    convolve: Callable[[Tensor], Tensor], hidden: Tensor, grid: tuple[int, int]
) -> Tensor:
    """Apply convolutions to the grid of patches and add a skip, for (batch, token, width).

    Special tokens (class and registers) pass the convolutions unchanged: with the skip they count
    twice, as in CricaVPR.
    """
    special, patches = hidden.tensor_split([hidden.shape[1] - grid[0] * grid[1]], dim=1)
    mixed = convolve(patches.mT.unflatten(-1, grid)).flatten(2).mT
    return hidden + torch.cat([special, mixed], dim=1)


class DepthwiseAdapter(MlpAdapter):
    """The paper's depthwise-separable convolution; its first linear layer has no bias."""

    def __init__(self, dim: int, width: int, kernel_size: int, *, bias: bool = True) -> None:
        """Make an adapter whose depthwise filters are `kernel_size` x `kernel_size`.

        Either the convolutions or the last linear layer have biases.
        """
        super().__init__(dim, width, bias=False)
        if not bias:
            self.D_fc2 = Linear(width, dim)
            nn.init.zeros_(self.D_fc2.weight)
            nn.init.zeros_(self.D_fc2.bias)
        side = kernel_size
        self.depthwise = Conv2d(width, width, side, padding="same", groups=width, bias=bias)
        self.pointwise = Conv2d(width, width, 1, bias=bias)

    def mix(self, hidden: Tensor, grid: tuple[int, int]) -> Tensor:
        """Map (batch, token, width) to the same shape."""
        return over_grid(self.convolve, hidden, grid)

    def convolve(self, x: Tensor) -> Tensor:
        """Map (batch, width, rows, columns) to the same shape."""
        # No activation between the two convolutions, as in Xception.
        return F.relu(self.pointwise(self.depthwise(x)))


class ConvNorm(nn.Module):
    """A convolution, batch norm and ReLU."""

    def __init__(self, d_in: int, d_out: int, kernel_size: int) -> None:
        """Make a convolution whose padding preserves the grid."""
        super().__init__()
        self.conv = Conv2d(d_in, d_out, kernel_size, padding="same")
        self.bn = BatchNorm2d(d_out, eps=BATCH_NORM_EPSILON)

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, d_in, rows, columns) to (batch, d_out, rows, columns)."""
        return F.relu(self.bn(self.conv(x)))


class MultiResolutionAdapter(MlpAdapter):
    """CricaVPR's parallel 1 x 1, 3 x 3 and 5 x 5 convolutions, the last two with a bottleneck."""

    def __init__(self, dim: int, width: int) -> None:
        """Make branches with 1/2, 1/4 and 1/4 of `width` output channels."""
        super().__init__(dim, width)
        narrow, quarter = width // 16, width // 4
        self.branch1 = ConvNorm(width, width // 2, 1)
        self.branch2 = nn.Sequential(ConvNorm(width, narrow, 1), ConvNorm(narrow, quarter, 3))
        self.branch3 = nn.Sequential(ConvNorm(width, narrow, 1), ConvNorm(narrow, quarter, 5))

    def mix(self, hidden: Tensor, grid: tuple[int, int]) -> Tensor:
        """Map (batch, token, width) to the same shape."""
        return over_grid(self.convolve, hidden, grid)

    def convolve(self, x: Tensor) -> Tensor:
        """Map (batch, width, rows, columns) to the same shape, concatenating the branches."""
        return torch.cat([self.branch1(x), self.branch2(x), self.branch3(x)], dim=1)


def make_adapter(config: ViTConfig) -> MlpAdapter | None:
    """Make the adapter of `config.adapter.part_name`; return None for "none"."""
    dim, width = config.dim, int(config.dim * getattr(config.adapter, "bottleneck", 0))
    if config.adapter.part_name == "depthwise":
        bias = config.adapter.bias == "convolutions"
        return DepthwiseAdapter(dim, width, config.adapter.kernel_size, bias=bias)
    if config.adapter.part_name == "multi-resolution":
        return MultiResolutionAdapter(dim, width)
    return MlpAdapter(dim, width) if config.adapter.part_name == "mlp" else None
