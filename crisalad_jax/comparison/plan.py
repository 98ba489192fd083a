"""What a comparison is, and its parts made and checked before any work starts."""

import dataclasses
import pathlib
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import jax
import numpy as np

from crisalad_jax.checkpoint import load_weights
from crisalad_jax.comparison.ablation import ABLATIONS, Ablation
from crisalad_jax.comparison.methods import METHODS
from crisalad_jax.config import LossConfig, ModelConfig, TrainConfig, choose, from_scratch, recipe
from crisalad_jax.convert import read_backbone
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.errors import InputError
from crisalad_jax.fit import groups_of, steps_per_epoch
from crisalad_jax.groupings import check_grouping, parse_groupings
from crisalad_jax.nn.vit import init_vit
from crisalad_jax.reranking import parse_reranking
from crisalad_jax.training import trained_parameters

EPOCHS = 6
"""From nothing: all methods in less than an hour on two cores, three seeds, on two small sets."""
_WARMUP_SHARE = 5
"""A short run warms up for a fifth of its steps at most."""
_VIEWS = 4
"""Most images of a place in a batch, as in all recipes of the paper."""


@dataclasses.dataclass(frozen=True)
class ComparisonConfig:
    """All that decides what a comparison finds; `config.json` in its folder."""

    kind: Literal["compare", "ablate"]
    names: tuple[str, ...]
    """Of `METHODS` or `ABLATIONS`."""
    test: tuple[str, ...]
    """Evaluation sets, of any layout that `open_benchmark` knows."""
    train: str | None = None
    """Folder in the layout of GSV-Cities."""
    weights: tuple[str, ...] = ()
    """NAME=FILE of methods that are not trained here."""
    backbone: str | None = None
    """Where training starts; None is from nothing, by the recipe `scratch`."""
    preset: str = "b14"
    epochs: int | None = None
    """None is the recipe's, or `EPOCHS` from nothing."""
    image_size: tuple[int, int] | None = None
    batch_size: int = 16
    """Images described together."""
    grouping: str = "single"
    """Comma-separated; methods without a cross-image encoder have one for all."""
    rerank: int = 20
    """So many first retrievals are ranked anew by the methods that do."""
    seeds: int = 3
    """Runs of each method: of seed 0, 1 and so on."""

    def __post_init__(self) -> None:
        """Check the ranges, and the names."""
        check_grouping((), self.batch_size, 0, self.seeds)
        parse_groupings(self.grouping.split(","))
        known = METHODS if self.kind == "compare" else ABLATIONS
        what = "--methods" if self.kind == "compare" else "--rows"
        for name in self.names:
            choose(what, name, known)
        for flag, values in ((what, self.names), ("--test", self.test)):
            if not values or len(set(values)) < len(values):
                raise InputError(
                    f"{flag}: found {', '.join(values) or 'none'}, expected at least one, each once"
                )
        # A single retrieval has no other order.
        for flag, value, least in (("--epochs", self.epochs, 1), ("--rerank", self.rerank, 2)):
            if value is not None and value < least:
                raise InputError(f"{flag}: found {value}, expected at least {least}")


@dataclasses.dataclass(frozen=True)
class Variant:
    """One line of the table, ready to be run."""

    name: str
    labels: tuple[str, ...]
    """What stands before its numbers."""
    run: str
    """The name under which its model is kept, which others may share."""
    training: TrainConfig
    """Of seed 0."""
    learns: bool
    rerank: str | None
    """As `--rerank` of `evaluate` reads it."""
    weights: pathlib.Path | None
    """The model, where it comes from a file."""
    model: ModelConfig
    """What `weights` hold, or `training` makes."""
    places: Places | None = None
    """What it is trained on, where it is trained here; with small places too where its loss
    regroups the images."""

    @property
    def trains(self) -> bool:
        """Whether it is trained here."""
        return self.learns and self.weights is None

    def seeds(self, seeds: int) -> range:
        """Those of its runs: a model from a file is always the same."""
        return range(1 if self.weights is not None else seeds)


class Prepared(NamedTuple):
    """A comparison whose parts fit each other."""

    config: ComparisonConfig
    variants: list[Variant]
    places: Places | None
    benchmarks: list[Benchmark]

    @property
    def units(self) -> list[tuple[Variant, int]]:
        """All runs: a variant and a seed."""
        return [(v, seed) for v in self.variants for seed in v.seeds(self.config.seeds)]


