"""The training loop: epochs, validation, early stop, and the files of a run (paper section 4.2)."""

import contextlib
import copy
import dataclasses
import functools
import json
import math
import pathlib
import time
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from crisalad_jax import processes
from crisalad_jax.checkpoint import save_weights
from crisalad_jax.config import TrainConfig
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.classes import class_groups
from crisalad_jax.data.loader import (
    ImageBatch,
    ImageCache,
    OnBadImage,
    image_batches,
    one_ahead,
    training_batches,
)
from crisalad_jax.data.places import Places, epoch_batches
from crisalad_jax.errors import InputError, Stopped
from crisalad_jax.evaluation import evaluate
from crisalad_jax.files import write_json
from crisalad_jax.metrics import MetricsLog
from crisalad_jax.model import Crisalad, init_crisalad, tokenise
from crisalad_jax.nn.tokens import TransportStatistics
from crisalad_jax.platform import Devices, devices_for
from crisalad_jax.progress import Bar, progress_bar
from crisalad_jax.serial import differences, read_config, to_plain
from crisalad_jax.states import StateStore
from crisalad_jax.stops import Stop, put_off_signals
from crisalad_jax.training import (
    Metrics,
    StepConfig,
    TrainState,
    init_state,
    merge_params,
    narrow,
    spreads_images,
    train_step,
)

WATCHED_QUERIES = 16
"""So many images show how the transport does, at every validation."""
SAVE_SECONDS = 300
"""Longest time between saved states; validations and the end of a run save too."""


class _Batch(NamedTuple):
    """On the devices."""

    images: jax.Array
    labels: jax.Array
    valid: jax.Array


_Batches = Generator[_Batch, None, None]


class FitResult(NamedTuple):
    """How a run ended."""

    params: Crisalad
    """After the last step."""
    steps: int
    best_recall: float | None
    """Best Recall@5 of a validation, as a fraction; None without validation."""
    stopped_early: bool
    skipped_images: int
    """Unreadable images that were masked out, counted each time they came up."""


@dataclasses.dataclass
class _Record:
    """What a run remembers beside its arrays; plain values, saved with every state."""

    weights_checksum: int
    """Of all parameters before the first step."""
    places_checksum: int
    """Of the names of all training images and of how they make places."""
    validation_checksum: int
    """Of what the validation is; 0 where there is none."""
    validated: int = 0
    """The step of the last validation."""
    best: list[list[Any]] = dataclasses.field(default_factory=list)
    """Recall@5 and step of the best validations, best first."""
    without_gain: int = 0
    stopped_early: bool = False
    skipped_images: int = 0


def fit(
    config: TrainConfig,
    places: Places,
    out: pathlib.Path,
    *,
    validation: Benchmark | None = None,
    initial: Crisalad | None = None,
    on_bad_image: OnBadImage = "stop",
    workers: int = 0,
    split_state: bool = False,
    quiet: bool = False,
) -> FitResult:
    """Train, or go on with the run that `out` holds, and leave its files there.

    Written: `config.json`; `metrics.jsonl`, a line a step and a line a validation, and the same for
    TensorBoard in `tensorboard/`; `state/`, what a later call resumes from; `last.safetensors`; and
    with a validation `best.safetensors`, the weights of the best Recall@5 (every image alone, see
    `groupings.GROUPINGS`), and the best `config.keep_best` in `best/`.

    A run that is killed at any moment and called again ends with the same bits as one that was not.

    Args:
        config: everything but the files.
        places: training images.
        out: folder of the run.
        validation: evaluated every `config.validate_every` epochs, for early stopping.
        initial: parameters to start from; None starts from `init_crisalad` with the run's seed.
        on_bad_image: "stop", or "skip" to mask out unreadable images and count them.
        workers: processes that read the training images; 0 reads them by threads of this one.
        split_state: keep what trains and its moments in parts, one a device, not whole on each.
        quiet: no progress bar.

    Raises:
        InputError: nothing of the model trains; an argument is out of range; the validation has no
            ground truth; `out` holds something else, or a run of another configuration or start; an
            image cannot be read; there are too few places, classes or images; the loss is no longer
            finite (the state before that step is saved); or a file cannot be written.
        Stopped: SIGTERM or Ctrl-C came (in the main thread); the state is saved.
    """
    check_trains(config)
    if workers < 0:
        raise InputError(f"workers: found {workers}, expected at least 0")
    if validation is not None:
        # Asked for now, not after the first epoch.
        validation.ground_truth()
    try:
        run = _Run(config, places, out, initial, validation, split_state=split_state)
        with contextlib.closing(run):
            _train(run, functools.partial(run.rest_of_epoch, on_bad_image, workers), quiet)
            processes.agreed(run.save)
    except OSError as error:
        raise InputError(
            f"{out}: cannot write: {error.strerror or error}; the same command goes on from the "
            "last state that was saved"
        ) from error
    record = run.record
    best = record.best[0][0] if record.best else None
    return FitResult(run.params(), run.step, best, record.stopped_early, record.skipped_images)


