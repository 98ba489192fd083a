"""The head of CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023)."""

import dataclasses
from typing import ClassVar

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require_positive
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.gem import START, generalised_mean, log_units
from crisalad_jax.nn.backbones.base import Backbone, Features
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, linear
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class CosPlace:
    """The exponent of the generalised mean, and the linear layer after it."""

    p: Float[Array, ""]
    fc: Linear


@AGGREGATORS.register("cosplace", tiny={"dim": 256})
@dataclasses.dataclass(frozen=True)
class CosPlaceConfig(Aggregator):
    """The head of CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023)."""

    width_field: ClassVar[str] = "dim"
    dim: int = 512
    """Width of the descriptor: CosPlace's 512, EigenPlaces' 2,048."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "dim")

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token."""
        return TokenShape(self.dim, 0, self.dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> CosPlace:
        """Draw parameters as the public code: an exponent of 3, torch's default linear layer."""
        return CosPlace(draw.full((), START), init_linear(key, backbone.dim, self.dim))

    def apply(
        self, params: CosPlace, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a linear layer of the generalised mean of unit patches.

        The descriptor is scaled to unit length later.
        """
        mean = generalised_mean(log_units(at_least_float32(features.patches)), params.p, axis=-2)
        return Tokens.of_global(
            at_least_float32(linear(params.fc, mean.astype(features.patches.dtype)))
        )
