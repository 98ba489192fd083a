"""The training loop: epochs, validation, early stop, and the files of a run (paper section 4.2)."""

import contextlib
import dataclasses
import functools
import math
import os
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.config.plugins import sources_of
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.file_cache import CACHE_GB, FileCache
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.loader import THREADS, ImageCache
from crisalad_jax.data.places import Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import is_remote, read_remote
from crisalad_jax.nn.model import Crisalad, init_crisalad
from crisalad_jax.training import distributed
from crisalad_jax.training.batches import PlaceBatches, TrainingSet, sets_of
from crisalad_jax.training.callbacks import Callback, Callbacks
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.lost import ends_with_the_others
from crisalad_jax.training.mining import Batches, Miner
from crisalad_jax.training.mixture import check_names
from crisalad_jax.training.run_files import (
    RunFiles,
    RunRecord,
    RunState,
    checksum,
    checksum_of_benchmark,
    checksum_of_config,
    checksum_of_places,
    checksum_of_sizes,
)
from crisalad_jax.training.trainer import LossNotFiniteError, Trainer, run_keys
from crisalad_jax.training.validation import Validator
from crisalad_jax.utils.errors import Interrupted
from crisalad_jax.utils.files import user_cache
from crisalad_jax.utils.progress import Bar, progress_bar
from crisalad_jax.utils.shapes import Float
from crisalad_jax.utils.signals import SignalState, defer_signals, watch

STATUS_STEPS = 5
"""Number of steps from one exchange of status among several processes to the next."""
_T = TypeVar("_T")


@brief
class FitResult(NamedTuple):
    """The result of a training run."""

    params: Crisalad
    """Parameters of the whole model after the last step."""
    steps: int
    best_recall: float | None
    """Best recall by `TrainConfig.monitor`, 0 to 1 (R@1+R@5: 0 to 2); None without validation."""
    stopped_early: bool
    """Whether the run ended before its last epoch, by `TrainConfig.patience` or a callback."""
    skipped_images: int
    """Number of unreadable images that were masked out, counted once per batch they are in."""


