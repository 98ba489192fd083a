"""The results of a comparison: a row for each method, its recalls over seeds, its costs."""

import pathlib
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.config.io import to_plain
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.metrics import Interval, bootstrap_interval
from crisalad_jax.evaluation.results import ANY
from crisalad_jax.experiments.comparison.ablation import NOTES, AdapterCost
from crisalad_jax.experiments.comparison.ledger import numbers_of
from crisalad_jax.experiments.comparison.paired import RESAMPLES, Difference, paired_difference
from crisalad_jax.experiments.comparison.plan import Prepared, Variant, labels_of, short_names
from crisalad_jax.experiments.comparison.records import advised, read_result
from crisalad_jax.experiments.comparison.runner import folder_of, read_race, result_path
from crisalad_jax.experiments.comparison.timing import Race
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils.errors import InputError

KS = (1, 5, 10)
"""Values of K in the paper's tables."""


class Recall(NamedTuple):
    """Recall@K of a method on a set, as fractions."""

    mean: float
    """Mean over the seeds."""
    spread: float | None
    """Sample standard deviation over the seeds; None with a single one."""
    interval: Interval
    """95 % interval of the mean over the queries: see `metrics.bootstrap_interval`."""
    by_seed: tuple[float, ...]


class Spread(NamedTuple):
    """What repeats of a measurement range over."""

    median: float
    least: float
    most: float


@brief
class Row(NamedTuple):
    """A line of the table: a method under one grouping."""

    name: str
    labels: tuple[str, ...]
    grouping: str
    dimension: int
    recalls: Mapping[str, Mapping[int, Recall]]
    """Recalls by set, then by K."""
    speed: float
    """Number of images described in the time that the reference takes for one."""
    images_per_second: float | None
    """Speed in images a second; None on a CPU, where it depends on other load."""
    parameters: int
    trained: int | None
    """Number of parameters that were trained; None for a model from a file."""
    training: Spread | None
    """Training time over the reference's, of each of its runs to each of the reference's; None
    where one of the two has fewer than two runs that had their device to themselves."""
    training_seconds: Spread | None
    """Steps times a step's median seconds, of those runs; None of fewer than two."""
    sittings: int
    """Largest number of calls that a run took; more than one if it was resumed."""
    differences: Mapping[str, Mapping[int, Difference]] | None = None
    """Differences to the reference by set, then by K; None of the reference itself."""


@brief
class Summary(NamedTuple):
    """Contents of the tables and the page."""

    kind: str
    headers: tuple[str, ...]
    """Headers above the rows' labels."""
    reference: str
    """Name of the row that speeds and training times are relative to."""
    sets: Mapping[str, Benchmark]
    rows: list[Row]
    notes: list[str]
    adapters: list[AdapterCost]
    settings: Mapping[str, Any]


def summarise(
    prepared: Prepared, out: pathlib.Path, adapters: Sequence[AdapterCost] = ()
) -> Summary:
    """Read the results that `carry_out` left, and summarise them by row.

    Raises:
        InputError: a result is missing, not whole, or of another set.
    """
    sets = dict(zip(short_names(prepared.benchmarks), prepared.benchmarks, strict=True))
    raced, measured = read_race(out, {variant.run for variant in prepared.variants})
    reference = _reference(prepared)
    ranks = {v.name: _ranks(prepared, out, v, sets) for v in prepared.variants}
    records = {v.name: _training_records(prepared, out, v) for v in prepared.variants}
    seconds = {name: _seconds(trainings) for name, trainings in records.items()}
    rows = []
    for variant in prepared.variants:
        parameters, trained = _parameters(variant)
        batch = statistics.median(raced.rounds[variant.run])
        took, theirs = seconds[variant.name], seconds[reference.name]
        # Runs are not interleaved: one of the same seed met no more of the same load than another.
        ratios = [ours / other for ours in took for other in theirs]
        for grouping, of_sets in ranks[variant.name].items():
            recalls = {name: {k: recall_of(each, k) for k in KS} for name, each in of_sets.items()}
            rows.append(
                Row(
                    variant.name,
                    variant.labels,
                    grouping,
                    variant.model.descriptor_dim,
                    recalls,
                    _speed(raced, variant.run, reference.run),
                    measured["batch_size"] / batch if measured["absolute"] else None,
                    parameters,
                    trained,
                    _spread(ratios),
                    _spread(took),
                    max((record["sittings"] for record in records[variant.name]), default=0),
                    None
                    if variant is reference
                    else _differences(of_sets, _under(ranks[reference.name], grouping)),
                )
            )
    return Summary(
        prepared.config.kind,
        labels_of(prepared.config),
        reference.name,
        sets,
        rows,
        _notes(prepared, rows, reference, measured) + (list(NOTES) if adapters else []),
        list(adapters),
        to_plain(prepared.config),
    )