def prepare(config: ComparisonConfig) -> Prepared:
    """Read the sets, make all configurations and check them, weights from files included.

    Raises:
        InputError: a file cannot be read or holds another method's weights; something has to be
            trained or clustered without a training set; a method does not fit the images or its
            parts each other; more images would be ranked anew than a set has.
    """
    weights = _weights(config)
    benchmarks = [open_benchmark(path) for path in config.test]
    for benchmark in benchmarks:
        benchmark.ground_truth()
    drafts = list(_drafts(config))
    # A vocabulary takes training images too, where nothing is learnt.
    need = [draft.run for draft in drafts if draft.run not in weights]
    if need and config.train is None:
        raise InputError(
            f"--train: found none, expected a training set for {', '.join(dict.fromkeys(need))}, "
            "or --weights of each"
        )
    places, views = _places(config) if need else (None, _VIEWS)
    variants = []
    for draft in drafts:
        training = draft.training
        if places is not None and draft.run not in weights:
            training = _fitted(training, config, len(places.place_id), views)
            own = _own_training_set(draft, training, config, places)
        else:
            own = None
        file = weights.get(draft.run)
        model = training.model if file is None else _checked(draft, file, config)
        variants.append(
            dataclasses.replace(draft, training=training, weights=file, model=model, places=own)
        )
    for variant in variants:
        _check(variant, config, benchmarks)
    _check_backbone(config, variants)
    return Prepared(config, variants, places, benchmarks)


def _own_training_set(
    draft: Variant, training: TrainConfig, config: ComparisonConfig, places: Places
) -> Places:
    """What a variant is trained on, and that an epoch of it makes batches."""
    assert config.train is not None
    if training.min_images_of_place < training.min_images:
        places = read_places(config.train, min_images=training.min_images_of_place)
    try:
        steps_per_epoch(training, groups_of(training, places))
    except InputError as error:
        raise InputError(f"{draft.name}: {error}") from error
    return places


def _drafts(config: ComparisonConfig) -> Iterator[Variant]:
    """The variants, as their recipes have them."""
    for name in config.names:
        if config.kind == "compare":
            method = METHODS[name]
            training = recipe(config.preset, method.recipe)
            if config.backbone is None:
                training = from_scratch(training)
            labels, run, learns = (method.title,), method.recipe, method.learns
            rerank = None if method.rerank is None else f"{method.rerank}:{config.rerank}"
        else:
            ablation: Ablation = ABLATIONS[name]
            training = ablation.training(config.preset, from_nothing=config.backbone is None)
            labels, run = (name, *ablation.labels(training)), name
            learns, rerank = True, None
        if config.image_size is not None:
            model = dataclasses.replace(training.model, image_size=config.image_size)
            training = dataclasses.replace(training, model=model)
        yield Variant(name, labels, run, training, learns, rerank, None, training.model)


def _weights(config: ComparisonConfig) -> dict[str, pathlib.Path]:
    """The files by the name of the run that they stand for."""
    found: dict[str, pathlib.Path] = {}
    for text in config.weights:
        name, separator, file = text.partition("=")
        if not separator or not file:
            raise InputError(f"--weights: found {text!r}, expected NAME=FILE")
        if name not in config.names:
            raise InputError(
                f"--weights: found {name!r}, expected one of those compared, "
                f"{', '.join(config.names)}"
            )
        run = METHODS[name].recipe if config.kind == "compare" else name
        path = pathlib.Path(file)
        if found.setdefault(run, path) != path:
            raise InputError(
                f"--weights: found {found[run]} and {path} for {run}, expected one file: methods "
                "of one recipe share their model"
            )
    return found


def _checked(draft: Variant, path: pathlib.Path, config: ComparisonConfig) -> ModelConfig:
    """The model that a file holds, if it is of the variant's method; its sizes are its own."""
    _, found = load_weights(path)
    wanted = draft.training.model
    parts = {
        "aggregator": (found.aggregator, wanted.aggregator),
        "adapter": (found.backbone.adapter.kind, wanted.backbone.adapter.kind),
        "cross-image encoder": (bool(found.encoder.layers), bool(wanted.encoder.layers)),
    }
    wrong = [f"{name} {a}, expected {b}" for name, (a, b) in parts.items() if a != b]
    if wrong:
        raise InputError(
            f"{path}: weights of another method than {draft.name}: found {'; '.join(wrong)}"
        )
    size = config.image_size
    if size is None:
        return found
    found.check_image_size(size)
    return dataclasses.replace(found, image_size=size)


