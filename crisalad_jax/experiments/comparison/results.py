"""The results of a comparison: a file for each run, and a summary with a row for each method."""

import dataclasses
import itertools
import pathlib
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.difference import RESAMPLES, Difference, paired_difference
from crisalad_jax.evaluation.metrics import Interval, bootstrap_interval
from crisalad_jax.experiments.comparison.costs import AdapterCost, Spread, adapter_costs, ratios
from crisalad_jax.experiments.comparison.plan import (
    Prepared,
    Variant,
    file_name,
    short_names,
)
from crisalad_jax.experiments.report.page import render
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.training.run_files import checksum_of_benchmark
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import read_json, write_json

KS = (1, 5, 10)
"""Values of K in the paper's tables."""


def read_result(path: pathlib.Path) -> dict[str, Any]:
    """Read a file of results of a comparison.

    Raises:
        InputError: the file cannot be read, or was changed after it was written.
    """
    try:
        return read_json(path, "a result of a comparison")
    except InputError as error:
        raise InputError(f"{error}; delete it, and the same command makes it again") from error


@dataclasses.dataclass
class RunResult:
    """The results of a run so far, as in the file `result.json` of its folder."""

    settings: Mapping[str, Any]
    """What decided the model of the run; see `Variant.settings`."""
    training: dict[str, Any] | None = None
    """Steps and times of its training; None until it is finished."""
    ranks: dict[str, dict[str, list[int]]] = dataclasses.field(default_factory=dict)
    """Rank from 1 of each query's first correct answer, or 0; by `Evaluation.key` and grouping."""

    def write(self, folder: pathlib.Path) -> None:
        """Write the results atomically to `result.json` in the run's folder."""
        write_json(folder / "result.json", dataclasses.asdict(self))


class Evaluation(NamedTuple):
    """An evaluation of a run: for one of its variants, on one benchmark."""

    key: str
    """Text of what the result depends on besides the model: second stage, set and grouping."""
    variant: Variant
    benchmark: Benchmark


class Run(NamedTuple):
    """A model, trained or loaded once with one seed, and its evaluations for several variants."""

    seed: int
    folder: pathlib.Path
    evaluations: list[Evaluation]

    @property
    def variant(self) -> Variant:
        """The first of the variants that share the run's model."""
        return self.evaluations[0].variant

    def read(self) -> RunResult:
        """Read the results in the run's folder; return empty ones if there are none.

        Raises:
            InputError: the file is damaged, or the run was made with other settings.
        """
        path, settings = self.folder / "result.json", self.variant.settings
        if not path.exists():
            return RunResult(settings)
        result = RunResult(**read_result(path))
        changed = list(_changes(result.settings, settings))
        if changed:
            raise InputError(
                f"{self.folder}: holds a run with other settings: {few(changed)}; give the same to "
                "resume it (methods, rows, seeds and sets may be added), or another folder"
            )
        return result

    @property
    def is_done(self) -> bool:
        """Whether the run has nothing left to train or evaluate; raises like `read`."""
        result = self.read()
        trained = result.training is not None or not self.variant.trains
        return trained and all(each.key in result.ranks for each in self.evaluations)


def runs_of(prepared: Prepared, out: pathlib.Path) -> list[Run]:
    """List a comparison's runs in `out`: one per model and seed, or one for a model from a file."""
    config = prepared.config
    how = f"{config.grouping}, batches of {config.batch_size}"
    evaluations: dict[str, list[Evaluation]] = {}
    for benchmark in prepared.benchmarks:
        what = f"{benchmark.name} {checksum_of_benchmark(benchmark):08x}, {how}"
        for variant in prepared.variants:
            key = f"{variant.rerank or 'one stage'}, {what}"
            each = Evaluation(key, variant, benchmark)
            evaluations.setdefault(variant.run, []).append(each)
    return [
        Run(seed, out / file_name(name) / f"seed-{seed}", of_run)
        for name, of_run in evaluations.items()
        for seed in range(1 if of_run[0].variant.weights is not None else config.seeds)
    ]


