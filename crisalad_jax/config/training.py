"""How images are changed, and how a model is trained."""

import dataclasses
import re
from typing import Literal

from crisalad_jax.config.checks import (
    choose,
    require,
    require_choice,
    require_fraction,
    require_positive,
)
from crisalad_jax.config.losses import LossConfig
from crisalad_jax.config.model import ModelConfig


@dataclasses.dataclass(frozen=True)
class RandAugmentConfig:
    """RandAugment (Cubuk et al. 2020), torchvision's 14 operations, GSV-Cities' strength."""

    operations: int = 3
    magnitude: int = 9
    """Which of 31 bins of strength."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require(
            self.operations >= 0,
            f"RandAugmentConfig.operations: found {self.operations}, expected at least 0",
        )
        require(
            0 <= self.magnitude < 31,
            f"RandAugmentConfig.magnitude: found {self.magnitude}, expected 0 to 30",
        )


@dataclasses.dataclass(frozen=True)
class LightAugmentConfig:
    """One small warp and mild changes of light, for training from scratch on fixed cameras."""

    crop: float = 0.1
    """Largest share of the side that a crop removes."""
    shift: float = 0.05
    """Largest shift, as a share of the side."""
    rotation: float = 2.0
    """Largest rotation in degrees."""
    flip: float = 0.0
    """Probability of a mirror image. All images of one place in a batch are mirrored alike."""
    blur: float = 1.0
    """Largest standard deviation of a Gaussian blur, in pixels."""
    colour: float = 0.2
    """Largest relative change of brightness, of contrast and of saturation."""
    grey: float = 0.2
    """Probability of dropping the colour."""
    gamma: float = 0.0
    """Largest change of the logarithm of an exponent on intensities."""
    illumination: float = 0.0
    """Largest change of log brightness in a smooth field over the image: uneven light."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_fraction(self, "crop", "shift", "colour")
        for name in ("rotation", "blur", "gamma", "illumination"):
            value = getattr(self, name)
            require(value >= 0, f"LightAugmentConfig.{name}: found {value}, expected at least 0")
        for name in ("flip", "grey"):
            value = getattr(self, name)
            require(
                0 <= value <= 1,
                f"LightAugmentConfig.{name}: found {value}, expected a probability from 0 to 1",
            )


AugmentConfig = RandAugmentConfig | LightAugmentConfig


@dataclasses.dataclass(frozen=True)
class OptimiserConfig:
    """AdamW or Adam with an optional warm-up and a learning rate that falls."""

    kind: Literal["adamw", "adam"] = "adamw"
    """In Adam the weight decay is part of the gradient."""
    learning_rate: float = 6e-5
    schedule: Literal["linear", "step"] = "linear"
    """Linear decay step by step, or one step down every few epochs."""
    final_fraction: float = 0.0
    """Share of the learning rate that is left at the end of a linear decay."""
    decay_steps: int | None = None
    """Length of a linear decay, after which the learning rate stays; None is the whole run."""
    drop_epochs: int = 3
    """Epochs from one step down to the next (CricaVPR's)."""
    drop_factor: float = 0.5
    """What a step down multiplies the learning rate by (CricaVPR's)."""
    warmup_steps: int = 0
    weight_decay: float = 0.01
    """Torch's default for AdamW; the paper names none."""
    b1: float = 0.9
    b2: float = 0.999
    clip_norm: float | None = None
    """Largest norm of the whole gradient."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice(self, "kind", "schedule")
        require_positive(self, "learning_rate", "drop_epochs", "drop_factor")
        if self.decay_steps is not None:
            require(
                self.decay_steps > 0,
                f"OptimiserConfig.decay_steps: found {self.decay_steps}, expected more than 0, or "
                "None",
            )
        for name in ("final_fraction", "warmup_steps", "weight_decay"):
            value = getattr(self, name)
            require(value >= 0, f"OptimiserConfig.{name}: found {value}, expected at least 0")
        require_fraction(self, "b1", "b2")
        if self.clip_norm is not None:
            require_positive(self, "clip_norm")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole training run, apart from where its files lie."""

    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    optimiser: OptimiserConfig = OptimiserConfig()
    trains: str = "adapters+head"
    """What is not frozen: adapters+head (the paper), last-N-blocks+head (SALAD), head, or all."""
    augment: Literal["rand-augment", "light", "none"] = "rand-augment"
    rand_augment: RandAugmentConfig = RandAugmentConfig()
    light_augment: LightAugmentConfig = LightAugmentConfig()
    places_per_batch: int = 48
    """Where the loss classifies: so many classes a batch."""
    images_per_place: int = 4
    micro_batch: int | None = None
    """So many images' activations are in memory at a time: a step takes less of it and a forward
    pass longer, and is the same. None is the whole batch."""
    min_images: int = 4
    """Places, or classes, with fewer images are left out."""
    batch_order: Literal["within-city", "shuffled"] = "within-city"
    """A batch of one city's places (hard negatives; the public loaders) or of all cities'."""
    cities: tuple[str, ...] | None = None
    """Which cities; None takes all."""
    epochs: int = 8
    """The paper converged within five, and stopped after three without gain."""
    validate_every: int = 1
    """Epochs from one validation to the next."""
    patience: int | None = 3
    """Validations without a better Recall@5 after which training stops; None never stops early."""
    keep_best: int = 1
    """So many validations' weights are kept, those of the best Recall@5."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        choose("TrainConfig.augment", self.augment, {"rand-augment": 0, "light": 0, "none": 0})
        choose("TrainConfig.batch_order", self.batch_order, {"within-city": 0, "shuffled": 0})
        require_positive(self, "places_per_batch", "epochs", "validate_every", "keep_best")
        require_positive(self, "images_per_place")
        require(
            self.images_per_place >= 2 or self.loss.classifies,
            f"TrainConfig.images_per_place: found {self.images_per_place}, expected at least 2: "
            "the loss needs pairs of one place",
        )
        batch = self.places_per_batch * self.images_per_place
        require(
            self.micro_batch is None or (self.micro_batch > 0 and batch % self.micro_batch == 0),
            f"TrainConfig.micro_batch: found {self.micro_batch}, expected a divisor of the batch's "
            f"{batch} images, or None",
        )
        require(
            self.min_images >= self.images_per_place,
            f"TrainConfig.min_images: found {self.min_images}, expected at least images_per_place "
            f"({self.images_per_place})",
        )
        require(
            re.fullmatch(r"head|adapters\+head|last-\d+-blocks\+head|all", self.trains) is not None,
            f"TrainConfig.trains: found {self.trains!r}, expected head, adapters+head, "
            "last-N-blocks+head or all",
        )
        require(
            self.trains != "adapters+head" or self.model.backbone.adapter.kind != "none",
            "TrainConfig.trains: found adapters+head for a model without adapters, expected head, "
            "last-N-blocks+head or all",
        )
        require(
            self.patience is None or self.patience > 0,
            f"TrainConfig.patience: found {self.patience}, expected more than 0, or None",
        )
        require(self.seed >= 0, f"TrainConfig.seed: found {self.seed}, expected at least 0")

    @property
    def min_images_of_place(self) -> int:
        """Places with fewer images are not read: all are, where images are regrouped to classes."""
        regroups = self.loss.classifies and self.loss.large_margin_cosine.classes != "places"
        return 1 if regroups else self.min_images

    @property
    def augmentation(self) -> AugmentConfig | None:
        """The configuration of the augmentation that `augment` names."""
        return {
            "rand-augment": self.rand_augment,
            "light": self.light_augment,
            "none": None,
        }[self.augment]
