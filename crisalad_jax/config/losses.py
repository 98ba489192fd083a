"""Losses and their miner."""

import dataclasses
from typing import Literal

from crisalad_jax.config.checks import (
    require,
    require_choice,
    require_fraction,
    require_positive,
)


@dataclasses.dataclass(frozen=True)
class MultiSimilarityConfig:
    """Multi-similarity loss (Wang et al., CVPR 2019), the constants of GSV-Cities."""

    alpha: float = 1.0
    beta: float = 50.0
    base: float = 0.0
    """Similarity around which pairs are weighed. From a cold start 0.5 learns where 0 does not."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "alpha", "beta")


@dataclasses.dataclass(frozen=True)
class ContrastiveConfig:
    """Contrastive loss (Hadsell et al., CVPR 2006), the margins of GSV-Cities."""

    positive_margin: float = 0.0
    """Distance up to which a pair of one place costs nothing; unit vectors are at most 2 apart."""
    negative_margin: float = 1.0
    """Distance from which a pair of two places costs nothing."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("positive_margin", "negative_margin"):
            value = getattr(self, name)
            require(0 <= value <= 2, f"ContrastiveConfig.{name}: found {value}, expected 0 to 2")


@dataclasses.dataclass(frozen=True)
class TripletConfig:
    """Triplet margin loss (Schroff et al., CVPR 2015), the margin of GSV-Cities."""

    margin: float = 0.1
    """By how much a positive's distance must be smaller than a negative's."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "margin")


@dataclasses.dataclass(frozen=True)
class CircleConfig:
    """Circle loss (Sun et al., CVPR 2020), the constants of GSV-Cities."""

    margin: float = 0.4
    """The paper's m."""
    scale: float = 80.0
    """The paper's gamma."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "scale")
        require_fraction(self, "margin")


@dataclasses.dataclass(frozen=True)
class SupConConfig:
    """Supervised contrastive loss (Khosla et al., NeurIPS 2020), GSV-Cities' temperature."""

    temperature: float = 0.07

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "temperature")


@dataclasses.dataclass(frozen=True)
class FastAPConfig:
    """FastAP (Cakir et al., CVPR 2019), GSV-Cities' number of bins."""

    bins: int = 30
    """Of the histogram of squared distances, from 0 to 4."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "bins")


@dataclasses.dataclass(frozen=True)
class LargeMarginCosineConfig:
    """Large-margin cosine loss (CosFace, Wang et al., CVPR 2018) over groups of classes.

    The constants are CosPlace's (Berton et al., CVPR 2022); see docs/methods.md.
    """

    scale: float = 30.0
    """What cosines are multiplied by; EigenPlaces' is 100."""
    margin: float = 0.4
    """What is taken from the cosine of an image's own class."""
    learning_rate: float = 0.01
    """Of the classifiers, which train by an Adam of their own, without decay."""
    classes: Literal["places", "cells", "viewpoints"] = "places"
    """The training set's own places; CosPlace's cells of position and heading; or EigenPlaces'
    cells of position, looking at a focal point. The latter two ask for real positions."""
    groups: int = 8
    """Epochs train so many groups in turn, those with the most classes; of viewpoints so many
    lateral and so many frontal ones."""
    steps: int | None = None
    """Steps of an epoch; None passes once over the largest group."""
    cell: float = 10.0
    """Side of a cell in metres, CosPlace's M; EigenPlaces' is 15."""
    sector: float = 30.0
    """Width of a sector of headings in degrees, CosPlace's alpha."""
    spacing: int = 5
    """Every so-many-th cell is of one group, CosPlace's N; EigenPlaces' is 3. Places of one group
    are as far apart."""
    sector_spacing: int = 2
    """Every so-many-th sector is of one group, CosPlace's L."""
    focal_distance: float = 10.0
    """Metres from the mean of a cell's positions to its focal point, EigenPlaces' D."""
    view_angle: float = 45.0
    """An image is of a viewpoint's class if it looks within so many degrees of the focal point."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice(self, "classes")
        require_positive(
            self,
            *("scale", "learning_rate", "groups", "cell", "sector", "spacing", "sector_spacing"),
            *("focal_distance", "view_angle"),
        )
        require_fraction(self, "margin")
        if self.steps is not None:
            require(
                self.steps > 0,
                f"LargeMarginCosineConfig.steps: found {self.steps}, expected more than 0, or None",
            )
        turn = self.sector * self.sector_spacing
        require(
            360 % turn == 0,
            f"LargeMarginCosineConfig.sector: found {self.sector_spacing} sectors of "
            f"{self.sector:g} degrees, expected a divisor of 360 degrees: the last sector lies "
            "beside the first",
        )


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Which loss is taken, of which pairs, and the constants of each."""

    kind: Literal[
        "multi-similarity",
        "contrastive",
        "triplet",
        "circle",
        "supcon",
        "fast-ap",
        "large-margin-cosine",
    ] = "multi-similarity"
    """The paper's multi-similarity loss, or another that the field trains with. The last is of
    images and classes; the others are of pairs of images."""
    miner: Literal["multi-similarity", "none"] = "multi-similarity"
    """Which pairs enter it: those that the multi-similarity loss's miner finds hard, or all."""
    epsilon: float = 0.1
    """Margin of the miner."""
    library_quirk: bool = False
    """Return 0, as pytorch-metric-learning does, where at most one positive and at most one
    negative pair enter in the whole batch (its triplet loss does not)."""
    multi_similarity: MultiSimilarityConfig = MultiSimilarityConfig()
    contrastive: ContrastiveConfig = ContrastiveConfig()
    triplet: TripletConfig = TripletConfig()
    circle: CircleConfig = CircleConfig()
    supcon: SupConConfig = SupConConfig()
    fast_ap: FastAPConfig = FastAPConfig()
    large_margin_cosine: LargeMarginCosineConfig = LargeMarginCosineConfig()

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice(self, "kind", "miner")
        require(self.epsilon >= 0, f"LossConfig.epsilon: found {self.epsilon}, expected at least 0")
        require(
            self.kind != "fast-ap" or self.miner == "none",
            f"LossConfig.miner: found {self.miner!r} with the loss 'fast-ap', expected 'none': it "
            "ranks all images",
        )

    @property
    def classifies(self) -> bool:
        """Whether it is of images and classes, which a classifier is trained for."""
        return self.kind == "large-margin-cosine"
