"""The work of a comparison: runs, evaluations and timing, each done once, results in its folder.

OUT/config.json                       what was ever compared here (see `ledger`)
OUT/NAME/seed-S/run/                  a training run, which can be resumed
OUT/NAME/seed-S/start.safetensors     what it starts from, where a vocabulary was built
OUT/NAME/seed-S/training.json         the time that training took
OUT/NAME/seed-S/test-N.json           an evaluation, on the N-th set of config.json
OUT/speed.json                        the timing of all models
"""

import contextlib
import dataclasses
import functools
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from crisalad_jax.checkpoints.torch_io import with_backbone_of
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.metrics import right_retrievals
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.comparison.ledger import claim, numbers_of, seeds_of
from crisalad_jax.experiments.comparison.plan import (
    ComparisonConfig,
    Prepared,
    Variant,
    file_name,
)
from crisalad_jax.experiments.comparison.records import advised, is_number, read_result
from crisalad_jax.experiments.comparison.timing import Race, describing, is_absolute, machine, race
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.retrieval.reranking import parse_reranking
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.vocabulary import needs_vocabulary, with_vocabulary
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.locks import (
    POLL,
    BusyFolderError,
    holder_of,
    is_here,
    lock,
)
from crisalad_jax.utils.temporaries import LOCK

_ROUNDS = 5

Say = Callable[[str], None]


def carry_out(prepared: Prepared, out: pathlib.Path, *, say: Say, quiet: bool = False) -> None:
    """Do what is left of a comparison, and write its results into `out`.

    Results of earlier calls are reused, also of one that was killed. Other processes may do the
    same for this folder, on other hosts too: each takes runs that no other one is at.

    Args:
        prepared: the comparison.
        out: the folder, of this comparison or new.
        say: is given a line at the start, and before each run: which of how many, and how long the
            rest may take.
        quiet: no progress bars.

    Raises:
        InputError: what `claim`, `fit` and `evaluate` raise; or a result that is not whole, or of
            another set than is given now.
        Interrupted: what `fit` raises; the same call resumes.
    """
    with lock(out, wait=True):
        claim(out, prepared)
    say(_start_words(prepared))
    take_runs(prepared, out, say=say, quiet=quiet)
    with lock(out, wait=True):
        if not _is_timed(prepared, out):
            say("images described a second, all models in turns")
            write_json(out / "speed.json", _race(prepared, out, quiet))


def take_runs(
    prepared: Prepared,
    out: pathlib.Path,
    *,
    say: Say,
    quiet: bool = False,
    jobs: int = 1,
    beside: bool = False,
) -> None:
    """Take runs that no other process is at, until all are done, by whomever.

    Args:
        prepared: the comparison, whose folder was claimed.
        out: the folder.
        say: is given a line before each run.
        quiet: no progress bars.
        jobs: number of processes that share the runs, for the time that is left.
        beside: whether others share this process's device.

    Raises:
        InputError: what `fit` and `evaluate` raise.
        Interrupted: what `fit` raises; the same call resumes.
    """
    numbers = numbers_of(out, prepared.config)
    made, waits = 0, False
    while left := [unit for unit in prepared.units if not _is_done(out, numbers, *unit)]:
        before = made
        for variant, seed in left:
            with contextlib.ExitStack() as stack:
                try:
                    stack.enter_context(lock(folder_of(out, variant.run, seed)))
                except BusyFolderError:
                    continue
                if _is_done(out, numbers, variant, seed):  # by another process, a moment ago
                    continue
                say(_run_words(prepared, out, numbers, variant, seed, jobs))
                _one(prepared, out, numbers, variant, seed, quiet, beside)
                made += 1
        if made == before:
            if not waits:
                say("waiting for the runs of other processes")
            waits = True
            time.sleep(POLL)


