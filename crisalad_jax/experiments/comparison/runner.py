"""The work of a comparison: runs, evaluations and timing, each done once, and then its tables.

OUT/config.json                       configuration of the last comparison in the folder OUT
OUT/NAME/seed-S/result.json           settings of a run, time of its training, its evaluations
OUT/NAME/seed-S/run/                  its training, which can be resumed, or its vocabulary
OUT/speed.json                        times of all models, and of adapters
"""

import contextlib
import dataclasses
import functools
import os
import pathlib
import statistics
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from crisalad_jax.checkpoints.public import with_backbone_of
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.config.checks import PATH, check_count, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.comparison.costs import (
    adapter_calls,
    adapter_memory,
    machine,
    race,
)
from crisalad_jax.experiments.comparison.plan import ComparisonConfig, Prepared, prepare
from crisalad_jax.experiments.comparison.results import (
    Run,
    Summary,
    read_result,
    runs_of,
    summarise,
)
from crisalad_jax.experiments.comparison.tables import write_tables
from crisalad_jax.experiments.comparison.tasks import in_tasks, in_turn, joined
from crisalad_jax.experiments.report.gallery import first_right_ranks
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.retrieval.describe import describe_prepared, prepare_image
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.reranking import parse_reranking
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.start import with_vocabulary_of
from crisalad_jax.training.trainer import run_keys
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_no_links, write_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.target import target
from crisalad_jax.utils.temporaries import holds_other_files, remove_temporaries

Say = Callable[[str], None]
_PATIENCE = 60.0
"""Seconds to wait for the end of a worker that still writes into a run's folder."""


@takes(config=ComparisonConfig, out=PATH)
def compare(
    config: ComparisonConfig,
    out: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    say: Say = lambda line: None,
    quiet: bool = False,
) -> Summary:
    """Train or load the methods of a comparison, evaluate them the same way, and write the tables.

    As much as possible is checked first. The same call resumes a killed comparison. Methods,
    rows, seeds and sets may be added or left out between calls: runs that `out` already holds are
    not repeated.

    Args:
        config: the comparison's configuration.
        out: folder for the runs, table.md, table.csv, results.json and the page index.html.
        jobs: number of runs at a time; several are Ray tasks, each with its share of the devices.
            None is 1 or, on a cluster, one per GPU, or one per node if there are no GPUs.
        cluster: Ray cluster, "local", "auto", ray://HOST[:PORT] or HOST:PORT (docs/how-to/ray.md).
            All its nodes must be able to read the files of `config`, and to write into `out`. None
            is this machine.
        say: called with a line of progress at the start and before each run.
        quiet: whether to hide progress bars.

    Returns:
        The results, as the tables show them.

    Raises:
        InputError: a file cannot be read, or something does not fit (`prepare`, `fit`, `evaluate`);
            the folder holds other files, or a run of the same name with other settings; another
            process is writing to it; or there is no such cluster, or a node cannot take part.
        Interrupted: a signal stopped the comparison; the same call resumes it.
    """
    out = pathlib.Path(out)
    if jobs is not None:
        check_count("--jobs", jobs)
        jobs = min(jobs, len(config.lines) * config.seeds)
    path = out / "config.json"
    with contextlib.ExitStack() as stack:
        stack.enter_context(lock(out))
        if not path.exists() and holds_other_files(out):
            raise InputError(
                f"{out}: found files but no comparison, expected one or a new or empty folder"
            )
        do, beside = in_turn, False
        if cluster is not None or (jobs or 1) > 1:
            weights = (text.partition("=")[2] for text in config.weights)
            read = (*config.test, config.train, config.backbone, *weights)
            share = stack.enter_context(joined(cluster or "local", jobs, read, out))
            do, beside, quiet = functools.partial(in_tasks, share), share.beside, True
        (prepared,) = do(functools.partial(prepare, quiet=quiet), (config,))
        check_no_links(out)
        write_json(path, to_plain(config))
        runs = runs_of(prepared, out)
        start = config.backbone or "nothing"
        say(f"{len(runs)} runs to compare; what is trained starts from {start}")

        def left() -> Iterator[tuple[int]]:
            for number, run in enumerate(runs):
                if not run.is_done:
                    done = sum(each.is_done for each in runs)
                    say(f"{run.variant.run}, seed {run.seed}: {done} of {len(runs)} runs done")
                    yield (number,)

        do(_complete, (prepared, runs, quiet, beside), left())
        speed = _measured(prepared, runs, out / "speed.json")
        if speed is None:
            say("timing all models in turns, in images described per second")
            (speed,) = do(_speed, (prepared, runs, quiet))
            write_json(out / "speed.json", speed)
        summary = summarise(prepared, runs, speed)
        write_tables(summary, out)
    return summary


