"""TransVPR's global descriptor (Wang et al., CVPR 2022, section 3.2) from several ViT layers."""

import torch
from torch import nn

from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from parity.reference.layers import Linear, at_least_float32, l2_normalise
from parity.reference.tokens import Tokens
from parity.reference.vit import Features


class TransVpr(nn.Module):
    """One attention map per level, from the concatenated tokens of all levels."""

    def __init__(self, dim: int, config: TransVprConfig) -> None:
        """Make a head for levels of width `dim`."""
        super().__init__()
        self.dim = dim
        self.attention = Linear(config.levels * dim, config.levels, bias=False)
        self.reduction = Linear(config.levels * dim, config.dim)

    def forward(self, features: Features) -> Tokens:
        """Map features (batch, level x dim, rows, columns) to one global token, in float32."""
        tokens = features.patches.flatten(2).mT
        maps = at_least_float32(self.attention(tokens)).softmax(dim=1).mT
        levels = at_least_float32(tokens).split(self.dim, dim=2)
        pooled = torch.cat([maps[:, i : i + 1] @ level for i, level in enumerate(levels)], dim=2)
        descriptor = l2_normalise(self.reduction(l2_normalise(pooled[:, 0])))
        return Tokens(descriptor, descriptor.new_zeros(len(descriptor), 0, descriptor.shape[1]))
