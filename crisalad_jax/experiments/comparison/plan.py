"""The configuration of a comparison; its parts are made and checked before any work starts."""

import dataclasses
import pathlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.torch_io import read_backbone
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.checks import check_count, check_types
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.benchmarks.benchmark import leave_out_unreadable
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.experiments.comparison.ablation import (
    ABLATIONS,
    ROW_HEADERS,
    adapter_kind,
    find_row,
    row_labels,
    row_training,
)
from crisalad_jax.experiments.comparison.methods import (
    METHODS,
    is_method,
    method_of,
    method_training,
)
from crisalad_jax.experiments.comparison.rows import AblationRow, as_row
from crisalad_jax.losses import LossConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.grouping import parse_groupings
from crisalad_jax.retrieval.reranking import parse_reranking
from crisalad_jax.training.batches import PlaceBatches
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.optimiser import count_steps, warmup_length, with_short_warmup
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

EPOCHS = 6
"""Number of epochs from random weights: all methods on two small sets, three seeds each, take less
than an hour on two cores."""
_VIEWS = 4
"""Largest number of images of a place in a batch, as in all recipes of the paper."""


@dataclasses.dataclass(frozen=True)
class ComparisonConfig:
    """Everything that decides a comparison's results; `config.json` in its folder."""

    kind: Literal["compare", "ablate"]
    names: tuple[str, ...]
    """Names that `method_of` or `row_training` looks up, and any others that `weights` has."""
    test: tuple[str, ...]
    """Evaluation sets, of any layout that `open_benchmark` knows."""
    train: str | None = None
    """Training set, in any layout that `read_places` reads."""
    weights: tuple[str, ...] = ()
    """Weights of methods that are not trained here, as NAME=FILE, or the NAME of a published model.
    A name that is no method's is a line of its own, whatever model the file holds."""
    backbone: str | None = None
    """Backbone that training starts from; None trains from nothing, by the recipe `scratch`."""
    preset: str = "b14"
    epochs: int | None = None
    """Number of epochs; None is the recipe's, or `EPOCHS` from nothing."""
    image_size: tuple[int, int] | None = None
    resize: tuple[str, ...] = ()
    """Words that change how images are resized, as `ModelConfig.resized` takes them."""
    batch_size: int = 16
    """Number of images described together."""
    grouping: str = "single"
    """Groupings between commas; a method without a cross-image encoder needs only one."""
    rerank: int = 20
    """Number of first retrievals that methods with a second stage re-rank."""
    seeds: int = 3
    """Number of runs of each method, with seeds from 0."""
    rows: tuple[AblationRow | str | tuple[str, Mapping[str, Any]], ...] = ()
    """Rows of one's own, of an ablation: text as `parse_row` reads it, or (name, changes), where
    changes are values by the flags of `train`. Those that `names` lacks follow after it."""
    reference: str | None = None
    """Name that differences, speeds and training times are relative to; None is crisalad, or the
    first where that is not compared."""

    def __post_init__(self) -> None:
        """Check the types, the ranges and the names."""
        rows = tuple(map(as_row, self.rows))
        object.__setattr__(self, "rows", rows)
        own = [row.name for row in rows if row.name not in self.names]
        object.__setattr__(self, "names", (*self.names, *own))
        check_types(self)
        self._check_rows(rows)
        check_count("batch size", self.batch_size)
        check_count("seeds", self.seeds)
        parse_groupings(self.grouping.split(","))
        what = "--methods" if self.kind == "compare" else "--rows"
        for name in self.names:
            if self.kind == "compare":
                if name not in self.models:
                    method_of(name, self.preset)
            elif name not in ABLATIONS and self.row(name) is None:
                find_row(name, self.preset)
        folders = [file_name(name) for name in self.names]
        own_rows = {row.name for row in rows}
        for i, folder in enumerate(folders):
            first = folders.index(folder)
            if first < i and self.names[first] != self.names[i]:
                flag = "--row" if own_rows & {self.names[first], self.names[i]} else what
                raise InputError(
                    f"{flag}: found {self.names[first]} and {self.names[i]}, whose results would "
                    f"both be in the folder {folder}, expected names that differ in letters or "
                    "digits"
                )
        for flag, values, files in ((what, self.names, folders), ("--test", self.test, self.test)):
            if not values or len(set(files)) < len(values):
                raise InputError(
                    f"{flag}: found {', '.join(values) or 'none'}, expected at least one, each once"
                )
        # A single retrieval cannot be re-ranked.
        for flag, value, least in (("--epochs", self.epochs, 1), ("--rerank", self.rerank, 2)):
            if value is not None and value < least:
                raise InputError(f"{flag}: found {value}, expected at least {least}")

        if self.reference is not None and self.reference not in self.names:
            raise InputError(
                f"--reference: found {self.reference}, expected one of those compared, "
                f"{', '.join(self.names)}"
            )

    def _check_rows(self, rows: tuple[AblationRow, ...]) -> None:
        """Check rows of one's own, with the parts and flags that they name."""
        if rows and self.kind != "ablate":
            raise InputError("--row: found rows beside methods, expected them in an ablation alone")
        names = [row.name for row in rows]
        for row in rows:
            if row.name in ABLATIONS or names.count(row.name) > 1:
                raise InputError(
                    f"--row: found the name {row.name} twice, or as one of the paper's rows, "
                    "expected another"
                )
            row.training(self.preset, from_nothing=self.backbone is None)

    def row(self, name: str) -> AblationRow | None:
        """Return the row of one's own with a name; None where there is none."""
        return next((row for row in map(as_row, self.rows) if row.name == name), None)

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the lines that are whatever model a file holds, and no method's."""
        return models_of(self.weights)


