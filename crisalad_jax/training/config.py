"""Configuration of a training run."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from crisalad_jax.config.checks import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Seed,
    check_types,
    require,
    require_field,
    require_range,
)
from crisalad_jax.config.part import OrName
from crisalad_jax.config.registry import part_field, resolve_names
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.data.augmentations import AUGMENTATIONS, Augmentation
from crisalad_jax.data.samplers import SAMPLERS, Sampler
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.optimisers import OPTIMISERS, Optimiser
from crisalad_jax.training.schedules import SCHEDULES, LinearSchedule, Schedule
from crisalad_jax.training.trainable import ADAPTERS, ADAPTERS_AND_HEAD, terms_of
from crisalad_jax.utils.errors import locate_errors


@short_repr()
@dataclasses.dataclass(frozen=True)
class OptimiserConfig:
    """An optimiser, its learning-rate schedule, and an optional warm-up.

    Example:
        >>> OptimiserConfig(kind="sgd", schedule="cosine", learning_rate=1e-3, warmup_steps=100)
        OptimiserConfig(kind='sgd', learning_rate=0.001, schedule='cosine', warmup_steps=100)
    """

    kind: OrName[Optimiser] = part_field(OPTIMISERS, "adamw")
    """A registered optimiser or its name, or the dotted name of one in optax, such as
    optax.contrib.muon."""
    learning_rate: PositiveFloat = 6e-5
    """Peak learning rate: after the warm-up, before the decay."""
    schedule: OrName[Schedule] = part_field(SCHEDULES, "linear")
    """How the learning rate changes after the warm-up; a registered schedule, or its name."""
    warmup_steps: NonNegativeInt = 0
    """Steps of a linear warm-up, which ends at the learning rate."""
    warmup_epochs: NonNegativeInt = 0
    """Epochs of warm-up, instead of `warmup_steps`."""
    weight_decay: NonNegativeFloat = 0.01
    """Weight decay; the default is torch's for AdamW, as the paper states no value. With optimisers
    that have none of their own, it is added to the gradient, as in torch's Adam and SGD."""
    clip_norm: PositiveFloat | None = None
    """Maximum norm of the whole gradient, which is scaled down if larger; None is no limit."""
    clip_value: PositiveFloat | None = None
    """Maximum absolute value of a gradient element, after `clip_norm`; None is no limit."""
    accumulate: PositiveInt = 1
    """Number of batches whose gradients are averaged for one optimiser step. `warmup_steps` counts
    these steps. As in Lightning, an epoch always ends with a step; if fewer batches are left for
    it, their summed gradient is still divided by this number."""
    ema: Fraction | None = None
    """Decay of an exponential moving average of the weights per optimiser step, such as 0.999;
    validation and saved weights use the average. None turns it off."""

    def __post_init__(self) -> None:
        """Check the ranges of the fields."""
        resolve_names(self)
        one, steps = not (self.warmup_steps and self.warmup_epochs), self.warmup_steps
        require_field(self, "warmup_epochs", one, f"0 with warmup_steps {steps}")


@short_repr(switch=("kind", "none"))
@dataclasses.dataclass(frozen=True)
class MiningConfig:
    """Mining of tuples: a query, its nearest positive and its hardest negatives.

    An epoch consists of rounds. Each round describes images with the current model, then trains on
    one tuple per query. Positives and negatives are database images, chosen by position, or by
    ground truth if the set has no positions.

    Example:
        >>> MiningConfig(kind="whole", negatives=5).candidates
        1000
    """

    kind: Literal["none", "whole", "sample"] = "none"
    """Database images that a round describes: "none", to train on places without mining; the
    "whole" database, where each query draws candidates and reuses its last negatives (NetVLAD); or
    a "sample" of candidates for all queries of the round, and their positives (MSLS)."""
    negatives: PositiveInt = 10
    """Number of negatives per tuple: the candidates nearest to the query by descriptor."""
    candidates: PositiveInt = 1000
    """Number of database images drawn as candidate negatives."""
    queries_per_round: PositiveInt = 1000
    """Maximum queries per round; an epoch is divided into rounds of equal size."""
    queries_per_epoch: PositiveInt | None = None
    """Queries per epoch, sampled for each round; None takes every query at most once."""
    positive_radius: float = 10.0
    """Distance in metres within which a database image is a positive of a query."""
    negative_radius: float = 25.0
    """Distance in metres within which a database image is not a negative of a query."""
    margin: PositiveFloat | None = None
    """Use only negatives whose descriptor distance exceeds the positive's by less than this; None
    always takes the hardest."""

    def __post_init__(self) -> None:
        """Check the ranges of the fields."""
        check_types(self)
        require_range(self, self.negatives, math.inf, "candidates")
        fits = 0 < self.positive_radius <= self.negative_radius < math.inf
        most = f"negative_radius ({self.negative_radius})"
        require_field(self, "positive_radius", fits, f"metres above 0, and at most {most}")


