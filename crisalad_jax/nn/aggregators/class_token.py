"""The backbone's class token, by itself (Oquab et al. 2023)."""

import dataclasses

from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones.base import FeatureRequest, Features
from crisalad_jax.nn.layers import Keys, at_least_float32
from crisalad_jax.nn.tokens import Tokens


@AGGREGATORS.register("class-token")
@dataclasses.dataclass(frozen=True)
class ClassTokenConfig(Aggregator):
    """The backbone's class token, by itself (Oquab et al. 2023)."""

    def features(self, depth: int) -> FeatureRequest:
        """Request the class token."""
        return FeatureRequest(class_token=True)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)

    def apply(
        self, params: None, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return the class token as it is."""
        return Tokens.of_global(at_least_float32(features.class_token))
