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
class LossConfig:
    """Which loss is taken, of which pairs, and the constants of each."""

    kind: Literal["multi-similarity", "contrastive", "triplet", "circle", "supcon", "fast-ap"] = (
        "multi-similarity"
    )
    """The paper's multi-similarity loss, or another that the field trains with."""
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

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice(self, "kind", "miner")
        require(self.epsilon >= 0, f"LossConfig.epsilon: found {self.epsilon}, expected at least 0")
        require(
            self.kind != "fast-ap" or self.miner == "none",
            f"LossConfig.miner: found {self.miner!r} with the loss 'fast-ap', expected 'none': it "
            "ranks all images",
        )