def check_trains(config: TrainConfig) -> None:
    """Check that there is something to train: not with AnyLoc, whose vocabulary is of a backbone.

    Raises:
        InputError: there is not.
    """
    if config.model.aggregator == "anyloc":
        raise InputError(
            "aggregator: found anyloc, with which nothing trains, expected another; `crisalad "
            "vocabulary` makes its models"
        )


def _train(run: "_Run", rest_of_epoch: Callable[[], _Batches], quiet: bool) -> None:
    silent = quiet or not processes.leads()
    bar = progress_bar("training", run.steps, "steps", quiet=silent, done=run.step)
    with put_off_signals() as stop, bar as bar:
        if run.classes:
            bar.say(
                f"classes in {len(run.classes)} groups: {min(run.classes)} to {max(run.classes)}"
            )
        try:
            try:
                _take_steps(run, rest_of_epoch, stop, bar)
            except InputError:
                # A signal to a whole group of processes ends those that read images, too.
                stop.check(processes.largest)
                raise
        except Stopped as stopped:
            run.save()
            where = f"after step {run.step}; the same command goes on"
            raise Stopped(stopped.number, where) from None


def _take_steps(run: "_Run", rest_of_epoch: Callable[[], _Batches], stop: Stop, bar: Bar) -> None:
    while not run.is_done():
        if run.validation_is_due():
            bar.say(run.validate(stop))
            processes.agreed(run.save)
        with contextlib.closing(rest_of_epoch()) as batches:
            for batch in processes.together(batches):
                note = processes.agreed(functools.partial(run.take_step, batch))
                bar.advance(1, note=note)
                if processes.largest(run.save_is_due()):
                    processes.agreed(run.save)
                stop.check(processes.largest)