def runs_left(config: ComparisonConfig, out: pathlib.Path) -> int:
    """Count the runs that lack a result, by the folder's files alone: nothing is read or checked.

    Args:
        config: the comparison, whose folder may not be claimed yet.
        out: the folder.
    """
    runs = [(name, seed) for name, seeds in seeds_of(config).items() for seed in range(seeds)]
    try:
        numbers = numbers_of(out, config)
    except (InputError, KeyError, TypeError, ValueError):  # a new folder or set, or a damaged file
        return len(runs)
    return sum(
        not all((folder_of(out, name, seed) / f"test-{n}.json").exists() for n in numbers)
        for name, seed in runs
    )


def _run_words(
    prepared: Prepared,
    out: pathlib.Path,
    numbers: list[int],
    variant: Variant,
    seed: int,
    jobs: int,
) -> str:
    """Say which run begins, of how many, and how long the rest takes."""
    total = len(prepared.units)
    done = sum(_is_done(out, numbers, *unit) for unit in prepared.units)
    line = (
        f"{variant.name}, seed {seed}: method {_place(prepared, variant)} of "
        f"{len(prepared.variants)}, {done} of {total} runs done"
    )
    seconds, told = time_left(prepared, out, numbers)
    if not told:
        return line
    of = "" if told == total - done else f" for {told} of the {total - done}"
    return f"{line}, about {_words(seconds / jobs)} left{of}"


def time_left(prepared: Prepared, out: pathlib.Path, numbers: list[int]) -> tuple[float, int]:
    """Estimate the time of the runs that are left from finished ones of the same method.

    Methods take times that differ tenfold, so that a mean of all tells nothing. Results of other
    processes and of earlier calls count, too; compiling does not.

    Args:
        prepared: the comparison.
        out: its folder.
        numbers: of its sets, as `numbers_of` returns them.

    Returns:
        Seconds in one process, and of how many runs they are: those whose method has finished one.
    """
    trained: dict[str, dict[int, float]] = {}
    evaluated: dict[str, list[float]] = {}
    left = []
    for variant, seed in prepared.units:
        record = folder_of(out, variant.run, seed) / "training.json"
        if variant.trains and record.exists():
            trained.setdefault(variant.run, {})[seed] = _seconds_in(record, "seconds_of_steps")
        if _is_done(out, numbers, variant, seed):
            paths = (result_path(out, variant, seed, number) for number in numbers)
            taken = sum(_seconds_in(path, "seconds") for path in paths)
            evaluated.setdefault(variant.name, []).append(taken)
        else:
            left.append((variant, seed))
    seconds, told, training = 0.0, 0, set[tuple[str, int]]()
    for variant, seed in left:
        if variant.name not in evaluated:
            continue
        seconds += statistics.fmean(evaluated[variant.name])
        told += 1
        run, known = (variant.run, seed), trained.get(variant.run, {})
        # Methods that share a run train it once.
        if variant.trains and seed not in known and run not in training:
            training.add(run)
            seconds += statistics.fmean(known.values())
    return seconds, told


def _seconds_in(path: pathlib.Path, name: str) -> float:
    return read_result(path, **{name: float})[name]


def _start_words(prepared: Prepared) -> str:
    config = prepared.config
    if all(variant.weights is not None for variant in prepared.variants):
        return f"{len(config.names)} to compare, all from files"
    start = "from nothing" if config.backbone is None else f"from {config.backbone}"
    return f"{len(config.names)} to compare, {config.preset}, what is trained starts {start}"


def _place(prepared: Prepared, variant: Variant) -> int:
    return prepared.variants.index(variant) + 1


def _words(seconds: float) -> str:
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def folder_of(out: pathlib.Path, name: str, seed: int) -> pathlib.Path:
    """Return the folder of a run's or a variant's files."""
    return out / file_name(name) / f"seed-{seed}"


def result_path(out: pathlib.Path, variant: Variant, seed: int, number: int) -> pathlib.Path:
    """Return the file of a variant's evaluation on the set of this number, from 0."""
    return folder_of(out, variant.name, seed) / f"test-{number}.json"


