"""Conv-AP, the baseline of GSV-Cities (Ali-bey et al., Neurocomputing 2022)."""

from torch import Tensor, nn

from parity.reference.layers import Conv2d, at_least_float32


class ConvAp(nn.Module):
    """A 1 x 1 convolution, then torch's adaptive average pooling."""

    def __init__(self, dim: int, channels: int, side: int) -> None:
        """Make a head from `dim` to `channels`, over side x side regions."""
        super().__init__()
        self.channel_pool = Conv2d(dim, channels, 1)
        self.means = nn.AdaptiveAvgPool2d(side)

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to (batch, region, channels)."""
        return self.means(at_least_float32(self.channel_pool(patches))).flatten(2).mT