class _Run:
    """The state of a run in memory and its files."""

    def __init__(
        self,
        config: TrainConfig,
        places: Places,
        out: pathlib.Path,
        initial: Crisalad | None,
        validation: Benchmark | None,
        *,
        split_state: bool = False,
    ) -> None:
        # What does not fit raises before claim_run writes the first file, in all processes.
        checksums = {
            "configuration": zlib.crc32(json.dumps(to_plain(config)).encode()),
            "places": checksum_of_places(places),
            "validation": 0 if validation is None else checksum_of_benchmark(validation),
        }
        for what, number in (checksums | {"--split-state": int(split_state)}).items():
            processes.check_same(what, number)
        self._groups = groups_of(config, places)
        self.steps_per_epoch = steps_per_epoch(config, self._groups)
        self.config, self.out = config, out
        self._validation = validation
        self._devices = _devices(config)
        if split_state and self._devices.mesh.size == 1:
            raise InputError(
                "split_state: found one device to keep the state on, expected several; a CPU's do "
                "not share a step where all trains"
            )
        self.steps = self.steps_per_epoch * config.epochs
        self.classes = (
            tuple(len(group.place_id) for group in self._groups) if config.loss.classifies else ()
        )
        self._cache = ImageCache()
        self._compiled = StepConfig(
            config.model,
            config.loss,
            config.optimiser,
            self.steps,
            self.steps_per_epoch,
            config.micro_batch,
            self._devices.mesh if split_state else None,
            self.classes,
        )
        init_key, self._step_key = jax.random.split(jax.random.key(config.seed))
        # 0 and 1 may be what the line above has drawn.
        classifiers_key = jax.random.fold_in(jax.random.key(config.seed), 2)
        params = init_crisalad(init_key, config.model) if initial is None else initial
        state, frozen = init_state(params, config.trains, self._compiled, key=classifiers_key)
        self._frozen: PyTree = jax.device_get(frozen)
        self._frozen_there = self._devices.share(narrow(self._frozen, config.model))
        self.record = _Record(
            weights_checksum=_checksum(jax.tree.leaves(params)),
            places_checksum=checksums["places"],
            validation_checksum=checksums["validation"],
        )
        processes.check_same("weights", self.record.weights_checksum)
        self._files: _Files | None = None
        state = self._open_files(state)
        # A copy of its own on each device: a step takes over the buffers of its state.
        place = self._devices.split if split_state else self._devices.share
        self.state: TrainState = _copied(place(state))
        self._saved_at = self._stepped_at = time.monotonic()

    def _open_files(self, state: TrainState) -> TrainState:
        """Open the run's files, where this process leads; the state that all processes go on from.

        That is the saved one, or `state`.
        """

        def find() -> tuple[int, dict[str, Any]]:
            nonlocal state
            files = _Files(self.out, self.config)
            step, record = 0, dataclasses.asdict(self.record)
            try:
                saved = files.states.load(state)
                if saved is not None:
                    self._check_start(saved.record)
                    step, state, record = saved
                files.go_on(step, _Record(**record), is_saved=saved is not None)
            except BaseException:
                files.states.close()
                raise
            self._files = files
            return step, record

        self.step, record = processes.led(find)
        self.record = _Record(**record)
        return processes.handed_out(state)

    def _check_start(self, saved: Mapping[str, Any]) -> None:
        for what in ("weights", "places", "validation"):
            if saved[f"{what}_checksum"] != getattr(self.record, f"{what}_checksum"):
                raise InputError(
                    f"{self.out}: the run started from other {what} than are given now; "
                    "expected the same, or another folder"
                )

    def is_done(self) -> bool:
        """Whether nothing is left, validations included."""
        trained = self.step == self.steps or self.record.stopped_early
        return trained and not self.validation_is_due()

    def validation_is_due(self) -> bool:
        """Whether the epoch that has just ended asks for a validation that there has not been."""
        epoch, step = divmod(self.step, self.steps_per_epoch)
        asked = epoch % self.config.validate_every == 0 or epoch == self.config.epochs
        new = step == 0 and self.step > self.record.validated
        return self._validation is not None and new and asked

    def rest_of_epoch(self, on_bad_image: OnBadImage, workers: int) -> _Batches:
        """The batches from the next step on to the end of its epoch; none if training is over.

        Each is put on the devices while they are at the one before.
        """
        if self.is_done():
            return
        epoch, start_step = divmod(self.step, self.steps_per_epoch)
        batches = batches_of(
            self.config,
            self._groups[epoch % len(self._groups)],
            epoch,
            steps=self.steps_per_epoch,
            start_step=start_step,
            part=(jax.process_index(), jax.process_count()),
            on_bad_image=on_bad_image,
            workers=workers,
            cache=self._cache,
        )
        yield from one_ahead(
            _Batch(*map(self._devices.spread, (batch.images, batch.labels, batch.valid)))
            for batch in batches
        )

    def params(self) -> Crisalad:
        """The whole model as it is now, in float32; all processes call it."""
        return self._merged(self._devices.whole(self.state.trainable))

    def _merged(self, trainable: PyTree) -> Crisalad:
        return merge_params(trainable, jax.tree.map(jnp.asarray, self._frozen))

    def take_step(self, batch: _Batch) -> str:
        """Train on a batch, log it, and say in a few words how it went."""
        came = time.monotonic()
        self.state, device_metrics = train_step(
            self.state,
            self._frozen_there,
            *batch,
            self._step_key,
            self._compiled,
        )
        metrics = _numbers(device_metrics)
        size = len(batch.images)
        skipped = size - int(metrics.pop("images"))
        if skipped == size:
            raise InputError(
                f"training: found none of the {size} images of step {self.step + 1} readable, "
                "expected at least one"
            )
        judged = {name: metrics[name] for name in ("loss", "b_acc", "gradient_norm")}
        if not all(map(math.isfinite, judged.values())):
            self.save()
            raise InputError(
                f"training: found {_words(judged)} at step {self.step + 1}, expected finite "
                f"numbers; the state after step {self.step} is kept in {self.out}"
            )
        now = time.monotonic()
        seconds, waited = now - self._stepped_at, came - self._stepped_at
        rate, self._stepped_at = size / seconds, now
        self.record.skipped_images += skipped
        self.step += 1
        if self._files is not None:
            self._files.log.write(
                {
                    "step": self.step,
                    "epoch": (self.step - 1) // self.steps_per_epoch + 1,
                    # A plan without any mass has no shares, and JSON no such numbers.
                    **{name: value for name, value in metrics.items() if math.isfinite(value)},
                    "images_per_second": round(rate, 2),
                    "waited_for_images": round(waited / seconds, 4),
                    "skipped_images": skipped,
                }
            )
        note = f"loss {metrics['loss']:.3f}  b_acc {metrics['b_acc']:.2f}  {rate:.0f} images/s"
        if self.record.best:
            note += f"  best R@5 {100 * self.record.best[0][0]:.1f}"
        return note

    def validate(self, stop: Stop) -> str:
        """Log the recalls, keep the best weights, decide on an early stop; the recalls in words.

        The process that leads does it, and the others wait.
        """

        trainable = self._devices.whole(self.state.trainable)

        def validated() -> tuple[str, dict[str, Any]]:
            words = self._validate(self._merged(trainable), stop)
            return words, dataclasses.asdict(self.record)

        words, record = processes.led(validated)
        self.record = _Record(**record)
        self._stepped_at = time.monotonic()
        return words

    def _validate(self, params: Crisalad, stop: Stop) -> str:
        assert self._validation is not None
        assert self._files is not None
        record, benchmark = self.record, self._validation
        with stop.at_once():
            (result,) = evaluate(
                params,
                self.config.model,
                benchmark,
                groupings=("single",),
                cache=self._cache,
                quiet=True,
            )
            watched = self._watch_transport(params, benchmark)
        epoch = self.step // self.steps_per_epoch
        recalls = {f"R@{k}": recall for k, recall in result.recalls.items()}
        line = {"step": self.step, "epoch": epoch, **recalls, **watched}
        self._files.log.write(line, of=benchmark.name)
        found, keep = [result.recalls[5], self.step], self.config.keep_best
        # Of equal ones the first is the best.
        record.best = sorted([*record.best, found], key=lambda one: (-one[0], one[1]))[:keep]
        record.without_gain = 0 if record.best[0] == found else record.without_gain + 1
        self._files.keep_if_best(self.step, record, params)
        patience = self.config.patience
        record.stopped_early = patience is not None and record.without_gain >= patience
        record.validated = self.step
        words = "  ".join(f"{name} {100 * recall:.1f}" for name, recall in recalls.items())
        return f"epoch {epoch}, step {self.step}: {words}"

    def _watch_transport(self, params: Crisalad, benchmark: Benchmark) -> dict[str, float]:
        """Statistics of the transport on the first queries, always the same, without dropout."""
        model = self.config.model
        if model.aggregator != "salad":
            return {}
        paths = benchmark.queries[:WATCHED_QUERIES]
        batches = image_batches(
            paths, image_size=model.image_size, batch_size=len(paths), cache=self._cache
        )
        transport = tokenise(params, next(iter(batches)).images, model).transport
        assert transport is not None
        return _numbers(jax.tree.map(jnp.mean, transport))

    def save_is_due(self) -> bool:
        """Whether the last saved state is old, by the clock of the process that writes them."""
        return self._files is not None and time.monotonic() - self._saved_at > SAVE_SECONDS

    def save(self) -> None:
        """Write the weights and the resumable state, the latter while training goes on."""
        state = self._devices.whole(self.state)
        if self._files is not None:
            params = functools.partial(self._merged, state.trainable)
            self._files.save(self.step, self.record, state, params)
        self._saved_at = self._stepped_at = time.monotonic()

    def close(self) -> None:
        """Wait for what is being written."""
        if self._files is not None:
            self._files.close()


