"""Project descriptors by a linear layer, such as MegaLoc's last layer or a stored whitening."""

import dataclasses

from jaxtyping import Array, Float

from crisalad_jax.config.checks import NonNegativeInt, check_types
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.nn.layers import Linear, l2_normalise, linear


@short_repr(switch=("dim", 0))
@dataclasses.dataclass(frozen=True)
class ProjectionConfig:
    """A linear layer with a bias over the unit descriptor, the last layer of a model.

    Example:
        >>> ProjectionConfig(dim=4096).renormalise
        True
    """

    dim: NonNegativeInt = 0
    """Width of the projected descriptor. 0 leaves the layer out."""
    renormalise: bool = True
    """Whether projected descriptors are normalised again."""

    def __post_init__(self) -> None:
        """Check the fields."""
        check_types(self)


def project(
    params: Linear, descriptors: Float[Array, "image descriptor"], config: ProjectionConfig
) -> Float[Array, "image projected"]:
    """Project descriptors, and normalise them if `config.renormalise` is set."""
    projected = linear(params, descriptors)
    return l2_normalise(projected) if config.renormalise else projected
