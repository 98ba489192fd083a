"""MixVPR: networks that mix all positions of a feature map (Ali-bey et al., WACV 2023)."""

from torch import Tensor, nn

from parity.reference.layers import LayerNorm, Linear, at_least_float32


class FeatureMixer(nn.Module):
    """Layer norm and a network with one hidden layer, over all positions of a channel."""

    def __init__(self, positions: int) -> None:
        """Make a network with constant width and zero biases."""
        super().__init__()
        self.mix = nn.Sequential(
            LayerNorm(positions),
            Linear(positions, positions),
            nn.ReLU(),
            Linear(positions, positions),
        )
        for layer in (self.mix[1], self.mix[3]):
            nn.init.trunc_normal_(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)

    def forward(self, maps: Tensor) -> Tensor:
        """Map (batch, channel, position) to the same shape."""
        return maps + self.mix(maps)


class MixVpr(nn.Module):
    """Mixers, then a reduction of channels, then of rows."""

    def __init__(self, dim: int, positions: int, channels: int, rows: int, depth: int) -> None:
        """Make a head for feature maps of `dim` channels and `positions` positions."""
        super().__init__()
        self.mix = nn.Sequential(*(FeatureMixer(positions) for _ in range(depth)))
        self.channel_proj = Linear(dim, channels)
        self.row_proj = Linear(positions, rows)

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to (batch, row, channel)."""
        maps = self.mix(patches.flatten(2))
        return at_least_float32(self.row_proj(self.channel_proj(maps.mT).mT)).mT