def models_of(weights: Iterable[str]) -> tuple[str, ...]:
    """Return the names in NAME=FILE, or NAME alone, that are no method's.

    Example:
        >>> models_of(["megaloc", "ours=run/best.safetensors", "salad=salad.safetensors"])
        ('megaloc', 'ours')
    """
    names = (text.partition("=")[0] for text in weights)
    return tuple(name for name in names if name and not is_method(name))


def names_to_compare(methods: Sequence[str] | None, weights: Sequence[str]) -> tuple[str, ...]:
    """Return the lines of a comparison: the methods, and the models that weights add.

    Args:
        methods: names of methods. None stands for those of `weights`, if one of them is no
            method's, and else for all of `METHODS`.
        weights: NAME=FILE, or the name of a published model.

    Returns:
        The names, each once.

    Example:
        >>> names_to_compare(None, ["megaloc", "salad"]), names_to_compare(["boq"], ["megaloc"])
        (('megaloc', 'salad'), ('boq', 'megaloc'))
    """
    models = models_of(weights)
    if methods is None:
        methods = [text.partition("=")[0] for text in weights] if models else list(METHODS)
    return tuple(methods) + tuple(name for name in models if name not in methods)


@dataclasses.dataclass(frozen=True)
class Variant:
    """One line of the table, with all that its runs need."""

    name: str
    labels: tuple[str, ...]
    """Cells before its numbers; empty where a row changes nothing."""
    run: str
    """Name of the run that makes its model, which other variants may share."""
    training: TrainConfig
    """Configuration of its training with seed 0."""
    learns: bool
    rerank: str | None
    """Second stage, as `--rerank` of `evaluate` reads it."""
    weights: pathlib.Path | None
    """File of the model, if it comes from one."""
    model: ModelConfig
    """Configuration of the model in `weights`, or of the one that `training` makes."""
    row: AblationRow | None = None
    """What it changes, if it is a row of one's own."""
    places: Places | None = None
    """Training set, if it is trained here; it includes small places if its loss regroups the
    images."""

    @property
    def trains(self) -> bool:
        """Whether the variant is trained here, and not loaded from a file."""
        return self.learns and self.weights is None

    def seeds(self, seeds: int) -> range:
        """Return the seeds of the variant's runs: one for a model from a file."""
        return range(1 if self.weights is not None else seeds)


@brief
class Prepared(NamedTuple):
    """A comparison whose parts fit each other."""

    config: ComparisonConfig
    variants: list[Variant]
    places: Places | None
    benchmarks: list[Benchmark]
    on_bad_image: OnBadImage = "stop"
    """What training does at an unreadable image."""

    @property
    def units(self) -> list[tuple[Variant, int]]:
        """Runs of the comparison, each a variant and a seed."""
        return [(v, seed) for v in self.variants for seed in v.seeds(self.config.seeds)]