class _Files:
    """What a run leaves in its folder, in the hands of the process that leads."""

    def __init__(self, out: pathlib.Path, config: TrainConfig) -> None:
        claim_run(out, config)
        for folder in (out, out / "best"):
            for path in filter(pathlib.Path.is_file, folder.glob(".*")):
                path.unlink()  # what a killed write left
        self._out, self._config = out, config
        self.states = StateStore(out / "state")
        self._saved: tuple[int, _Record] | None = None

    def go_on(self, step: int, record: _Record, *, is_saved: bool) -> None:
        """Make the files those of a run at this step, whose state may be among them."""
        self._saved = (step, record) if is_saved else None
        self._drop_old_best(record)
        # A validation that the state does not know of will be repeated.
        self.log = MetricsLog(self._out, keep_up_to=step, validated=record.validated)

    def keep_if_best(self, step: int, record: _Record, params: Crisalad) -> None:
        """Write the weights of this step, if the record counts it among the best."""
        steps = [best_step for _, best_step in record.best]
        paths = [self._out / "best.safetensors"] if steps[0] == step else []
        paths += [self._best_path(step)] if self._config.keep_best > 1 and step in steps else []
        for path in paths:
            save_weights(path, params, self._config.model)

    def save(
        self, step: int, record: _Record, state: TrainState, params: Callable[[], Crisalad]
    ) -> None:
        """Write weights and state, unless they are there."""
        record = copy.deepcopy(record)
        if self._saved != (step, record):
            save_weights(self._out / "last.safetensors", params(), self._config.model)
            self.states.save(step, state, dataclasses.asdict(record))
            self._drop_old_best(record)
            self._saved = step, record

    def close(self) -> None:
        """Wait for what is being written."""
        try:
            self.states.close()
        finally:
            self.log.close()

    def _best_path(self, step: int) -> pathlib.Path:
        return self._out / "best" / f"step-{step:08}.safetensors"

    def _drop_old_best(self, record: _Record) -> None:
        """Remove weights that the record does not count among the best, or not yet."""
        kept = {self._best_path(step) for _, step in record.best}
        for path in set((self._out / "best").glob("step-*.safetensors")) - kept:
            self.states.wait()  # or a kill now would leave a state that still counts them
            path.unlink()