def _speed(raced: Race, name: str, reference: str) -> float:
    return 1 / raced.slower(name, reference)[0]


def _training_records(
    prepared: Prepared, out: pathlib.Path, variant: Variant
) -> list[dict[str, Any]]:
    if not variant.trains:
        return []
    return [
        read_result(
            folder_of(out, variant.run, seed) / "training.json",
            steps=int,
            images=int,
            step_seconds=float,
            seconds_of_steps=float,
            sittings=int,
            device=str,
            beside=bool,
        )
        for seed in variant.seeds(prepared.config.seeds)
    ]


def _seconds(records: list[dict[str, Any]]) -> list[float]:
    """Return the seconds of the runs that had their device to themselves, if at least two had."""
    alone = [each["steps"] * each["step_seconds"] for each in records if not each["beside"]]
    return alone if len(alone) > 1 else []


def _spread(values: Sequence[float]) -> Spread | None:
    return Spread(statistics.median(values), min(values), max(values)) if values else None


def _parameters(variant: Variant) -> tuple[int, int | None]:
    """Count all parameters, and those that were trained."""
    total = sum(leaf.size for leaf in jax.tree.leaves(parameter_shapes(variant.model)))
    if variant.weights is not None:
        return total, None
    if not variant.learns:
        return total, 0
    return total, count_trainable(variant.model, variant.training.trainable)


def _reference(prepared: Prepared) -> Variant:
    """Choose the variant that the others are compared with."""
    variants = {variant.name: variant for variant in prepared.variants}
    name = prepared.config.reference or "crisalad"
    return variants.get(name, prepared.variants[0])


def _ranks(
    prepared: Prepared, out: pathlib.Path, variant: Variant, sets: Mapping[str, Benchmark]
) -> dict[str, dict[str, np.ndarray]]:
    """Read a variant's (seed, query) ranks of first right retrievals, by grouping and set."""
    by_grouping: dict[str, dict[str, np.ndarray]] = {}
    numbers = numbers_of(out, prepared.config)
    for number, (name, benchmark) in zip(numbers, sets.items(), strict=True):
        paths = [
            result_path(out, variant, seed, number) for seed in variant.seeds(prepared.config.seeds)
        ]
        results = [_checked(path, benchmark) for path in paths]
        for path, result in zip(paths, results, strict=True):
            if result.keys() != results[0].keys():
                raise InputError(
                    f"{path}: found groupings {', '.join(result)}, expected "
                    f"{', '.join(results[0])} as of seed 0"
                )
        for grouping in results[0]:
            ranks = np.array([result[grouping] for result in results])
            by_grouping.setdefault(grouping, {})[name] = ranks
    return by_grouping


def _under(groupings: Mapping[str, dict[str, np.ndarray]], grouping: str) -> dict[str, np.ndarray]:
    """Return the reference's ranks under a grouping, or under its first where it lacks that."""
    return groupings.get(grouping, next(iter(groupings.values())))


def _differences(
    ranks: Mapping[str, np.ndarray], reference: Mapping[str, np.ndarray]
) -> dict[str, dict[int, Difference]]:
    """Compute differences by set and K.

    All that is trained here has the same seeds; a model from a file has a single one.
    """
    return {
        name: {
            k: paired_difference(
                hits_of(each, k),
                hits_of(reference[name], k),
                same_seeds=len(each) == len(reference[name]),
            )
            for k in KS
        }
        for name, each in ranks.items()
    }


def _checked(path: pathlib.Path, benchmark: Benchmark) -> dict[str, list[int]]:
    result = read_result(path, benchmark=str, queries=int, database=int, groupings=dict)
    expected = (benchmark.name, len(benchmark.queries), len(benchmark.database))
    if (result["benchmark"], result["queries"], result["database"]) != expected:
        raise InputError(
            f"{path}: found a result of {result['benchmark']} with {result['queries']} queries and "
            f"{result['database']} database images, expected {expected[0]} with {expected[1]} and "
            f"{expected[2]}; delete it, and the same command makes it anew"
        )
    with advised():
        for grouping, ranks in result["groupings"].items():
            right = isinstance(ranks, list) and len(ranks) == result["queries"]
            if not right or not all(type(rank) is int and rank >= 0 for rank in ranks):
                raise InputError(
                    f"{path}: groupings: found other than a rank from 0 of each query under "
                    f"{grouping}, expected {result['queries']} of them"
                )
        if not result["groupings"]:
            raise InputError(f"{path}: groupings: found none, expected at least one")
    return result["groupings"]


def hits_of(ranks: np.ndarray, k: int) -> np.ndarray:
    """Return which ranks are among the first `k`; 0 is none."""
    return (ranks > 0) & (ranks <= k)