def without_unreadable(
    prepared: Prepared, on_bad_image: OnBadImage, *, quiet: bool
) -> tuple[Prepared, list[str]]:
    """Leave unreadable images out of the sets where `on_bad_image` is "skip".

    Returns:
        The comparison, whose training masks them out; and a line for each set that lost some.
    """
    if on_bad_image == "stop":
        return prepared, []
    lines = []
    readable = [leave_out_unreadable(each, quiet=quiet) for each in prepared.benchmarks]
    for before, after in zip(prepared.benchmarks, readable, strict=True):
        queries = len(before.queries) - len(after.queries)
        database = len(before.database) - len(after.database)
        if queries or database:
            lines.append(
                f"{before.name}: unreadable and left out: {queries} queries and {database} "
                "database images."
            )
    return prepared._replace(benchmarks=readable, on_bad_image=on_bad_image), lines


def prepare(config: ComparisonConfig, on_bad_image: OnBadImage = "stop") -> Prepared:
    """Read the sets and make and check all configurations, weights from files included.

    A note tells which runs warm up for fewer steps than their recipes, because they are short.

    Raises:
        InputError: a file cannot be read or holds another method's weights; something has to be
            trained or clustered without a training set; a method does not fit the images or its
            parts each other; more images would be ranked anew than a set has.
    """
    weights = _weights(config)
    benchmarks = [open_benchmark(path, on_bad_image=on_bad_image) for path in config.test]
    for benchmark in benchmarks:
        benchmark.ground_truth()
    drafts = list(_drafts(config, weights))
    # A vocabulary needs training images too, although nothing trains.
    need = [draft.run for draft in drafts if draft.run not in weights]
    if need and config.train is None:
        raise InputError(
            f"--train: found none, expected a training set for {', '.join(dict.fromkeys(need))}, "
            "or --weights of each"
        )
    places, views = _places(config, on_bad_image) if need else (None, _VIEWS)
    variants = []
    shortened: dict[str, list[str]] = {}
    for draft in drafts:
        training = draft.training
        if places is not None and draft.run not in weights:
            training = _fitted_row(draft, config, places, views, on_bad_image)
            own, per_epoch = _own_training_set(draft, training, config, places, on_bad_image)
            steps = per_epoch * training.epochs
            optimiser = with_short_warmup(training.optimiser, steps, per_epoch)
            # From nothing `_fitted` has shortened it.
            if config.backbone is not None and not _sets_warmup(draft.row):
                training = dataclasses.replace(training, optimiser=optimiser)
            before, after = (
                warmup_length(each.optimiser, per_epoch) for each in (draft.training, training)
            )
            if draft.learns and after < before:
                count = count_steps(training.optimiser, steps, per_epoch)
                words = f"found {before} steps, shortened to {after} of the run's {count}"
                shortened.setdefault(words, []).append(draft.name)
        else:
            own = None
        file = weights.get(draft.run)
        model = training.model
        if file is not None and draft.name not in config.models:
            model = _checked(draft, file, config)
        variants.append(
            dataclasses.replace(draft, training=training, weights=file, model=model, places=own)
        )
    for variant in variants:
        _check(variant, config, benchmarks)
    _check_backbone(config, variants)
    for words, names in shortened.items():
        warn(f"warm-up: {words}, for {', '.join(names)}")
    return Prepared(config, variants, places, benchmarks)


def _own_training_set(
    draft: Variant,
    training: TrainConfig,
    config: ComparisonConfig,
    places: Places,
    on_bad_image: OnBadImage,
) -> tuple[Places, int]:
    """Choose a variant's training set, and count the steps of an epoch, which has some."""
    assert config.train is not None
    if draft.row is not None:
        places = read_places(
            config.train,
            cities=training.cities,
            min_images=training.min_images_of_place,
            on_bad_image=on_bad_image,
        )
    elif training.min_images_of_place < training.min_images:
        places = read_places(
            config.train, min_images=training.min_images_of_place, on_bad_image=on_bad_image
        )
    try:
        steps = PlaceBatches(training, places).steps_per_epoch
    except InputError as error:
        raise InputError(f"{draft.name}: {error}") from error
    return places, steps


