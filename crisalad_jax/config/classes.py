"""Configure how a training set's images are grouped into classes, for losses that classify."""

import dataclasses
from typing import Literal

from crisalad_jax.config.checks import check_types, require, require_positive
from crisalad_jax.config.short_repr import short_repr


@short_repr()
@dataclasses.dataclass(frozen=True)
class ClassesConfig:
    """Classes of a training set, and the groups that epochs train in turn.

    The constants are CosPlace's (Berton et al., CVPR 2022); see docs/methods.md.

    Example:
        >>> ClassesConfig(kind="cells", cell=15.0).groups
        8
    """

    kind: Literal["places", "cells", "viewpoints"] = "places"
    """Kind of class: the training set's own places, CosPlace's cells of position and heading, or
    EigenPlaces' cells of position with a focal point. The latter two need real positions."""
    groups: int = 8
    """Number of groups, those with the most classes; for viewpoints, the number of lateral groups
    and again of frontal ones."""
    steps: int | None = None
    """Number of steps of an epoch; None passes once over the largest group."""
    cell: float = 10.0
    """Side of a cell in metres, CosPlace's M; EigenPlaces' is 15."""
    sector: float = 30.0
    """Width of a sector of headings in degrees, CosPlace's alpha."""
    spacing: int = 5
    """Distance in cells between neighbours of one group, CosPlace's N; EigenPlaces' is 3. Places of
    one group are as far apart."""
    sector_spacing: int = 2
    """Distance in sectors between neighbours of one group, CosPlace's L."""
    focal_distance: float = 10.0
    """Metres from the mean of a cell's positions to its focal point, EigenPlaces' D."""
    view_angle: float = 45.0
    """Largest angle in degrees between an image's heading and the focal point of its class."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_types(self)
        require_positive(self, "groups", "cell", "sector", "spacing", "sector_spacing")
        require_positive(self, "focal_distance", "view_angle")
        require_positive(self, "steps")
        turn = self.sector * self.sector_spacing
        require(
            360 % turn == 0,
            f"ClassesConfig.sector: found {self.sector_spacing} sectors of {self.sector:g} degrees,"
            " expected a divisor of 360 degrees: the last sector lies beside the first",
        )