def _is_done(out: pathlib.Path, numbers: list[int], variant: Variant, seed: int) -> bool:
    results = [result_path(out, variant, seed, number) for number in numbers]
    trained = folder_of(out, variant.run, seed) / "training.json"
    return all(path.exists() for path in results) and (not variant.trains or trained.exists())


def _is_timed(prepared: Prepared, out: pathlib.Path) -> bool:
    """Return whether all models were timed in one race, as their ratios need."""
    path = out / "speed.json"
    if not path.exists():
        return False
    return {variant.run for variant in prepared.variants} <= read_result(path, rounds=dict)[
        "rounds"
    ].keys()


def _one(
    prepared: Prepared,
    out: pathlib.Path,
    numbers: list[int],
    variant: Variant,
    seed: int,
    quiet: bool,
    beside: bool,
) -> None:
    """Train a variant for one seed and evaluate it, as far as results are missing."""
    params = _model(prepared, out, variant, seed, quiet, beside)
    for number, benchmark in zip(numbers, prepared.benchmarks, strict=True):
        path = result_path(out, variant, seed, number)
        if not path.exists():
            write_json(path, _evaluated(prepared.config, variant, params, benchmark, seed))


def _evaluated(
    config: ComparisonConfig, variant: Variant, params: Crisalad, benchmark: Benchmark, seed: int
) -> dict[str, Any]:
    options: dict[str, Any] = {}
    if variant.rerank is not None:
        options["rerank"] = parse_reranking(variant.rerank)
    started = time.monotonic()
    results = evaluate(
        Model(params, variant.model),
        benchmark,
        groupings=config.grouping.split(","),
        seed=seed,
        seeds=1,
        reading=Reading(batch_size=config.batch_size, quiet=True),
        **options,
    )
    return {
        "benchmark": benchmark.name,
        "queries": len(benchmark.queries),
        "database": len(benchmark.database),
        "seconds": round(time.monotonic() - started, 2),
        "groupings": {
            result.grouping: _ranks(result, benchmark)
            for result in results
            if (result.rerank is None) == (variant.rerank is None)
        },
    }


def _ranks(result: GroupingResult, benchmark: Benchmark) -> list[int]:
    """Find the rank of each query's first right retrieval, from 1; 0 where none is right."""
    right = right_retrievals(result.neighbours.indices, benchmark.ground_truth())
    return np.where(right.any(axis=1), right.argmax(axis=1) + 1, 0).tolist()


def _model(
    prepared: Prepared,
    out: pathlib.Path,
    variant: Variant,
    seed: int,
    quiet: bool,
    beside: bool = False,
) -> Crisalad:
    """Load a variant's parameters from a file, or make or train them."""
    if variant.weights is not None:
        return load_weights(variant.weights)[0]
    folder = folder_of(out, variant.run, seed)
    trained, last = folder / "training.json", folder / "run" / "last.safetensors"
    if variant.learns and trained.exists():
        return load_weights(last, expected=variant.model)[0]
    start = _start(prepared, folder, variant, seed, quiet)
    if not variant.learns:
        return start
    training = dataclasses.replace(variant.training, seed=seed)
    assert variant.places is not None
    _count_sitting(folder)
    beside = beside or _has_neighbours(out)
    result = fit(
        training,
        variant.places,
        folder / "run",
        initial=start,
        on_bad_image=prepared.on_bad_image,
        quiet=quiet,
    )
    beside = beside or _has_neighbours(out)
    write_json(trained, _training_record(folder, training, result.steps) | {"beside": beside})
    return result.params


def _has_neighbours(out: pathlib.Path) -> bool:
    """Return whether other processes of this host are at runs, and share its CPU with this one."""
    if is_absolute():
        return False
    holders = (holder_of(path.parent) for path in out.glob(f"*/seed-*/{LOCK}"))
    return any(holder is not None and is_here(holder) for holder in holders)