def _drafts(config: ComparisonConfig, weights: Mapping[str, pathlib.Path]) -> Iterator[Variant]:
    """Yield the variants as their recipes define them, or as the files hold them."""
    from_nothing = config.backbone is None
    for name in config.names:
        if name in config.models:
            model = load_weights(weights[name])[1].resized(config.image_size, config.resize)
            training = TrainConfig(model=model, trainable="head")
            yield Variant(name, (name,), name, training, True, None, weights[name], model)
            continue
        rerank, row = None, config.row(name)
        if config.kind == "compare":
            method = method_of(name, config.preset)
            training = method_training(method.recipe, config.preset, from_nothing=from_nothing)
            labels, run = (method.title,), method.recipe
            if method.rerank is not None:
                rerank = f"{method.rerank}:{config.rerank}"
        else:
            if row is None:
                training = row_training(name, config.preset, from_nothing=from_nothing)
            else:
                training = row.training(config.preset, from_nothing=from_nothing)
            described = row_labels(training)
            if config.rows:
                described = (row.words if row is not None else _changed_words(described, config),)
            labels, run = (name, *described), name
        if config.image_size is not None or config.resize:
            way = training.model.preprocessing.changed_by(config.resize)
            size = config.image_size or training.model.image_size
            model = dataclasses.replace(training.model, image_size=size, preprocessing=way)
            training = dataclasses.replace(training, model=model)
        learns = training.model.aggregator.learns
        yield Variant(name, labels, run, training, learns, rerank, None, training.model, row)


def _changed_words(labels: tuple[str, ...], config: ComparisonConfig) -> str:
    """Say in words in what a row of the paper differs from its first."""
    from_nothing = config.backbone is None
    base = row_labels(row_training("crisalad", config.preset, from_nothing=from_nothing))
    described = zip(ROW_HEADERS[1:], labels, base, strict=True)
    return ", ".join(f"{header} {label}" for header, label, was in described if label != was)


def _weights(config: ComparisonConfig) -> dict[str, pathlib.Path]:
    """Map the names of runs to the files of weights that replace them."""
    files: dict[str, pathlib.Path] = {}
    for text in config.weights:
        name, separator, file = text.partition("=")
        if not name or (separator and not file):
            raise InputError(
                f"--weights: found {text!r}, expected NAME=FILE, or the NAME of a published model"
            )
        if name not in config.names:
            raise InputError(
                f"--weights: found {name!r}, expected one of those compared, "
                f"{', '.join(config.names)}"
            )
        run = name
        if config.kind == "compare" and name not in config.models:
            run = method_of(name, config.preset).recipe
        path = find_weights(file or name)
        if files.setdefault(run, path) != path:
            raise InputError(
                f"--weights: found {files[run]} and {path} for {run}, expected one file: methods "
                "of one recipe share their model"
            )
    return files


def _checked(draft: Variant, path: pathlib.Path, config: ComparisonConfig) -> ModelConfig:
    """Read the configuration of a file's model, and check that it is the variant's method."""
    _, model = load_weights(path)
    wanted = draft.training.model
    parts = {
        "backbone": (model.backbone.part_name, wanted.backbone.part_name),
        "aggregator": (model.aggregator.part_name, wanted.aggregator.part_name),
        "adapter": (adapter_kind(model), adapter_kind(wanted)),
        "cross-image encoder": (bool(model.cross_image.layers), bool(wanted.cross_image.layers)),
    }
    wrong = [f"{name} {a}, expected {b}" for name, (a, b) in parts.items() if a != b]
    if wrong:
        raise InputError(
            f"{path}: weights of another method than {draft.name}: found {'; '.join(wrong)}"
        )
    return model.resized(config.image_size, config.resize)


def _places(config: ComparisonConfig, on_bad_image: OnBadImage) -> tuple[Places, int]:
    """Read the training set, and choose the number of images of a place in a batch."""
    assert config.train is not None
    places = read_places(config.train, min_images=2, on_bad_image=on_bad_image)
    views = int(np.clip(np.median(places.image_counts), 2, _VIEWS))
    if views > 2:
        places = read_places(config.train, min_images=views, on_bad_image=on_bad_image)
    return places, views


def _fitted_row(
    draft: Variant,
    config: ComparisonConfig,
    places: Places,
    views: int,
    on_bad_image: OnBadImage,
) -> TrainConfig:
    """Fit a variant's recipe to a training set; what a row of one's own sets stays as it is."""
    training, row, count = draft.training, draft.row, len(places.place_id)
    if row is None:
        return _fitted(training, config, count, views, config.epochs)
    epochs = training.epochs if "epochs" in row.flags else config.epochs
    if "images-per-place" in row.flags:
        views = training.images_per_place
    if "cities" in row.flags:
        assert config.train is not None
        own = read_places(
            config.train, cities=training.cities, min_images=views, on_bad_image=on_bad_image
        )
        count = len(own.place_id)
    # Twice: what is fitted depends on what is set, and must not replace it.
    fitted = row.changed(_fitted(training, config, count, views, epochs), config.preset)
    if config.backbone is None and not _sets_warmup(row):
        steps = count // fitted.places_per_batch
        optimiser = dataclasses.replace(
            fitted.optimiser,
            warmup_steps=training.optimiser.warmup_steps,
            warmup_epochs=training.optimiser.warmup_epochs,
        )
        optimiser = with_short_warmup(optimiser, steps * fitted.epochs, steps)
        fitted = dataclasses.replace(fitted, optimiser=optimiser)
    return fitted