@short_repr("name")
@dataclasses.dataclass(frozen=True)
class MixtureSet:
    """One training set of a mixture, of which each step takes a sub-batch.

    Example:
        >>> MixtureSet("msls", sampler="cliques", weight=0.5)
        MixtureSet(name='msls', sampler='cliques', weight=0.5)
    """

    name: str
    """Name of the set, by which its data is passed and its loss is logged: letters, digits and
    underscores."""
    sampler: OrName[Sampler] = part_field(SAMPLERS, "within-city")
    """Which of its places make a sub-batch; a registered sampler, or its name."""
    loss: LossConfig = LossConfig()
    """Loss of the sub-batch, over its own pairs only."""
    share: PositiveInt = 1
    """Share of the batch's places, relative to the other sets."""
    weight: PositiveFloat = 1.0
    """Weight of the set's loss in the sum of all losses."""

    def __post_init__(self) -> None:
        """Check the ranges of the fields."""
        resolve_names(self)
        is_name = self.name.isidentifier() and self.name.isascii()
        require_field(self, "name", is_name, "letters, digits and underscores")


@short_repr("model", "loss")
@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Configuration of a training run, except for the paths of its files.

    Example:
        >>> from crisalad_jax import PRESETS
        >>> TrainConfig(model=PRESETS["tiny"], trainable="all", epochs=2).images_per_place
        4
    """

    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    optimiser: OptimiserConfig = OptimiserConfig(
        schedule=LinearSchedule(end_fraction=0.2, decay_steps=4000)
    )
    """By default the paper's AdamW; the rate falls by 80 % in 4,000 steps "as adopted in SALAD"."""
    trainable: str = ADAPTERS_AND_HEAD
    """What trains, comma-separated: adapters,head (the paper); last-N-blocks,norm,head (SALAD);
    all; or patterns of names, as in adapters,head,backbone.blocks.1[01]. A leading - freezes a word
    or pattern, as in head,-adapters; see `split_params`."""
    batch_norm: Literal["batch", "stored"] = "batch"
    """Statistics of the backbone's batch norms. "batch" normalises by those of the batch and
    updates the running ones (torch's `train()`, in frozen layers too). "stored" normalises by the
    running ones without updating them (`eval()`)."""
    augmentation: OrName[Augmentation] = part_field(AUGMENTATIONS, "rand-augment")
    """How training images are changed; a registered augmentation, or its name."""
    places_per_batch: PositiveInt = 48
    """Number of places in a batch, or of classes if the loss classifies."""
    images_per_place: PositiveInt = 4
    """Number of images of each place or class."""
    micro_batch: int | None = None
    """Number of images that pass through the backbone at a time: a step takes less memory and more
    time, with the same result. On a CPU a convolutional backbone takes ten times as long or more:
    XLA's loops have no fast convolutions. None is the whole batch. With "batch" statistics, batch
    norms use those of each micro-batch, as in several forward passes of torch."""
    min_images: int = 4
    """Minimum number of images of a place or class; those with fewer are left out."""
    mining: MiningConfig = MiningConfig()
    """Mining of tuples from a set of queries, instead of places. A batch is then `places_per_batch`
    tuples, each of `images_per_place` images: a query, a positive, and the negatives."""
    sampler: OrName[Sampler] = part_field(SAMPLERS, "within-city")
    """Which places make a batch; a registered sampler, or its name."""
    mixture: tuple[MixtureSet, ...] = ()
    """Several training sets, instead of one with `sampler` and `loss`. Each step takes a sub-batch
    of each, computes its loss separately, and adds the losses. Images attend only within their
    sub-batch. The first set determines the length of an epoch."""
    cities: tuple[str, ...] | None = None
    """Cities of the training set to use; None uses all."""
    epochs: PositiveInt = 8
    """Passes over the training set; a larger number extends an existing run. The paper's training
    converged within five, and stopped after three without gain."""
    validate_every: PositiveInt = 1
    """Number of epochs from one validation to the next."""
    validation_size: tuple[int, int] | None = None
    """Height and width that validations resize to; None is the model's. The saved model does not
    change."""
    monitor: Literal["R@1", "R@5", "R@1+R@5"] = "R@5"
    """Validation recall that selects the best weights."""
    patience: PositiveInt | None = 3
    """Number of validations without a better recall after which training stops; None for never."""
    save_top_k: PositiveInt = 1
    """Number of best validations, by recall, whose weights are saved."""
    seed: Seed = 0
    """Seed of weights, batches and augmentations."""

    def __post_init__(self) -> None:
        """Check the ranges of the fields."""
        resolve_names(self)
        self._check_mixture()
        loss, images, accumulate = self.loss.kind, self.images_per_place, self.optimiser.accumulate
        batch, size = self.places_per_batch * images, 2 + self.mining.negatives
        is_tuple = images == size or not self.mines
        micro_batch = batch if self.micro_batch is None else self.micro_batch
        divides = micro_batch > 0 and batch % micro_batch == 0
        classifies, terms = loss.grouping is not None, terms_of(self.trainable)
        alone = classifies or loss.reads_targets
        adapts = ADAPTERS not in terms or has_adapters(self.model)
        draws_places = not (self.sampler.describes or self.sampler.regroups)
        classified = f"for loss {loss.part_name}, which classifies"
        taught = f"for loss {loss.part_name}, which learns from a teacher"
        tuples = f"'whole' or 'sample' for loss {loss.part_name}, which takes mined tuples"
        for config, name, fits, expected in (
            (self, "images_per_place", images >= 2 or alone, "at least 2: losses need pairs"),
            (self, "micro_batch", divides, f"a divisor of the batch's {batch} images, or None"),
            (self.optimiser, "accumulate", accumulate == 1 or not classifies, f"1 {classified}"),
            (self.mining, "kind", not (classifies and self.mines), f"'none' {classified}"),
            (self.mining, "kind", self.mines or not loss.of_tuples, tuples),
            (self.mining, "kind", not (loss.reads_targets and self.mines), f"'none' {taught}"),
            (self, "sampler", draws_places or not classifies, f"another {classified}"),
            (self, "images_per_place", is_tuple, f"{size} with mined tuples"),
            (self, "min_images", self.min_images >= images or self.mines, f"at least {images}"),
            (self, "trainable", all(terms), "words and patterns with commas between them"),
            (self, "trainable", adapts, "head, all or last-N-blocks,norm,head without adapters"),
        ):
            require_field(config, name, fits, expected)
        if self.validation_size is not None:
            self.model.check_image_size(self.validation_size)

    def _check_mixture(self) -> None:
        """Check each set of the mixture as a separate run, and what the sets share."""
        names = [each.name for each in self.mixture]
        require(
            len(set(names)) == len(names),
            f"TrainConfig.mixture: found {', '.join(names)}, expected each name once",
        )
        if not names:
            return
        shares = sum(each.share for each in self.mixture)
        of_set = f"the default: each set of a mixture has its own (mixture.{names[0]}"
        default = self.sampler == DEFAULT_SAMPLER
        divides = self.places_per_batch % shares == 0
        for config, name, fits, expected in (
            (self, "sampler", default, f"{DEFAULT_SAMPLER.part_name}, {of_set}.sampler)"),
            (self, "loss", self.loss == LossConfig(), f"{LossConfig()}, {of_set}.loss)"),
            (self, "places_per_batch", divides, f"a multiple of {shares}, the sum of the shares"),
            (self, "cities", self.cities is None, "None with a mixture"),
            (self.mining, "kind", not self.mines, "'none' for a mixture"),
        ):
            require_field(config, name, fits, expected)
        for each, alone in zip(self.mixture, self.alone, strict=True):
            kind = alone.loss.kind
            fits = not (kind.grouping or kind.reads_tokens or kind.reads_targets)
            with locate_errors(f"mixture.{each.name}: "):
                require_field(alone.loss, "kind", fits, "a loss of pairs of descriptors")

    @property
    def alone(self) -> tuple["TrainConfig", ...]:
        """Each set of the mixture as a separate run; without a mixture, the run itself."""
        shares = sum(each.share for each in self.mixture)
        found = []
        for number, each in enumerate(self.mixture):
            # Two sets of the same places draw different batches.
            words = np.random.SeedSequence(self.seed, spawn_key=(number,)).generate_state(1)
            with locate_errors(f"mixture.{each.name}: "):
                one = dataclasses.replace(
                    self,
                    mixture=(),
                    sampler=each.sampler,
                    loss=each.loss,
                    places_per_batch=self.places_per_batch * each.share // shares,
                    micro_batch=None,
                    seed=int(words[0]) if number else self.seed,
                )
            found.append(one)
        return tuple(found) or (self,)

    def with_each(self, **changes: Callable[[Any], Any]) -> "TrainConfig":
        """Apply functions, by field (sampler, loss), to the run or, for a mixture, to each set."""

        def changed(each: Any) -> Any:
            values = {name: change(getattr(each, name)) for name, change in changes.items()}
            return dataclasses.replace(each, **values)

        if not self.mixture:
            return changed(self)
        return dataclasses.replace(self, mixture=tuple(map(changed, self.mixture)))

    @property
    def mines(self) -> bool:
        """Whether the run trains on mined tuples instead of places."""
        return self.mining.kind != "none"

    @property
    def min_images_of_place(self) -> int:
        """Minimum number of images of a place in the training set; 1 if images are regrouped."""
        grouping = self.loss.kind.grouping
        to_classes = grouping is not None and grouping.kind != "places"
        return 1 if to_classes or self.sampler.regroups else self.min_images


DEFAULT_SAMPLER = SAMPLERS.make("within-city")


def has_adapters(model: ModelConfig) -> bool:
    """Return whether a model's backbone has adapters, or other parts that it marks as trainable."""
    return bool(model.backbone.trains)
