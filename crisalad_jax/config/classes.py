"""Configure how a training set's images are grouped into classes, for classification losses."""

import dataclasses
from typing import Literal

from crisalad_jax.config.checks import PositiveFloat, PositiveInt, check_types, require
from crisalad_jax.config.short_repr import short_repr


@short_repr()
@dataclasses.dataclass(frozen=True)
class ClassesConfig:
    """How images form classes, and classes form groups that epochs train on in turn.

    The constants are CosPlace's (Berton et al., CVPR 2022); see docs/methods.md.

    Example:
        >>> ClassesConfig(kind="cells", cell=15.0).groups
        8
    """

    kind: Literal["places", "cells", "viewpoints"] = "places"
    """Kind of class: the training set's places, CosPlace's cells of position and heading, or
    EigenPlaces' cells of position with a focal point. The latter two need real positions."""
    groups: PositiveInt = 8
    """Number of groups to train on: those with the most classes. Viewpoints have this many lateral
    groups, and as many frontal ones."""
    steps: PositiveInt | None = None
    """Number of steps in an epoch; None takes as many as one pass over the largest group."""
    cell: PositiveFloat = 10.0
    """Side of a cell in metres, CosPlace's M; EigenPlaces' is 15."""
    sector: PositiveFloat = 30.0
    """Width of a sector of headings in degrees, CosPlace's alpha."""
    spacing: PositiveInt = 5
    """Distance in cells between neighbouring classes of a group, CosPlace's N; EigenPlaces' is 3.
    No two "places" of a group are marked as near or, in a set without marks, within N - 1 cells."""
    sector_spacing: PositiveInt = 2
    """Distance in sectors between neighbouring classes of a group, CosPlace's L."""
    focal_distance: PositiveFloat = 10.0
    """Metres from the mean of a cell's positions to its focal point, EigenPlaces' D."""
    view_angle: PositiveFloat = 45.0
    """Largest angle in degrees between an image's heading and the focal point of its class."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_types(self)
        turn = self.sector * self.sector_spacing
        require(
            360 % turn == 0,
            f"ClassesConfig.sector: found {self.sector_spacing} sectors of {self.sector:g} degrees,"
            " expected a divisor of 360 degrees: the last sector is next to the first",
        )
