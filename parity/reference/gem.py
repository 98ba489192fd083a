"""Generalised mean of all patches (GeM; Radenovic et al., TPAMI 2018)."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

GEM_FLOOR = 1e-6


class UnitPatches(nn.Module):
    """Normalisation of every patch to length 1 over its channels."""

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to the same shape."""
        return F.normalize(patches, dim=1)


class GeM(nn.Module):
    """The root of the mean of powers, with one exponent for all channels."""

    def __init__(self) -> None:
        """Initialise the exponent to 3."""
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to (batch, dim)."""
        powers = patches.clamp(min=GEM_FLOOR).pow(self.p)
        return powers.mean(dim=(2, 3)).pow(1 / self.p)