def groups_of(config: TrainConfig, places: Places) -> tuple[Places, ...]:
    """What the epochs draw from in turn: all places, or groups of classes (`data.classes`).

    Raises:
        InputError: there are too few classes, or positions are missing.
    """
    if not config.loss.classifies:
        return (places,)
    return class_groups(
        places,
        config.loss.large_margin_cosine,
        min_images=config.min_images,
        places_per_batch=config.places_per_batch,
    )


def steps_per_epoch(config: TrainConfig, groups: Sequence[Places]) -> int:
    """The same in all epochs: as asked for, or so many as take the largest group's places once.

    Raises:
        InputError: a group has too few places or images for a batch.
    """
    if config.loss.classifies and config.loss.large_margin_cosine.steps is not None:
        return config.loss.large_margin_cosine.steps
    return max(
        len(
            epoch_batches(
                group,
                places_per_batch=config.places_per_batch,
                images_per_place=config.images_per_place,
                order=config.batch_order,
                seed=config.seed,
                epoch=0,
            )
        )
        for group in groups
    )


def batches_of(
    config: TrainConfig, places: Places, epoch: int, **options: Any
) -> Iterator[ImageBatch]:
    """The batches of an epoch as a configuration says; `options` are of `training_batches`."""
    return training_batches(
        places,
        image_size=config.model.image_size,
        places_per_batch=config.places_per_batch,
        images_per_place=config.images_per_place,
        order=config.batch_order,
        augment=config.augmentation,
        seed=config.seed,
        epoch=epoch,
        **options,
    )