def _complete(
    prepared: Prepared, runs: Sequence[Run], quiet: bool, beside: bool, number: int
) -> None:
    """Train a run's model and evaluate its variants, as far as results are missing."""
    run, config = runs[number], prepared.config
    # After a kill of the command, its workers may end some seconds later.
    with lock(run.folder, wait=_PATIENCE):
        remove_temporaries(run.folder)
        params, result = _model(prepared, run, quiet, beside), run.read()
        for key, variant, benchmark in run.evaluations:
            if key in result.ranks:
                continue
            results = evaluate(
                Model(params, variant.model),
                benchmark,
                groupings=config.grouping.split(","),
                seed=run.seed,
                seeds=1,
                rerank=None if variant.rerank is None else parse_reranking(variant.rerank),
                reading=Reading(batch_size=config.batch_size, quiet=True),
            )
            truth = benchmark.ground_truth()
            # For a grouping with and without a second stage, the last result is the one with it.
            result.ranks[key] = {
                each.grouping: first_right_ranks(each.neighbours, truth).tolist()
                for each in results
            }
            result.write(run.folder)


def _model(prepared: Prepared, run: Run, quiet: bool, beside: bool = False) -> Crisalad:
    """Load a run's parameters from a file, or make or train them."""
    variant, result, folder = run.variant, run.read(), run.folder / "run"
    if variant.weights is not None:
        return load_weights(variant.weights)[0]
    weights = folder / "last.safetensors"
    if weights.exists() and not (variant.trains and result.training is None):
        return load_weights(weights, expected=variant.model)[0]
    training = dataclasses.replace(variant.training, seed=run.seed)
    start = _start(prepared, run, training, quiet)
    result.write(run.folder)  # the settings, which a resumed training is checked against
    if not variant.trains:
        save_weights(weights, Model(start, variant.model))
        return start
    assert variant.places is not None
    how = {"on_bad_image": prepared.config.on_bad_image, "quiet": quiet}
    fitted = fit(training, variant.places, folder, initial=start, **how)
    # Repeated steps of a resumed run count once.
    images = training.places_per_batch * training.images_per_place
    records = read_metrics(folder / "metrics.jsonl")
    seconds = [images / r["images_per_second"] for r in records if "images_per_second" in r]
    result.training = {
        "steps": fitted.steps,
        "step_seconds": statistics.median(seconds),
        "device": machine(),
        "beside": beside,
    }
    result.write(run.folder)
    return fitted.params


def _start(prepared: Prepared, run: Run, training: TrainConfig, quiet: bool) -> Crisalad:
    """Make the parameters that a run starts from, always the same for its seed."""
    params = init_crisalad(run_keys(run.seed)[0], training.model)
    if prepared.config.backbone is not None:
        params = with_backbone_of(params, training.model, prepared.config.backbone)
    assert run.variant.places is not None
    how = {"on_bad_image": prepared.config.on_bad_image, "quiet": quiet}
    start = with_vocabulary_of(params, training, run.variant.places, **how)
    assert start is not None
    return start


def _measured(prepared: Prepared, runs: Sequence[Run], path: pathlib.Path) -> Any:
    """Read the times of all models and adapters; None if any of them is missing."""
    if not path.exists():
        return None
    record, config = read_result(path), prepared.config
    models = {run.variant.run for run in runs}
    adapters = adapter_calls() if config.is_papers else {}
    is_whole = models <= record["rounds"].keys() and adapters.keys() <= record["adapters"].keys()
    return record if is_whole and record["batch_size"] == config.batch_size else None


def _speed(prepared: Prepared, runs: Sequence[Run], quiet: bool) -> dict[str, Any]:
    """Time a batch of every model in turns; variants of a run count once."""
    size = prepared.config.batch_size
    adapters = adapter_calls() if prepared.config.is_papers else {}

    def ready(run: Run) -> Callable[[], Any]:
        params, model = _model(prepared, run, quiet=True), run.variant.model
        # From the first set: its size counts for models that take images at their own size.
        image = prepare_image(read_pixels(prepared.benchmarks[0].queries[0]), model)
        describer = describer_of(Model(params, model))
        return functools.partial(describe_prepared, describer, [image] * size, size)

    calls = {run.variant.run: functools.partial(ready, run) for run in runs if run.seed == 0}
    return {
        "device": machine(),
        # A CPU's times depend on other load.
        "absolute": target().platform != "cpu",
        "batch_size": size,
        "rounds": race(calls, quiet=quiet),
        "adapters": race(adapters),
        "adapter_memory": adapter_memory(adapters),
    }
