"""The training loop: epochs, validation, early stop, and the files of a run (paper section 4.2)."""

import contextlib
import os
import pathlib
from collections.abc import Callable, Generator
from typing import NamedTuple

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.loader import THREADS, OnBadImage
from crisalad_jax.data.places import Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.run import Batch, Run, Told
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils import distributed
from crisalad_jax.utils.errors import InputError, Interrupted
from crisalad_jax.utils.progress import Bar, progress_bar
from crisalad_jax.utils.signals import SignalState, defer_signals


@brief
class FitResult(NamedTuple):
    """Result of a run."""

    params: Crisalad
    """Parameters after the last step."""
    steps: int
    best_recall: float | None
    """Best recall of a validation, a fraction, by `TrainConfig.select_by`; None without one."""
    stopped_early: bool
    skipped_images: int
    """Number of unreadable images that were masked out, counted each time they came up."""


@takes(config=TrainConfig, places=(Places, QuerySet), out=PATH)
def fit(
    config: TrainConfig,
    places: Places | QuerySet,
    out: str | os.PathLike[str],
    *,
    validation: Benchmark | None = None,
    initial: Crisalad | None = None,
    on_bad_image: OnBadImage = "stop",
    num_threads: int | None = None,
    shard_state: bool = False,
    quiet: bool = False,
) -> FitResult:
    """Train, or resume the run that `out` holds, and leave its files there.

    The files are: `config.json`; `metrics.jsonl`, a line for each step and each validation, and the
    same for TensorBoard in `tensorboard/`; `state/`, the checkpoint that a later call resumes from;
    and `last.safetensors`. A validation adds `best.safetensors`, the weights of the best recall by
    `config.select_by` (grouping `single`), and the best `config.keep_best` weights in `best/`.

    A run in `out` of fewer epochs is extended: it goes on to those of `config`, which may differ in
    nothing else. If the learning rate depends on the run's length, a note says how it jumps.

    A run that is killed at any moment and resumed ends with the same bits as an uninterrupted one
    (on a CPU; see docs/reliability.md for a GPU).

    Args:
        config: everything but the files.
        places: training images; a `QuerySet` where `config.mining` mines tuples.
        out: folder of the run.
        validation: evaluated every `config.validate_every` epochs, for early stopping.
        initial: parameters to start from; None starts from `init_crisalad` with the run's seed.
        on_bad_image: "stop", or "skip" to mask out unreadable images and count them; validations
            leave them out.
        num_threads: number of threads that read the training images; None is one for each core that
            this process may use.
        shard_state: keep what trains and its moments in shards, one a device, not whole on each.
        quiet: no progress bar.

    Returns:
        How the run ended.

    Raises:
        InputError: nothing of the model trains; an argument is out of range; the validation has no
            ground truth; `out` holds something else, or a run of another configuration or start; an
            image cannot be read; there are too few places, classes or images; the loss is no longer
            finite (the state before that step is saved); or a file cannot be written.
        Interrupted: SIGTERM or Ctrl-C came (in the main thread); the state is saved.

    Example:
        >>> import dataclasses
        >>> from crisalad_jax import read_places, recipe
        >>> config = dataclasses.replace(recipe("tiny"), epochs=1, places_per_batch=4)
        >>> fit(config, read_places(places, min_images=3), folder / "run", quiet=True).steps
        2
    """
    check_learns(config)
    threads = THREADS if num_threads is None else num_threads
    if threads < 0:
        raise InputError(f"num_threads: found {threads}, expected at least 0")
    if validation is not None:
        # A missing ground truth raises now, not after the first epoch.
        validation.ground_truth()
    run = Run(config, places, pathlib.Path(out), initial, validation, shard_state=shard_state)
    with contextlib.closing(run):
        _train(run, lambda: run.rest_of_round(on_bad_image, threads), on_bad_image, quiet)
        distributed.raise_together(run.save)
    record = run.record
    best = record.best[0][0] if record.best else None
    return FitResult(run.params(), run.step, best, record.stopped_early, record.skipped_images)