@jax.jit
def _copied(tree: PyTree) -> PyTree:
    return jax.tree.map(jnp.copy, tree)


def _devices(config: TrainConfig) -> Devices:
    """Those of the images of a step, or where these are not spread one of each process."""
    spread = spreads_images(config.trains)
    images = config.places_per_batch * config.images_per_place
    if images % jax.process_count():
        raise InputError(
            f"processes: found {jax.process_count()}, expected a divisor of {images} images"
        )
    return devices_for(images if spread else jax.process_count(), processes=True)


def _is_kept(path: pathlib.Path) -> bool:
    """Whether it is no temporary file of `atomic_path`."""
    return not path.name.startswith(".")


def claim_run(out: pathlib.Path, config: TrainConfig) -> None:
    """Make `out` the folder of a run with this configuration, or check that it is.

    Raises:
        InputError: what `check_run` raises.
    """
    check_run(out, config)
    path = out / "config.json"
    if not path.exists():
        write_json(path, to_plain(config))


def check_run(out: pathlib.Path, config: TrainConfig) -> None:
    """Check that `out` is the folder of a run with this configuration, or can become one.

    Raises:
        InputError: it holds a run of another configuration, or files but no run.
    """
    path = out / "config.json"
    if path.exists():
        wrong = differences(config, read_config(TrainConfig, path))
        if wrong:
            raise InputError(
                f"{out}: holds a run of another configuration: {'; '.join(wrong)}; give the same "
                "to go on with it, or another folder"
            )
    elif out.exists() and (not out.is_dir() or any(map(_is_kept, out.iterdir()))):
        raise InputError(f"{out}: found files but no run, expected a run or a new or empty folder")


def _text(names: Iterable[Any]) -> np.ndarray:
    return np.frombuffer("\n".join(map(str, names)).encode(), np.uint8)


def checksum_of_places(places: Places) -> int:
    """Of the names of all images, and of how they make places."""
    return _checksum([_text(places.files), places.place_start])


def checksum_of_benchmark(benchmark: Benchmark) -> int:
    """Of its name, which tells its rule, and of its images' names, wherever they lie."""
    names = (path.name for path in (*benchmark.database, *benchmark.queries))
    return _checksum([_text((benchmark.name, *names))])


def _numbers(metrics: Metrics | TransportStatistics) -> dict[str, float]:
    """By name, those of the transport among the others."""
    numbers: dict[str, float] = {}
    for name, value in metrics._asdict().items():
        if isinstance(value, TransportStatistics):
            numbers |= _numbers(value)
        elif value is not None:
            numbers[name] = float(value)
    return numbers


def _words(metrics: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())


def _checksum(arrays: Sequence[Any]) -> int:
    """CRC of all arrays, to tell others from the same."""
    value = 0
    for leaf in arrays:
        value = zlib.crc32(np.asarray(leaf).tobytes(), value)
    return value
