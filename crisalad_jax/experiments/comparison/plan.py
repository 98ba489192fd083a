"""The configuration of a comparison; its parts are made and checked before any work starts."""

import dataclasses
import functools
import pathlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.public import read_backbone
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.checks import PositiveInt, check_types
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.part import parts_of
from crisalad_jax.config.plugins import source_digest
from crisalad_jax.config.short_repr import brief, with_field_docs
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.benchmarks.benchmark import leave_out_unreadable
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.experiments.comparison.methods import (
    ABLATIONS,
    METHODS,
    AblationRow,
    is_method,
    method_of,
    method_training,
    parse_row,
    split_second_stage,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.grouping import parse_groupings
from crisalad_jax.retrieval.reranking import parse_reranking
from crisalad_jax.training.batches import PlaceBatches
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.optimiser import with_short_warmup
from crisalad_jax.training.run_files import checksum_of_places
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.errors import InputError, locate_errors

EPOCHS = 6
"""Default number of epochs from random weights. With it, all methods on two small sets, three seeds
each, take less than an hour on two cores."""
_VIEWS = 4
"""Largest number of images of a place in a batch, as in all recipes of the paper."""


@with_field_docs
@dataclasses.dataclass(frozen=True)
class ComparisonConfig:
    """Everything that decides a comparison's results; stored in its folder as `config.json`.

    Example:
        >>> rows = ("gem: model.aggregator=gem",)
        >>> ComparisonConfig("ablate", ("crisalad",), test=("SET",), train="DIR", rows=rows).lines
        ('crisalad', 'gem')
    """

    kind: Literal["compare", "ablate"]
    """"compare" for methods, as in the paper's Table 1; "ablate" for rows, as in its Table 2."""
    names: tuple[str, ...]
    """What is compared: names of `METHODS`, `ABLATIONS`, recipes, parts and models in `weights`."""
    test: tuple[str, ...]
    """Paths of evaluation sets, in any layout that `open_benchmark` reads."""
    train: str | None = None
    """Path of the training set, in any layout that `read_places` reads."""
    weights: tuple[str, ...] = ()
    """Weights of what is not trained here: NAME=FILE, or NAME of a published model. A NAME that is
    not a method has its own row, with any model; + adds a second stage, as in fol-large+fol."""
    backbone: str | None = None
    """File of the backbone that training starts from; None is random weights, as in `scratch`."""
    preset: str = "b14"
    epochs: PositiveInt | None = None
    """Number of epochs; None is the recipe's, or `EPOCHS` from random weights."""
    image_size: tuple[int, int] | None = None
    resize: tuple[str, ...] = ()
    """Changes to how images are resized, as `ModelConfig.resized` takes them; none by default."""
    batch_size: PositiveInt = 16
    """Number of images described together."""
    on_bad_image: OnBadImage = "stop"
    """"stop" at an unreadable image, or "skip" it: training masks it out, and evaluation sets leave
    it out; each call then first reads all images of the evaluation sets."""
    grouping: str = "single"
    """Comma-separated groupings; methods without a cross-image encoder do not depend on them."""
    rerank: int = 20
    """Number of first retrievals that methods with a second stage re-rank."""
    seeds: PositiveInt = 3
    """Number of runs of each method, with seeds 0, 1 and so on."""
    rows: tuple[str, ...] = ()
    """Custom rows of an ablation, as `parse_row` reads them."""
    reference: str | None = None
    """Name that differences, speeds and training times are relative to; None is crisalad, or the
    first name if crisalad is not compared."""

    def __post_init__(self) -> None:
        """Check types and ranges, and that nothing is repeated; `prepare` looks names up."""
        check_types(self)
        parse_groupings(self.grouping.split(","))
        _check_distinct(self.flag, self.lines, file_name)
        _check_distinct("--test", self.test, str)
        if self.reference not in (None, *self.lines):
            raise InputError(
                f"--reference: found {self.reference}, expected one of those compared, "
                f"{', '.join(self.lines)}"
            )

    @property
    def lines(self) -> tuple[str, ...]:
        """Names of everything compared: `names`, then those of the custom rows."""
        return (*self.names, *(parse_row(text).name for text in self.rows))

    @property
    def flag(self) -> str:
        """Command-line flag that `names` come from."""
        return "--methods" if self.kind == "compare" else "--rows"

    @property
    def is_papers(self) -> bool:
        """Whether only rows of the paper's Table 2 are compared; Table 3 is then measured too."""
        return self.kind == "ablate" and not self.rows

    @property
    def from_nothing(self) -> bool:
        """Whether training starts from random weights."""
        return self.backbone is None


def _check_distinct(flag: str, values: Sequence[str], key: Callable[[str], str]) -> None:
    """Check that there are values, and that no two share a folder."""
    if not values or len(set(map(key, values))) < len(values):
        raise InputError(
            f"{flag}: found {', '.join(values) or 'none'}, expected at least one, and each once, "
            "under names that differ in letters or digits"
        )


def file_name(name: str) -> str:
    """Make a folder name from a method's name: the colon of KIND:NAME is not allowed everywhere.

    Example:
        >>> file_name("step:newton")
        'step-newton'
    """
    return re.sub(r"[^\w.+-]+", "-", name)


def models_of(weights: Iterable[str]) -> tuple[str, ...]:
    """Return the names in texts NAME=FILE or NAME that are not the name of a method.

    Example:
        >>> models_of(["megaloc", "ours=run/best.safetensors", "salad=salad.safetensors"])
        ('megaloc', 'ours')
    """
    names = (text.partition("=")[0] for text in weights)
    return tuple(name for name in names if name and not is_method(name))


def names_to_compare(methods: Sequence[str] | None, weights: Sequence[str]) -> tuple[str, ...]:
    """Return the names to compare: methods, and models that weights add.

    Args:
        methods: names of methods. None means the names in `weights` if one of them is not the name
            of a method, and otherwise all of `METHODS`.
        weights: texts NAME=FILE, or names of published models.

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
    """One row of the table, with everything that its runs need."""

    name: str
    labels: tuple[str, ...]
    """Text cells of the row, before the results."""
    run: str
    """Name of the run that makes its model; other variants may share the run."""
    training: TrainConfig
    """Configuration of the training with seed 0; for a model from a file, only `model` is used."""
    rerank: str | None = None
    """Second stage, as `--rerank` of `evaluate` reads it."""
    row: AblationRow | None = None
    """The custom row that the variant stands for, if any."""
    weights: pathlib.Path | None = None
    """File of the model, if it comes from one."""
    places: Places | None = None
    """Training set, if the model is trained here or has a vocabulary; it includes places with few
    images if the loss regroups the images."""
    steps_per_epoch: int = 0
    """Training steps per epoch; 0 for a model from a file."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Everything that decides its model, as JSON values, with checksums of files and sets."""

    @property
    def model(self) -> ModelConfig:
        """Configuration of the model."""
        return self.training.model

    @property
    def trains(self) -> bool:
        """Whether the model is trained here: it is neither from a file nor just a vocabulary."""
        return self.weights is None and self.model.aggregator.trainable


@brief
class Prepared(NamedTuple):
    """A comparison whose sets are read and whose configurations are checked."""

    config: ComparisonConfig
    variants: list[Variant]
    benchmarks: list[Benchmark]
    left_out: list[str]
    """A line of text for each evaluation set that unreadable images were left out of."""


def prepare(config: ComparisonConfig, *, quiet: bool = True) -> Prepared:
    """Read the sets of a comparison, and make and check all configurations and weight files.

    Args:
        config: the comparison's configuration.
        quiet: whether to hide the progress bar.

    Returns:
        The comparison, ready to run.

    Raises:
        InputError: a file cannot be read, or has the weights of another method; a model has to be
            trained, or its vocabulary built, without a training set; a method does not fit the
            images, or its parts do not fit together; or `rerank` is more than a database holds.
    """
    files = _weights(config)
    benchmarks, left_out = _open_sets(config, quiet=quiet)
    variants = [_draft(config, name, files) for name in config.lines]
    smallest = min(len(benchmark.database) for benchmark in benchmarks)
    for variant in variants:
        if variant.trains:
            with locate_errors("" if variant.row is None else f"--row {variant.name}: "):
                count_trainable(variant.model, variant.training.trainable)
        if variant.rerank is not None:
            parse_reranking(variant.rerank).check(variant.model, smallest)
    if config.backbone is not None:
        for backbone in {v.model.backbone: None for v in variants if v.weights is None}:
            read_backbone(config.backbone, backbone, backbone.init(jax.random.key(0)))
    variants = _fitted(config, variants)
    digest = functools.cache(sha256_of)
    variants = [dataclasses.replace(v, settings=_settings(config, v, digest)) for v in variants]
    return Prepared(config, variants, benchmarks, left_out)


def _weights(config: ComparisonConfig) -> dict[str, pathlib.Path]:
    """Map names to the weight files of their models."""
    files: dict[str, pathlib.Path] = {}
    for text in config.weights:
        name, separator, file = text.partition("=")
        if name not in config.lines or name in files or (separator and not file):
            raise InputError(
                f"--weights: found {text!r}, expected NAME=FILE or the NAME of a published model, "
                f"each once, of one of those compared, {', '.join(config.lines)}"
            )
        files[name] = find_weights(file or split_second_stage(name)[0])
    return files


def _open_sets(config: ComparisonConfig, *, quiet: bool) -> tuple[list[Benchmark], list[str]]:
    """Open the evaluation sets; return them, and a line for each that lost unreadable images."""
    benchmarks, left_out = [], []
    for path in config.test:
        benchmark = readable = open_benchmark(path, on_bad_image=config.on_bad_image)
        benchmark.ground_truth()  # raises if there is none
        if config.on_bad_image == "skip":
            readable = leave_out_unreadable(benchmark, quiet=quiet)
        queries = len(benchmark.queries) - len(readable.queries)
        database = len(benchmark.database) - len(readable.database)
        if queries or database:
            left_out.append(
                f"{benchmark.name}: unreadable and left out: {queries} queries and {database} "
                "database images."
            )
        benchmarks.append(readable)
    return benchmarks, left_out


def _draft(config: ComparisonConfig, name: str, files: Mapping[str, pathlib.Path]) -> Variant:
    """Make a variant as its recipe defines it, or as its file holds it."""
    size = {"preset": config.preset, "from_nothing": config.from_nothing}
    row = next((row for row in map(parse_row, config.rows) if row.name == name), None)
    rerank, title, changed, run = None, name, "", name
    is_any = name in models_of(config.weights)
    if is_any:
        training, rerank = TrainConfig(trainable="head"), split_second_stage(name)[1]
    elif row is not None:
        changed, training = row.words, row.training(**size)
    elif name in ABLATIONS:
        title = METHODS[name].title if name in METHODS else name
        training = ABLATIONS[name].training(**size)
        changed = ABLATIONS[name].words(training)
    else:
        title, run, rerank = method_of(name, config.preset, config.flag)
        changed, training = title, method_training(run, **size)
    # Methods of one recipe share its model, and its file unless they have their own.
    file, run = (files[name], name) if name in files else (files.get(run), run)
    if file is None:
        model = dataclasses.replace(
            training.model,
            image_size=config.image_size or training.model.image_size,
            preprocessing=training.model.preprocessing.changed_by(config.resize),
        )
    else:
        _, found = load_weights(file)
        if not is_any:
            _check_method(name, training.model, found, file)
        model = found.resized(config.image_size, config.resize)
    training = dataclasses.replace(training, model=model)
    labels = (title,) if config.kind == "compare" else (name, changed)
    rerank = None if rerank is None else f"{rerank}:{config.rerank}"
    return Variant(name, labels, run, training, rerank, row, file)


def _check_method(name: str, wanted: ModelConfig, found: ModelConfig, path: pathlib.Path) -> None:
    """Check that a file's model belongs to a method."""

    def words(model: ModelConfig) -> str:
        adapter = getattr(getattr(model.backbone, "adapter", None), "part_name", "none")
        return (
            f"backbone {model.backbone.part_name}, aggregator {model.aggregator.part_name}, "
            f"adapter {adapter}, cross-image encoder {model.cross_image.part_name}"
        )

    if words(found) != words(wanted):
        raise InputError(
            f"{path}: found weights of another method than {name}: {words(found)}; expected "
            f"{words(wanted)}"
        )


def _fitted(config: ComparisonConfig, variants: list[Variant]) -> list[Variant]:
    """Fit the recipes of models made here to the training set; what a row sets is not changed."""
    # A vocabulary needs training images too, although nothing trains.
    need = dict.fromkeys(variant.run for variant in variants if variant.weights is None)
    if not need:
        return variants
    if config.train is None:
        raise InputError(
            f"--train: found none, expected a training set for {', '.join(need)}, or --weights of "
            "each"
        )
    read = functools.cache(
        functools.partial(read_places, config.train, on_bad_image=config.on_bad_image)
    )
    typical = int(np.clip(np.median(read(cities=None, min_images=2).image_counts), 2, _VIEWS))

    def fit(variant: Variant) -> Variant:
        training, row = variant.training, variant.row
        sets = row.sets if row is not None else lambda flag: False
        views = training.images_per_place if sets("images-per-place") else typical
        places = len(read(cities=training.cities, min_images=views).names)
        training = _of_size(config, training, places, views)
        if row is not None:
            training = row.changed(training, config.preset)
        places = read(cities=training.cities, min_images=training.min_images_of_place)
        per_epoch = PlaceBatches(training, places).steps_per_epoch
        if not sets("optimiser.warmup-"):
            steps = per_epoch * training.epochs
            optimiser = with_short_warmup(training.optimiser, steps, per_epoch)
            training = dataclasses.replace(training, optimiser=optimiser)
        return dataclasses.replace(
            variant, training=training, places=places, steps_per_epoch=per_epoch
        )

    return [each if each.weights is not None else fit(each) for each in variants]


def _of_size(
    config: ComparisonConfig, training: TrainConfig, places: int, views: int
) -> TrainConfig:
    """Fit a recipe to a training set of that many places, so that it can fill its batches.

    From random weights, all methods have the same number of images per batch and of steps, and a
    classification loss takes a small set's places as classes, all in one group.
    """
    loss, grouping = training.loss, training.loss.kind.grouping
    size, images = training.places_per_batch, training.images_per_place
    least, epochs = training.min_images, training.epochs
    if config.from_nothing:
        if grouping is not None:
            classes = dataclasses.replace(grouping, kind="places", groups=1, steps=None)
            loss = dataclasses.replace(loss, kind=loss.kind.with_grouping(classes))
        size, images, least, epochs = size * images // views, views, views, EPOCHS
    elif grouping is None:
        images, least = min(images, views), min(least, views)
    elif grouping.kind == "places":
        least = min(least, views)
    return dataclasses.replace(
        training,
        loss=loss,
        epochs=config.epochs or epochs,
        places_per_batch=min(size, places),
        images_per_place=images,
        min_images=least,
        micro_batch=None,
        patience=None,
    )


def _settings(
    config: ComparisonConfig, variant: Variant, digest: Callable[[Any], str]
) -> dict[str, Any]:
    """Record what decides a variant's model, with digests of what the configuration only names."""
    if variant.weights is not None:
        return {"weights": digest(variant.weights), "model": to_plain(variant.model)}
    assert variant.places is not None
    return {
        "training": to_plain(variant.training),
        "backbone": None if config.backbone is None else digest(config.backbone),
        "training set": checksum_of_places(variant.places),
        "plug-ins": {
            f"{part.registry.kind} {part.part_name}": source_digest(part)
            for part in map(type, parts_of(variant.training).values())
            if not part.__module__.startswith("crisalad_jax.")
        },
    }


def short_names(benchmarks: list[Benchmark]) -> list[str]:
    """Make a unique short name for each benchmark, from its own name."""
    short = [benchmark.name.partition(" (")[0].partition("/")[0] for benchmark in benchmarks]
    return [
        name if short.count(name) == 1 else f"{name} {number}"
        for number, name in enumerate(short, 1)
    ]
