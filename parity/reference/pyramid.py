"""CricaVPR's pyramid of generalised means (Lu et al., CVPR 2024)."""

import itertools

import torch
from torch import Tensor

from crisalad_jax.nn.aggregators.gem import PYRAMID_LEVELS
from parity.reference.gem import GeM


class GemPyramid(GeM):
    """Generalised means over 2 x 2 and 3 x 3 regions, one exponent for all."""

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to (batch, region, dim), level by level in row order."""
        return torch.stack([super(GemPyramid, self).forward(r) for r in _regions(patches)], dim=1)


def _regions(patches: Tensor) -> list[Tensor]:
    rows, columns = patches.shape[2:]
    return [
        patches[:, :, top:bottom, left:right]
        for level in PYRAMID_LEVELS
        for top, bottom in _cuts(rows, level)
        for left, right in _cuts(columns, level)
    ]


def _cuts(side: int, level: int) -> list[tuple[int, int]]:
    """Return start and end of each part: 16 patches in 3 parts are cut at 5 and 11."""
    return list(itertools.pairwise(round(i * side / level) for i in range(level + 1)))