def recall_of(ranks: np.ndarray, k: int) -> Recall:
    """Compute Recall@K of (seed, query) ranks of the first right retrieval, from 1; 0 is none."""
    hits = hits_of(ranks, k)
    by_seed = tuple(hits.mean(axis=1).tolist())
    return Recall(
        statistics.fmean(by_seed),
        statistics.stdev(by_seed) if len(by_seed) > 1 else None,
        bootstrap_interval(hits.sum(axis=0), trials=len(hits)),
        by_seed,
    )


def _notes(
    prepared: Prepared, rows: list[Row], reference: Variant, measured: Mapping[str, Any]
) -> list[str]:
    config = prepared.config
    title = reference.labels[0]
    interval = "95 % by bootstrap over the queries, as if they were independent"
    recalls = (
        "Recalls in percent of all queries: the mean over the seeds ± their standard deviation, "
        f"and {interval}. Seeds of all but models from files: {config.seeds}. Weights after the "
        "last step, nothing selected on a test set."
    )
    if all(variant.weights is not None for variant in prepared.variants):
        recalls = f"Recalls in percent of all queries, and {interval}. All models are from files."
    notes = [recalls]
    if len(prepared.variants) > 1:
        notes.append(_difference_note(prepared, title))
    notes += [
        f"Images/s: describing batches of {measured['batch_size']} of the first set's images, "
        f"each alone, all models in turns, on {measured['device']}"
        + ("." if measured["absolute"] else f", over {title}'s.")
        + (" Ranking anew comes on top." if any(v.rerank for v in prepared.variants) else ""),
    ]
    if any(v.trains for v in prepared.variants):
        notes.append(
            "Training time: steps x the median time of a step"
            + ("" if measured["absolute"] else f", over {title}'s")
            + ", without compiling: median and range of the runs that had their device to "
            "themselves, where these are at least two. Runs are not interleaved."
        )
        notes.append(_training_note(prepared))
    resumed = sorted({row.labels[0] for row in rows if row.sittings > 1})
    if resumed:
        notes.append(
            f"Resumed, so that its steps' times are of several calls: {', '.join(resumed)}."
        )
    if any(row.grouping not in (ANY, "single") for row in rows):
        notes.append(
            "A grouping other than single lets images look at others of their batch, of "
            f"{config.batch_size}."
        )
    if config.kind == "compare":
        notes += _method_notes(prepared)
    elif config.backbone is None and not config.rows:
        notes.append(
            "From nothing the learning rates are the recipe scratch's in the paper's proportion, "
            "6e-5 to 1e-4, and the step schedule is the paper's, after the warm-up: halved every "
            "three epochs."
        )
    return notes


def _difference_note(prepared: Prepared, title: str) -> str:
    """Say how the differences are computed, and what their words mean."""
    several = prepared.config.seeds > 1
    seeds = "" if several else " One seed says nothing of another start."
    apart = ""
    if several and len({variant.weights is None for variant in prepared.variants}) > 1:
        apart = "; a model from a file shares none, so that its differences draw them independently"
    return (
        f"Δ: recall less {title}'s on the same queries, in points, with 95 % by bootstrap over "
        "queries and seeds, both drawn together for the two rows (runs of one seed share initial "
        f"values and batches{apart}): {RESAMPLES:,} resamples, seed 0, percentiles. Better or "
        f"worse: the interval excludes 0; else the two are not told apart.{seeds}"
    )


def _training_note(prepared: Prepared) -> str:
    """Describe the start and the set of training, and its length if that is the same for all."""
    config = prepared.config
    start = "a given backbone" if config.backbone else "nothing, by the recipe scratch"
    words = f"Trained from {start} on {pathlib.Path(config.train or '').name}: "
    of_size: dict[str, list[str]] = {}
    for variant in prepared.variants:
        if variant.trains:
            t = variant.training
            size = f"epochs: {t.epochs}, batches of {t.places_per_batch} places x"
            title = variant.labels[0]
            of_size.setdefault(f"{size} {t.images_per_place} images", []).append(title)
    if len(of_size) == 1:
        (size,) = of_size
        return f"{words}{size}."
    # One title stands for a variant of several groupings.
    several = (f"{size} ({', '.join(dict.fromkeys(titles))})" for size, titles in of_size.items())
    return f"{words}{'; '.join(several)}."


def _method_notes(prepared: Prepared) -> list[str]:
    shared = [v.labels[0] for v in prepared.variants if v.rerank is not None]
    notes = []
    if shared:
        notes.append(
            f"Ranked anew, the first {prepared.config.rerank} retrievals: {', '.join(shared)}."
        )
    unlearnt = [v.labels[0] for v in prepared.variants if not v.learns]
    if unlearnt:
        start = "" if prepared.config.backbone else ", here of random features"
        notes.append(
            f"Never trained, a vocabulary of features alone{start}: {', '.join(unlearnt)}."
        )
    return notes