def _changes(was: Any, now: Any, name: str = "") -> Iterator[str]:
    """Yield descriptions of where two trees of settings differ."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in {**was, **now}:
            yield from _changes(was.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif was != now:
        words = ("none" if each in (None, {}) else each for each in (was, now))
        yield "{}: was {}, is {}".format(name, *words)


class Recall(NamedTuple):
    """Recall@K of a method on a set, as fractions."""

    mean: float
    """Mean over the seeds."""
    spread: float | None
    """Sample standard deviation over the seeds; None with a single seed."""
    interval: Interval
    """95 % interval of the mean over the queries: see `metrics.bootstrap_interval`."""
    by_seed: tuple[float, ...]
    difference: Difference | None = None
    """Difference from the reference method; None for the reference itself."""


@brief
class Row(NamedTuple):
    """A row of the table: a method under one grouping."""

    name: str
    labels: tuple[str, ...]
    grouping: str
    dimension: int
    recalls: Mapping[str, Mapping[int, Recall]]
    """Recalls by evaluation set, then by K."""
    speed: float
    """Number of images described in the time that the reference method takes for one image."""
    images_per_second: float | None
    """Speed in images per second; None on a CPU, where other load changes it."""
    parameters: int
    trained: int | None
    """Number of parameters that were trained; None for a model from a file."""
    training: Spread | None
    """Training time divided by the reference's, for each pair of runs with a device to themselves;
    None if the method or the reference has fewer than two such runs."""
    training_seconds: Spread | None
    """Steps times the median seconds of a step, for such runs; None for fewer than two of them."""


@brief
class Summary(NamedTuple):
    """Contents of the tables and the page of a comparison."""

    kind: str
    headers: tuple[str, ...]
    """Headers of the columns with the labels of the rows."""
    reference: str
    """Label of the row that differences, speeds and training times are relative to."""
    sets: Mapping[str, Benchmark]
    rows: list[Row]
    notes: list[str]
    adapters: list[AdapterCost]
    settings: Mapping[str, Any]


def summarise(prepared: Prepared, runs: Sequence[Run], speed: Mapping[str, Any]) -> Summary:
    """Read the results of all runs, and summarise them by row.

    Args:
        prepared: the comparison.
        runs: its runs, all of them done.
        speed: contents of speed.json: times of models ("rounds") and "adapters", "adapter_memory",
            "device", "batch_size", and "absolute" (False on a CPU, where other load changes times).

    Returns:
        The summary.

    Raises:
        InputError: a result was changed or removed since it was written.
    """
    config = prepared.config
    sets = dict(zip(short_names(prepared.benchmarks), prepared.benchmarks, strict=True))
    variants = {variant.name: variant for variant in prepared.variants}
    reference = variants.get(config.reference or "crisalad", prepared.variants[0])
    results: dict[str, list[tuple[Run, RunResult]]] = {}
    for run in runs:
        path = run.folder / "result.json"
        require(run.is_done, f"{path}: found no complete result, expected the one written before")
        results.setdefault(run.variant.run, []).append((run, run.read()))
    rows = [_rows(variant, reference, sets, results, speed) for variant in prepared.variants]
    adapters = []
    if config.is_papers:
        adapters = adapter_costs(speed["adapters"], speed["adapter_memory"])
    return Summary(
        kind=config.kind,
        headers=("method",) if config.kind == "compare" else ("row", "changed"),
        reference=reference.labels[0],
        sets=sets,
        rows=list(itertools.chain(*rows)),
        notes=_notes(prepared, reference, speed),
        adapters=adapters,
        settings=to_plain(config),
    )


def _rows(
    variant: Variant,
    reference: Variant,
    sets: Mapping[str, Benchmark],
    results: Mapping[str, Sequence[tuple[Run, RunResult]]],
    speed: Mapping[str, Any],
) -> Iterator[Row]:
    """Yield a variant's row under each grouping."""
    rounds = speed["rounds"]
    batch = statistics.median(rounds[variant.run])
    relative = statistics.median(ratios(rounds, variant.run, reference.run))
    ours, others = (_training_seconds(results[each.run]) for each in (variant, reference))
    theirs = _ranks(reference, sets, results[reference.run])
    parameters = sum(leaf.size for leaf in jax.tree.leaves(parameter_shapes(variant.model)))
    trained = None if variant.weights is not None else 0
    if variant.trains:
        trained = count_trainable(variant.model, variant.training.trainable)
    for grouping, ranks in _ranks(variant, sets, results[variant.run]).items():
        # A grouping that the reference lacks is compared with the reference's first.
        other = theirs.get(grouping, next(iter(theirs.values())))
        recalls = {}
        for name in sets:
            than = None if variant is reference else other[name]
            recalls[name] = {k: recall_of(ranks[name], k, than) for k in KS}
        yield Row(
            name=variant.name,
            labels=variant.labels,
            grouping=grouping,
            dimension=variant.model.descriptor_dim,
            recalls=recalls,
            speed=1 / relative,
            images_per_second=speed["batch_size"] / batch if speed["absolute"] else None,
            parameters=parameters,
            trained=trained,
            # Runs are not interleaved, so those of the same seed did not share the same load.
            training=Spread.of([each / other for each in ours for other in others]),
            training_seconds=Spread.of(ours),
        )