@ends_with_the_others
@takes(config=TrainConfig, places=(Places, QuerySet, Mapping), out=PATH)
def fit(
    config: TrainConfig,
    places: TrainingSet,
    out: str | os.PathLike[str],
    *,
    validation: Benchmark | None = None,
    initial: Crisalad | None = None,
    on_bad_image: OnBadImage = "stop",
    num_threads: int | None = None,
    shard_state: bool = False,
    cache_gb: float = CACHE_GB,
    callbacks: Sequence[Callback | str] = (),
    quiet: bool = False,
    targets: Float[np.ndarray, "image target"] | None = None,
) -> FitResult:
    """Train a model, or resume the run in `out`, and write its files there.

    The files are: `config.json`; `metrics.jsonl`, a line for each step and each validation, and the
    same for TensorBoard in `tensorboard/`; `state/`, the checkpoint that a later call resumes from;
    and `last.safetensors`, the weights, with the loss's learnt parameters (`load_loss`). With
    `validation`, there are also `best.safetensors`, the weights with the best recall by
    `config.monitor` (grouping `single`), and the best `config.save_top_k` weights in `best/`.

    A run in `out` with fewer epochs is extended; everything else in `config` must be the same. If
    the learning rate depends on the run's length, a warning says where it jumps.

    A run that is killed at any moment and resumed gives bit-identical results to an uninterrupted
    one (on a CPU; see docs/reliability.md for a GPU).

    Args:
        config: the training configuration.
        places: training images; a `QuerySet` if `config.mining` mines tuples; or the sets of
            `config.mixture`, by name.
        out: folder of the run.
        validation: evaluation set, used every `config.validate_every` epochs.
        initial: parameters to start from; None starts from `init_crisalad` with the run's seed.
        on_bad_image: "stop", or "skip" to mask out unreadable images and count them; validations
            leave them out.
        num_threads: threads that decode images; None is one per core that this process may use.
        shard_state: whether to shard trainable parameters and their moments over the devices.
        cache_gb: maximum gigabytes (1e9 bytes) of remote images cached on this host's disk, in the
            folder `images` of this package's cache; 0 caches none.
        callbacks: objects that are called with the metrics of each step and validation, in the
            primary process; or names of registered callbacks. If one raises `StopTraining`, the run
            ends; the same call resumes it.
        quiet: whether to hide the progress bar.
        targets: a teacher's unit descriptor of each image of `places`, possibly a memory map, for a
            loss that learns from them; all-zero rows leave their images out.

    Returns:
        The final parameters, and how the run ended.

    Raises:
        InputError: nothing in the model trains; an argument is out of range; the validation has no
            ground truth; `out` holds other files, or a run with other settings, data or weights; an
            image cannot be read; there are too few places, classes or images; the loss is no longer
            finite (the state before that step is saved); a file cannot be written; or another
            process of the run is lost (this one then ends without waiting for the others).
        Interrupted: SIGTERM or Ctrl-C was received (in the main thread); the state is saved.

    Example:
        >>> import dataclasses
        >>> from crisalad_jax import read_places, recipe
        >>> config = dataclasses.replace(recipe("tiny"), epochs=1, places_per_batch=4)
        >>> fit(config, read_places(places, min_images=3), folder / "run", quiet=True).steps
        2
    """
    check_names("places", places if isinstance(places, Mapping) else (), config)
    expected = QuerySet if config.mines else Places
    for each in sets_of(places):
        require(
            isinstance(each, expected),
            f"places: found {type(each).__name__} with mining {config.mining.kind!r}, expected "
            f"{expected.__name__}",
        )
    threads = THREADS if num_threads is None else num_threads
    require(threads >= 0, f"num_threads: found {threads}, expected at least 0")
    require(0 <= cache_gb < math.inf, f"--cache-gb: found {cache_gb:g}, expected at least 0")
    called = Callbacks(callbacks)
    images = sum(len(each.files) for each in sets_of(places))
    taught = config.loss.kind.reads_targets
    found = () if targets is None else targets.shape
    require(
        found[:1] == (images,) and len(found) == 2 if taught else not found,
        f"targets: found {f'shape {found}' if found else 'none'} for loss "
        f"{config.loss.kind.part_name}, expected "
        + (f"a descriptor of each of {images} images (`distil` makes them)" if taught else "none"),
    )
    if initial is None:
        initial = init_crisalad(run_keys(config.seed)[0], config.model)
    checksums = {
        "places": checksum_of_places(places),
        "validation": 0 if validation is None else checksum_of_benchmark(validation),
        "weights": checksum(jax.tree.leaves(initial)),
    } | ({} if targets is None else {"targets": checksum(targets)})
    # A mismatch raises in all processes, before the first file is written.
    part = jax.process_index(), jax.process_count()
    configuration = checksum_of_config(config)
    distributed.check_same(
        {"configuration": configuration, "--shard-state": shard_state, **checksums}
    )
    # Each may fail in a single process: at an address, or on its host's disk.
    if part[1] > 1:
        sizes = distributed.raise_together(lambda: checksum_of_sizes(places))
        distributed.check_same({"sizes of images": sizes})
    read_far = distributed.raise_together(lambda: _reader(places, cache_gb))
    cache = ImageCache(read_far=read_far)
    make: Any = Miner if config.mines else PlaceBatches
    data: Batches = make(
        config, places, part=part, on_bad_image=on_bad_image, threads=threads, cache=cache
    )
    trainer = Trainer(config, data, initial, shard_state=shard_state, targets=targets)
    del initial  # the trainer has copied what it needs
    record = RunRecord(checksums, {name: [*source] for name, source in sources_of(config).items()})
    files = RunFiles(pathlib.Path(out), config, record)
    reading = Reading(on_bad_image=on_bad_image, cache=cache, quiet=True)
    validator = Validator(config, validation, reading)
    with contextlib.closing(files):
        state = files.load(RunState(trainer.state, data.mined))
        trainer.resume(state.training)
        data.mined = jax.tree.map(np.asarray, state.mined)
        del state  # the trainer has copied its arrays
        steps, done = data.steps_per_epoch * config.epochs, files.record.step
        called.call("on_start", files.out, config, done)
        called.stopped = bool(*distributed.all_max(called.stopped))
        silent = quiet or not distributed.is_primary()
        bar = progress_bar("training", steps, "steps", quiet=silent, done=done)
        with defer_signals() as signals, bar as bar:
            loop = _Loop(config, data, trainer, validator, files, signals, bar, called)
            loop.train(steps)
        loop.save()
    record = files.record
    best = record.best[0][0] if record.best else None
    stopped = record.stopped_early or (called.stopped and record.step < steps)
    result = FitResult(trainer.params(), record.step, best, stopped, record.skipped_images)
    called.call("on_end", result)
    return result


def _reader(places: TrainingSet, cache_gb: float) -> Callable[[Any], bytes]:
    """Return the reader of remote images, which takes cached ones from this host's disk."""
    if cache_gb == 0 or not any(is_remote(each.root) for each in sets_of(places)):
        return read_remote
    return FileCache(user_cache() / "images", cache_gb * 1e9).read


