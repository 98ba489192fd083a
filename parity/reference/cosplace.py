"""The head of CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023)."""

from torch import Tensor, nn

from parity.reference.gem import GeM, UnitPatches
from parity.reference.layers import Linear, at_least_float32


class CosPlace(nn.Sequential):
    """Unit patches, their generalised mean, and a linear layer; normalised later, in the model."""

    def __init__(self, dim: int, descriptor: int) -> None:
        """Make a head from `dim` channels to `descriptor` dimensions."""
        super().__init__(UnitPatches(), GeM(), nn.Identity(), Linear(dim, descriptor))

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to (batch, descriptor)."""
        unit, mean, _, fc = self
        return at_least_float32(fc(mean(unit(at_least_float32(patches))).to(patches.dtype)))