def _ranks(
    variant: Variant, sets: Mapping[str, Benchmark], results: Sequence[tuple[Run, RunResult]]
) -> dict[str, dict[str, np.ndarray]]:
    """Collect a variant's (seed, query) ranks of first correct retrievals, by grouping and set."""
    run = results[0][0]
    own = [each.key for each in run.evaluations if each.variant is variant]
    groupings = results[0][1].ranks[own[0]]
    return {
        grouping: {
            name: np.array([result.ranks[key][grouping] for _, result in results])
            for name, key in zip(sets, own, strict=True)
        }
        for grouping in groupings
    }


def recall_of(ranks: np.ndarray, k: int, reference: np.ndarray | None = None) -> Recall:
    """Compute Recall@K from (seed, query) ranks of first correct retrievals: from 1, or 0 if none.

    Seeds are paired with those of `reference` if their numbers agree: all trainings share seeds.
    """
    hits = (ranks > 0) & (ranks <= k)
    by_seed = tuple(hits.mean(axis=1).tolist())
    difference = None
    if reference is not None:
        theirs = (reference > 0) & (reference <= k)
        difference = paired_difference(hits, theirs, same_seeds=len(hits) == len(theirs))
    return Recall(
        statistics.fmean(by_seed),
        statistics.stdev(by_seed) if len(by_seed) > 1 else None,
        bootstrap_interval(hits.sum(axis=0), trials=len(hits)),
        by_seed,
        difference,
    )


def _training_seconds(results: Sequence[tuple[Run, RunResult]]) -> list[float]:
    """Return the seconds of the runs that had their device to themselves, if at least two had."""
    records = [result.training for _, result in results if result.training is not None]
    alone = [each["steps"] * each["step_seconds"] for each in records if not each["beside"]]
    return alone if len(alone) > 1 else []


def _notes(prepared: Prepared, reference: Variant, speed: Mapping[str, Any]) -> list[str]:
    """Explain how the results were obtained; docs/comparison.md says more."""
    variants, sizes = prepared.variants, {}
    for variant in variants:
        training = variant.training
        if variant.trains:
            batch = training.places_per_batch, training.images_per_place
            size = training.epochs, variant.steps_per_epoch, *batch
            sizes.setdefault(size, {})[variant.labels[0]] = None
    context = {
        "config": prepared.config,
        "variants": variants,
        "reference": reference.labels[0],
        "speed": speed,
        "resamples": RESAMPLES,
        "train": pathlib.Path(prepared.config.train or "").name,
        "sizes": sizes,
        "reranked": _titles(variant for variant in variants if variant.rerank is not None),
        "unlearnt": _titles(v for v in variants if v.weights is None and not v.trains),
    }
    return [*render("notes.txt", context).splitlines(), *prepared.left_out]


def _titles(variants: Iterable[Variant]) -> list[str]:
    return list(dict.fromkeys(variant.labels[0] for variant in variants))