@dataclasses.dataclass(frozen=True)
class _Loop:
    """The parts of a run, and the phases in which they act."""

    config: TrainConfig
    data: Batches
    trainer: Trainer
    validator: Validator
    files: RunFiles
    signals: SignalState
    bar: Bar
    callbacks: Callbacks

    def train(self, steps: int) -> None:
        """Take the remaining steps up to `steps`; save the state when interrupted."""
        try:
            self._take_rounds(steps)
            # A signal may have arrived while the last validation was saved.
            (number,) = distributed.all_max(self.signals.number)
            if number:
                raise Interrupted(number)
        except LossNotFiniteError:
            self.save()
            raise
        except Interrupted as stopped:
            self.save()
            where = f"after step {self.files.record.step}; the same command resumes"
            raise Interrupted(stopped.number, where) from None

    def _take_rounds(self, steps: int) -> None:
        """Take all rounds, and validate or mine before each one that needs it.

        A round is an epoch, or the part of one for which tuples are mined together.
        """
        while True:
            record = self.files.record
            if self.validator.is_due(record.step, self.data.steps_per_epoch, last=record.validated):
                record = self._validate()
                self.save()
            if record.step == steps or record.stopped_early or self.callbacks.stopped:
                return
            if self.data.is_due(record.step):
                self._mine()
            self._take_round()

    def _take_round(self) -> None:
        """Take the remaining steps of a round, each started before the previous one is logged.

        A single process checks its status before each step. Several exchange theirs every few
        steps, and do not wait for each other in between: one that has failed continues with batches
        without valid images until all know.
        """
        step, per_round = self.files.record.step, self.data.steps_per_round
        every = STATUS_STEPS if jax.process_count() > 1 else 1
        error: Exception | None = None

        def attempt(work: Callable[[], _T]) -> _T | None:
            nonlocal error
            if error is None:
                try:
                    return work()
                except Exception as raised:
                    error = raised
            return None

        batches = self.trainer.on_devices(self.data.batches(step))
        with contextlib.closing(batches):
            for number in range(per_round - step % per_round):
                began = time.monotonic()
                batch = attempt(lambda: next(batches))
                waited = time.monotonic() - began
                if number % every == 0:
                    self._exchange_status(error)
                    if self.callbacks.stopped:
                        return
                watch()
                self.trainer.start_step(batch, waited)
                self.signals.has_work = True  # XLA has compiled the step by now
                attempt(lambda: self._log_steps(leave=1))
            attempt(self._log_steps)
            self._exchange_status(error)

    def _exchange_status(self, error: Exception | None) -> None:
        """Act on the status of all processes: raise an error or a signal, or save."""
        own = 0 if error is None else 1 if isinstance(error, LossNotFiniteError) else 2
        where = jax.process_index() if own else 0
        failed, number, save_is_due, stopped, where = distributed.all_max(
            own, self.signals.number, self.files.save_is_due(), self.callbacks.stopped, where
        )
        if failed:
            # If all have found that the loss is not finite, all raise that, and save together.
            another = distributed.failed_elsewhere(where)
            raise error if error is not None and own == failed else another
        self.callbacks.stopped = bool(stopped)
        if number or save_is_due or stopped:
            distributed.raise_together(self._log_steps)
        if number:
            raise Interrupted(number)
        if save_is_due:
            self.save()

    def _log_steps(self, *, leave: int = 0) -> None:
        """Log the started steps except the last `leave`; raises like `finish_steps`."""
        record = self.files.record
        for values in self.trainer.finish_steps(leave=leave):
            epoch = record.step // self.data.steps_per_epoch + 1
            record.step += 1
            record.skipped_images += int(values["skipped_images"])
            line = {"step": record.step, "epoch": epoch, **values}
            self.files.log(line)
            self.callbacks.call("on_step", line)
            name = "accuracy" if "accuracy" in values else "easy_anchor_fraction"
            note = f"loss {values['loss']:.3f}  {name.split('_')[0]} {values[name]:.2f}"
            self.bar.advance(1, note=f"{note}  {values['images_per_second']:.0f} images/s")

    def _validate(self) -> RunRecord:
        """Validate: log the recalls, save the best weights, and decide whether to stop early."""
        record = self.files.record
        epoch = record.step // self.data.steps_per_epoch
        state = self.trainer.state
        learnt = state.averaged, state.saved_loss(self.config.loss)
        trainable, loss = self.trainer.gather(learnt)

        def validate() -> tuple[str, dict[str, Any], bool]:
            params = self.trainer.params(trainable)
            with self.signals.at_once():
                found = self.validator.validate(params)
            line = {"step": record.step, "epoch": epoch, **found.metrics}
            self.files.log(line, of=self.validator.name)
            record.add_validation(found.monitored, self.config)
            self.files.save_if_best(params, loss)
            self.callbacks.call("on_validation", line)
            return found.words, dataclasses.asdict(record), self.callbacks.stopped

        words, values, self.callbacks.stopped = distributed.run_on_primary(validate)
        self.files.record = RunRecord(**values)
        self.bar.say(f"epoch {epoch}, step {record.step}: {words}")
        return self.files.record

    def _mine(self) -> None:
        """Draw the batches of the next round with the current model."""
        trainable = self.trainer.gather(self.trainer.state.trainable)

        def mine() -> str:
            params = self.trainer.params(trainable)
            describe = functools.partial(self.validator.describe, params)
            with self.signals.at_once():
                return self.data.mine(self.files.record.step, describe)

        self.bar.say(distributed.run_on_primary(mine))
        self.data.mined = jax.tree.map(np.asarray, distributed.broadcast(self.data.mined))

    def save(self) -> None:
        """Write the weights and the state to resume from."""

        def save() -> None:
            state = self.trainer.gather(self.trainer.state)
            params = functools.partial(self.trainer.params, state.averaged)
            self.files.save(RunState(state, self.data.mined), params)

        distributed.raise_together(save)
