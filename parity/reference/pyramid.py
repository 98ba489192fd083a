"""CricaVPR's pyramid of generalised means (Lu et al., CVPR 2024; GeM: Radenovic et al. 2018)."""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.config import PYRAMID_LEVELS

GEM_FLOOR = 1e-6


class UnitPatches(nn.Module):
    """Every patch to length 1, over its channels."""

    def forward(self, patches: Tensor) -> Tensor:
        """(batch, dim, rows, columns) to the same."""
        return F.normalize(patches, dim=1)


class GemPyramid(nn.Module):
    """Generalised means over 2 x 2 and 3 x 3 regions, one exponent for all."""

    def __init__(self) -> None:
        """The exponent starts at 3."""
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, patches: Tensor) -> Tensor:
        """(batch, dim, rows, columns) to (batch, region, dim), level by level in row order."""
        return torch.stack([self.mean(region) for region in _regions(patches)], dim=1)

    def mean(self, region: Tensor) -> Tensor:
        """(batch, dim, rows, columns) to (batch, dim)."""
        powers = region.clamp(min=GEM_FLOOR).pow(self.p)
        return powers.mean(dim=(2, 3)).pow(1 / self.p)


def _regions(patches: Tensor) -> list[Tensor]:
    rows, columns = patches.shape[2:]
    return [
        patches[:, :, top:bottom, left:right]
        for level in PYRAMID_LEVELS
        for top, bottom in _cuts(rows, level)
        for left, right in _cuts(columns, level)
    ]


def _cuts(side: int, level: int) -> list[tuple[int, int]]:
    """From where to where each part goes: 16 patches in 3 parts are cut at 5 and 11."""
    return list(itertools.pairwise(round(i * side / level) for i in range(level + 1)))