def check_learns(config: TrainConfig) -> None:
    """Check that a model trains; AnyLoc's does not, whose vocabulary fits one backbone.

    Raises:
        InputError: nothing of the model trains.
    """
    if not config.model.aggregator.learns:
        raise InputError(
            f"aggregator: found {config.model.aggregator.part_name}, with which nothing trains, "
            "expected another; `crisalad vocabulary` makes its models"
        )
    if not count_trainable(config.model, config.trainable):
        names = config.model.backbone.part_name, config.model.aggregator.part_name
        raise InputError(
            f"trainable: found {config.trainable}, of which backbone {names[0]} with aggregator "
            f"{names[1]} has no parameters, expected some"
        )


_Round = Callable[[], Generator[Batch, None, None]]


def _train(run: Run, rest_of_round: _Round, on_bad_image: OnBadImage, quiet: bool) -> None:
    silent = quiet or not distributed.is_primary()
    bar = progress_bar("training", run.steps, "steps", quiet=silent, done=run.step)
    with defer_signals() as signals, bar as bar:
        if run.classes:
            bar.say(
                f"classes in {len(run.classes)} groups: {min(run.classes)} to {max(run.classes)}"
            )
        try:
            try:
                while not run.is_done():
                    if run.validation_is_due():
                        bar.say(run.validate(signals, on_bad_image))
                        distributed.raise_together(run.save)
                    if run.mining_is_due():
                        bar.say(run.mine(on_bad_image, signals))
                    _train_round(run, rest_of_round, signals, bar)
                _stop_together(signals)  # one that came while the last validation was saved
            except InputError:
                # A signal to the process group also ends the workers that read images.
                _stop_together(signals)
                raise
        except Interrupted as stopped:
            run.save()
            where = f"after step {run.step}; the same command goes on"
            raise Interrupted(stopped.number, where) from None


def _stop_together(signals: SignalState) -> None:
    """Raise `Interrupted` in all processes if one of them was signalled."""
    (number,) = distributed.all_max(signals.number)
    if number:
        raise Interrupted(number)


def _train_round(run: Run, rest_of_round: _Round, signals: SignalState, bar: Bar) -> None:
    """Take the steps of a round, which is an epoch where nothing is mined.

    One process knows its errors, signals and clock before each step. Several tell them with the
    step, and learn what was told when its metrics are read, while the next one is computed: no
    process waits for the others before the end of the round. A process that has failed goes on
    with steps that none takes, until all have learnt it.
    """
    error: Exception | None = None

    def finish() -> None:
        note = distributed.raise_together(run.finish_step)
        if note is not None:
            bar.advance(1, note=note)

    def heed(told: Told) -> None:
        if told.failed:
            raise error or InputError(distributed.ANOTHER_FAILED)
        if told.signal:
            finish()
            raise Interrupted(told.signal)
        if told.save_is_due:
            finish()
            distributed.raise_together(run.save)

    def own() -> Told:
        return Told(error is not None, signals.number, run.save_is_due())

    with contextlib.closing(rest_of_round()) as batches:
        for _ in range(run.steps_left_of_round()):
            batch = None
            try:
                batch = None if error is not None else run.next_batch(batches)
            except Exception as raised:
                error = raised
            told = own()
            heed(run.told if distributed.are_several() else told)
            signals.watch()
            run.start_step(batch, told)
            signals.has_work = True  # before it, XLA compiles the step
            try:
                note = run.finish_step_before()
            except Exception as raised:  # told to the others with the next step
                error, note = raised, None
            if note is not None:
                bar.advance(1, note=note)
        note = None
        try:
            note = run.finish_step()
        except Exception as raised:
            error = raised if error is None else error
        heed(Told(*distributed.all_max(*own())))
        if note is not None:
            bar.advance(1, note=note)