def _start(
    prepared: Prepared, folder: pathlib.Path, variant: Variant, seed: int, quiet: bool
) -> Crisalad:
    """Make the parameters that a run starts from, always the same for its seed."""
    path = folder / "start.safetensors"
    if path.exists():
        return load_weights(path, expected=variant.model)[0]
    # The same split of the seed's key as in `fit`, so that both draw the same parameters.
    key, _ = jax.random.split(jax.random.key(seed))
    params = init_crisalad(key, variant.model)
    if prepared.config.backbone is not None:
        params = with_backbone_of(params, variant.model, prepared.config.backbone)
    if needs_vocabulary(variant.model):
        params = _with_vocabulary(prepared, params, variant.model, seed, quiet)
        save_weights(path, Model(params, variant.model))
    return params


def _with_vocabulary(
    prepared: Prepared, params: Crisalad, model: ModelConfig, seed: int, quiet: bool
) -> Crisalad:
    assert prepared.places is not None
    places = prepared.places
    paths = [places.path(image) for image in range(len(places.files))]
    images = model.aggregator.centroid_images
    return with_vocabulary(
        params,
        model,
        paths,
        images=images,
        seed=seed,
        on_bad_image=prepared.on_bad_image,
        quiet=quiet,
    )


def _count_sitting(folder: pathlib.Path) -> None:
    """Count a call that begins training, or resumes it after steps it had taken."""
    path, began = folder / "sittings.json", folder / "run" / "metrics.jsonl"
    if not path.exists():
        write_json(path, {"sittings": 1})
    elif began.exists() and began.stat().st_size:
        write_json(path, {"sittings": _sittings(path) + 1})


def _sittings(path: pathlib.Path) -> int:
    return read_result(path, sittings=int)["sittings"]


def _training_record(folder: pathlib.Path, training: TrainConfig, steps: int) -> dict[str, Any]:
    """Record steps and times of a training; repeated steps of a resumed run count once."""
    images = training.places_per_batch * training.images_per_place
    records = read_metrics(folder / "run" / "metrics.jsonl")
    seconds = [images / r["images_per_second"] for r in records if "images_per_second" in r]
    return {
        "steps": steps,
        "images": images,
        "step_seconds": statistics.median(seconds),
        "seconds_of_steps": sum(seconds),
        "sittings": _sittings(folder / "sittings.json"),
        "device": machine(),
    }


def _race(prepared: Prepared, out: pathlib.Path, quiet: bool) -> dict[str, Any]:
    """Time a batch of every model in turns; variants of one model run once."""
    size = prepared.config.batch_size
    models = {variant.run: variant for variant in prepared.variants}
    calls = {
        name: functools.partial(_describing, prepared, out, variant)
        for name, variant in models.items()
    }
    return {
        "device": machine(),
        "absolute": is_absolute(),
        "batch_size": size,
        "rounds": race(calls, _ROUNDS, quiet=quiet).rounds,
    }


def _describing(prepared: Prepared, out: pathlib.Path, variant: Variant) -> Callable[[], Any]:
    params = _model(prepared, out, variant, variant.seeds(1)[0], quiet=True)
    # Of the first set's size, which models that take images at their own size go by.
    image = prepare_image(read_pixels(prepared.benchmarks[0].queries[0]), variant.model)
    return describing(params, variant.model, image, prepared.config.batch_size)


def read_race(out: pathlib.Path, names: set[str]) -> tuple[Race, dict[str, Any]]:
    """Read the times that `carry_out` measured of these models, and the rest of their record.

    Raises:
        InputError: what `read_result` raises, or there are no times of one of them.
    """
    path = out / "speed.json"
    record = read_result(path, rounds=dict, device=str, absolute=bool, batch_size=int)
    rounds = record["rounds"]
    right = rounds.keys() >= names and all(map(_are_times, rounds.values()))
    with advised():
        if not right or len({len(times) for times in rounds.values()}) > 1:
            raise InputError(
                f"{path}: rounds: found other than as many seconds of each model, expected those "
                f"of {', '.join(sorted(names))}"
            )
    return Race(rounds), record


def _are_times(value: Any) -> bool:
    return isinstance(value, list) and value != [] and all(is_number(v) and v for v in value)