def _sets_warmup(row: AblationRow | None) -> bool:
    return row is not None and any(flag.startswith("optimiser.warmup-") for flag in row.flags)


def _fitted(
    training: TrainConfig, config: ComparisonConfig, places: int, views: int, epochs: int | None
) -> TrainConfig:
    """Fit a recipe to a training set of so many places, so that it can fill its batches.

    From random weights all methods have the same number of images in a batch, and of steps.
    """
    if epochs is not None:
        training = dataclasses.replace(training, epochs=epochs)
    training = dataclasses.replace(training, patience=None)
    if config.backbone is not None:
        training = dataclasses.replace(
            training, places_per_batch=min(training.places_per_batch, places), micro_batch=None
        )
        grouping = training.loss.kind.grouping
        if grouping is None:
            return _of_views(training, min(training.images_per_place, views), views)
        if grouping.kind == "places":
            return _of_views(training, training.images_per_place, views)
        return training
    size = min(training.places_per_batch * training.images_per_place // views, places)
    epochs = epochs or EPOCHS
    return dataclasses.replace(
        training,
        loss=_own_places(training.loss),
        optimiser=with_short_warmup(training.optimiser, places // size * epochs, places // size),
        places_per_batch=size,
        images_per_place=views,
        min_images=views,
        epochs=epochs,
    )


def _of_views(training: TrainConfig, images: int, views: int) -> TrainConfig:
    """Set the images of a place in a batch, for places of so many views."""
    least = min(training.min_images, views)
    return dataclasses.replace(training, images_per_place=images, min_images=least)


def _own_places(loss: LossConfig) -> LossConfig:
    """Make a classification loss take a small set's places as classes, all in one group."""
    if loss.kind.grouping is None:
        return loss
    classes = dataclasses.replace(loss.kind.grouping, kind="places", groups=1, steps=None)
    return dataclasses.replace(loss, kind=loss.kind.with_grouping(classes))


def _check(variant: Variant, config: ComparisonConfig, benchmarks: list[Benchmark]) -> None:
    """Check that a variant's parts fit each other and the sets, without computing anything."""
    if variant.trains:
        count_trainable(variant.model, variant.training.trainable)  # raises where nothing could
    for benchmark in benchmarks:
        if variant.rerank is not None and config.rerank > len(benchmark.database):
            raise InputError(
                f"--rerank: found {config.rerank} for {variant.name}, expected at most the "
                f"{len(benchmark.database)} database images of {benchmark.root}"
            )
    if variant.rerank is not None:
        parse_reranking(variant.rerank).check(variant.model)


def _check_backbone(config: ComparisonConfig, variants: list[Variant]) -> None:
    """Check that each kind of backbone can start from the given checkpoint."""
    if config.backbone is None:
        return
    for backbone in dict.fromkeys(v.model.backbone for v in variants if v.weights is None):
        read_backbone(config.backbone, backbone, backbone.init(jax.random.key(0)))


def file_name(name: str) -> str:
    """Make a folder's name of a method's: the colon of KIND:NAME is not allowed everywhere.

    Example:
        >>> file_name("step:newton")
        'step-newton'
    """
    return re.sub(r"[^\w.+-]+", "-", name)


def labels_of(config: ComparisonConfig) -> tuple[str, ...]:
    """Return the headers above `Variant.labels`."""
    if config.kind == "compare":
        return ("method",)
    return (ROW_HEADERS[0], "changed") if config.rows else ROW_HEADERS


def short_names(benchmarks: list[Benchmark]) -> list[str]:
    """Make a short name for each set, no two alike."""
    names: Mapping[str, int] = {}
    short = [benchmark.name.partition(" (")[0].partition("/")[0] for benchmark in benchmarks]
    names = {name: short.count(name) for name in short}
    return [
        name if names[name] == 1 else f"{name} {number + 1}" for number, name in enumerate(short)
    ]