def _places(config: ComparisonConfig) -> tuple[Places, int]:
    """The training set, and how many images of a place a batch has."""
    assert config.train is not None
    places = read_places(config.train, min_images=2)
    views = int(np.clip(np.median(places.image_counts), 2, _VIEWS))
    if views > 2:
        places = read_places(config.train, min_images=views)
    return places, views


def _fitted(
    training: TrainConfig, config: ComparisonConfig, places: int, views: int
) -> TrainConfig:
    """A recipe for a training set of so many places: batches that it can fill.

    From nothing all methods have batches of as many images, and as many steps.
    """
    if config.epochs is not None:
        training = dataclasses.replace(training, epochs=config.epochs)
    training = dataclasses.replace(training, patience=None)
    if config.backbone is not None:
        training = dataclasses.replace(
            training, places_per_batch=min(training.places_per_batch, places), micro_batch=None
        )
        if not training.loss.classifies:
            return _of_views(training, min(training.images_per_place, views), views)
        if training.loss.large_margin_cosine.classes == "places":
            return _of_views(training, training.images_per_place, views)
        return training
    size = min(training.places_per_batch * training.images_per_place // views, places)
    epochs = config.epochs or EPOCHS
    optimiser = training.optimiser
    warmup = min(optimiser.warmup_steps, places // size * epochs // _WARMUP_SHARE)
    return dataclasses.replace(
        training,
        loss=_own_places(training.loss),
        optimiser=dataclasses.replace(optimiser, warmup_steps=warmup),
        places_per_batch=size,
        images_per_place=views,
        min_images=views,
        epochs=epochs,
    )


def _of_views(training: TrainConfig, images: int, views: int) -> TrainConfig:
    """So many images of a place a batch, of a set whose places have so many views."""
    least = min(training.min_images, views)
    return dataclasses.replace(training, images_per_place=images, min_images=least)


def _own_places(loss: LossConfig) -> LossConfig:
    """A loss of classes takes a small set's own places for them, all in one group."""
    if not loss.classifies:
        return loss
    classes = dataclasses.replace(loss.large_margin_cosine, classes="places", groups=1, steps=None)
    return dataclasses.replace(loss, large_margin_cosine=classes)


def _check(variant: Variant, config: ComparisonConfig, benchmarks: list[Benchmark]) -> None:
    """That a variant's parts fit each other and the sets; nothing is computed."""
    if variant.trains:
        trained_parameters(variant.model, variant.training.trains)  # raises where nothing could
    for benchmark in benchmarks:
        if variant.rerank is not None and config.rerank > len(benchmark.database):
            raise InputError(
                f"--rerank: found {config.rerank} for {variant.name}, expected at most the "
                f"{len(benchmark.database)} database images of {benchmark.root}"
            )
    if variant.rerank is not None:
        parse_reranking(variant.rerank).check(variant.model)


def _check_backbone(config: ComparisonConfig, variants: list[Variant]) -> None:
    """That what starts from a backbone can, one of each kind."""
    if config.backbone is None:
        return
    for backbone in dict.fromkeys(v.model.backbone for v in variants if v.weights is None):
        read_backbone(config.backbone, backbone, init_vit(jax.random.key(0), backbone))


def labels_of(kind: str) -> tuple[str, ...]:
    """The headers above `Variant.labels`."""
    if kind == "compare":
        return ("method",)
    return ("row", "adapter", "cross-image encoder", "learning rate", "scheduler")


def short_names(benchmarks: list[Benchmark]) -> list[str]:
    """A name of a few letters for each set, no two the same."""
    names: Mapping[str, int] = {}
    short = [benchmark.name.partition(" (")[0].partition("/")[0] for benchmark in benchmarks]
    names = {name: short.count(name) for name in short}
    return [
        name if names[name] == 1 else f"{name} {number + 1}" for number, name in enumerate(short)
    ]
