"""A run of training: its state in memory, and what happens to it."""

import dataclasses
import functools
import json
import math
import pathlib
import time
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from crisalad_jax.config.io import to_plain
from crisalad_jax.config.plugins import changed_sources, sources_of
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.loader import ImageCache, OnBadImage, one_ahead
from crisalad_jax.data.places import Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.model import Crisalad, cast_params, extract_tokens, init_crisalad
from crisalad_jax.nn.tokens import TransportStatistics
from crisalad_jax.retrieval.alone import describe_alone
from crisalad_jax.retrieval.photographs import photograph_batches
from crisalad_jax.training.batches import (
    Rounds,
    batches_of,
    batches_of_tuples,
    groups_of,
    rounds_of,
    steps_per_epoch,
)
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.memory import check_memory, memory_limit, memory_of
from crisalad_jax.training.mining import (
    Mined,
    describe_mined,
    draw_queries,
    mine_tuples,
    no_tuples,
)
from crisalad_jax.training.optimiser import (
    count_steps,
    learning_rate_schedule,
)
from crisalad_jax.training.run_files import (
    RunFiles,
    RunRecord,
    RunState,
    checksum,
    checksum_of_benchmark,
    checksum_of_places,
)
from crisalad_jax.training.step import (
    Metrics,
    TrainState,
    init_train_state,
    step_config,
    train_step,
)
from crisalad_jax.training.trainable import merge_params, shards_batch
from crisalad_jax.utils import distributed
from crisalad_jax.utils.devices import Devices, devices_for
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.signals import SignalState

WATCHED_QUERIES = 16
"""Number of images whose transport statistics every validation logs."""
SELECTED = {"R@1": (1,), "R@5": (5,), "R@1+R@5": (1, 5)}
"""Ranks whose recalls are added, by `TrainConfig.select_by`."""
DESCRIBED_AT_ONCE = 16
"""Number of images of a batch while tuples are mined."""
SAVE_SECONDS = 300
"""Longest time between saved states; validations and the end of a run save too."""


class Batch(NamedTuple):
    """A batch on the devices."""

    images: jax.Array
    labels: jax.Array
    valid: jax.Array


class Told(NamedTuple):
    """What a process tells the others, beside a step or between steps."""

    failed: int = 0
    """1 after an error, 0 without one."""
    signal: int = 0
    """Number of the last signal, 0 for none."""
    save_is_due: int = 0
    """1 where the last saved state is old."""


class _Pending(NamedTuple):
    """A step that the devices may still be computing."""

    metrics: Metrics
    images: int
    waited: float
    """Seconds of waiting for its images."""


class Run:
    """The state of a run in memory and its files."""

    def __init__(
        self,
        config: TrainConfig,
        places: Places | QuerySet,
        out: pathlib.Path,
        initial: Crisalad | None,
        validation: Benchmark | None,
        *,
        shard_state: bool = False,
    ) -> None:
        """Begin a run, or resume the one in `out`; see `fit` for the arguments."""
        # Arguments that do not fit raise in all processes, before the first file is written.
        checksums = {
            "configuration": zlib.crc32(json.dumps(to_plain(config)).encode()),
            "places": checksum_of_places(places),
            "validation": 0 if validation is None else checksum_of_benchmark(validation),
        }
        for what, number in (checksums | {"--shard-state": int(shard_state)}).items():
            distributed.check_same(what, number)
        check_set(config, places)
        self._queries = places if isinstance(places, QuerySet) else None
        if isinstance(places, QuerySet):
            self._groups: tuple[Places, ...] = ()
            self._rounds = rounds_of(config, places)
        else:
            self._groups = groups_of(config, places)
            self._rounds = Rounds(1, steps_per_epoch(config, self._groups))
        self.steps_per_epoch = self._rounds.count * self._rounds.steps
        self.config, self.out = config, out
        self._validation = validation
        self._devices = _devices(config)
        if shard_state and self._devices.mesh.size == 1:
            raise InputError(
                "shard_state: found one device to keep the state on, expected several; a CPU's do "
                "not share a step where all trains"
            )
        self.steps = self.steps_per_epoch * config.epochs
        if self.steps >= 2**31:
            raise InputError(
                f"epochs: found {config.epochs}, which is {self.steps} steps, expected fewer than "
                "2**31, by which JAX counts"
            )
        self.classes = (
            tuple(len(group.place_id) for group in self._groups)
            if config.loss.kind.grouping is not None
            else ()
        )
        self._cache = ImageCache()
        step = step_config(
            config,
            steps=self.steps,
            steps_per_epoch=self.steps_per_epoch,
            classes=self.classes,
        )
        mesh = self._devices.mesh if shard_state else None
        self._step_config = dataclasses.replace(step, shard_over=mesh)
        self._all_is_well = self._devices.replicate(np.asarray(True))
        init_key, self._step_key = jax.random.split(jax.random.key(config.seed))
        # Folds in 2, because folding in 0 or 1 may repeat the keys of the split above.
        classifiers_key = jax.random.fold_in(jax.random.key(config.seed), 2)
        params = init_crisalad(init_key, config.model) if initial is None else initial
        state, frozen = init_train_state(
            params, config.trainable, self._step_config, key=classifiers_key
        )
        self._frozen: PyTree = jax.device_get(frozen)
        self._frozen_there = self._devices.replicate(cast_params(self._frozen, config.model))
        self.record = RunRecord(
            weights_checksum=checksum(jax.tree.leaves(params)),
            places_checksum=checksums["places"],
            validation_checksum=checksums["validation"],
            sources={name: list(source) for name, source in sources_of(config).items()},
        )
        distributed.check_same("weights", self.record.weights_checksum)
        # A step that does not fit raises before the first file too.
        place = self._devices.shard if shard_state else self._devices.replicate
        self._check_memory(state, place)
        self._files: RunFiles | None = None
        mined = None
        if isinstance(places, QuerySet):
            tuples = self._rounds.steps * config.places_per_batch
            mined = no_tuples(config.mining, places, tuples)
        saved = self._open_files(RunState.of(state, mined))
        # Copied, because a step donates the buffers of its state.
        self.state: TrainState = _copied(place(saved.of_training))
        self._mined: Mined | None = None
        if saved.mined is not None:
            self._mined = Mined(*map(np.asarray, saved.mined))
        self._before: _Pending | None = None
        self._pending: _Pending | None = None
        self._saved_at = self._stepped_at = time.monotonic()
        self._waited = 0.0
        self.told = Told()
        """What several processes told with the last finished step, the largest of each."""

    def _check_memory(self, state: TrainState, place: Callable[[TrainState], TrainState]) -> None:
        """Check that the devices have the memory of a step; see `check_memory`."""
        limit = memory_limit(self._devices.mesh.local_devices)
        if limit is None:
            return

        def compiled_size(micro_batch: int | None) -> int:
            config = dataclasses.replace(self._step_config, micro_batch=micro_batch)
            lowered = train_step.lower(*arguments, config, self._all_is_well, *told)
            return memory_of(lowered.compile())

        batch, told = self._no_images(), self._with_step(Told())
        arguments = place(state), self._frozen_there, *batch, self._step_key
        check_memory(compiled_size, self.config, limit, self._devices.mesh.size)

    def _open_files(self, state: RunState) -> RunState:
        """Open the run's files in the primary process; return the saved state, or `state`."""

        def find() -> tuple[int, dict[str, Any]]:
            nonlocal state
            files = RunFiles(self.out, self.config)
            step, record = 0, dataclasses.asdict(self.record)
            try:
                saved = files.load(state)
                if saved is not None:
                    self._check_start(saved.record)
                    step, state, record = saved
                if files.extends is not None and saved is not None:
                    self._tell_of_extension(files.extends, step, saved.record)
                files.go_on(step, RunRecord(**record), is_saved=saved is not None)
            except BaseException:
                files.close()
                raise
            self._files = files
            return step, record

        self.step, record = distributed.run_on_primary(find)
        self.record = RunRecord(**record)
        return distributed.broadcast(state)

    def _check_start(self, saved: Mapping[str, Any]) -> None:
        for what in ("weights", "places", "validation"):
            if saved[f"{what}_checksum"] != getattr(self.record, f"{what}_checksum"):
                raise InputError(
                    f"{self.out}: the run started from other {what} than are given now; "
                    "expected the same, or another folder"
                )

        changed = changed_sources(self.config, saved["sources"])
        if changed:
            raise InputError(
                f"{self.out}: found another source of {', '.join(changed)} than the run began "
                "with; expected the same, or another folder"
            )

    def _tell_of_extension(self, epochs: int, step: int, record: Mapping[str, Any]) -> None:
        """Tell in a note how a run that is given more epochs differs from one of them at once."""
        if record["stopped_early"]:
            warn(
                f"{self.out}: the run stopped early at step {step}, by patience "
                f"{self.config.patience}, which more epochs do not change"
            )
            return
        lengths = epochs * self.steps_per_epoch, self.steps
        before, now = (self._learning_rate(step, length) for length in lengths)
        # Up to the end of a warm-up the steps that were taken are those of any length.
        taken = {self._learning_rate(step - 1, length) for length in lengths}
        if step and len(taken) > 1:
            warn(
                f"{self.out}: the learning rate falls over the whole run, so that it jumps from "
                f"{before:.3g} to {now:.3g} at step {step}: this is not the run of "
                f"{self.config.epochs} epochs at once; --optimiser.decay-steps keeps a fall's "
                "length"
            )

    def _learning_rate(self, step: int, steps: int) -> float:
        """Return the learning rate after so many steps of a run of `steps`."""
        optimiser = self.config.optimiser
        rate = learning_rate_schedule(optimiser, steps, self.steps_per_epoch)
        taken = count_steps(optimiser, step, self.steps_per_epoch)
        return np.asarray(rate(jnp.asarray(taken))).item()

    def is_done(self) -> bool:
        """Return whether no step and no validation is left."""
        trained = self.step == self.steps or self.record.stopped_early
        return trained and not self.validation_is_due()

    def validation_is_due(self) -> bool:
        """Return whether the epoch that has just ended still needs its validation."""
        epoch, step = divmod(self.step, self.steps_per_epoch)
        asked = epoch % self.config.validate_every == 0 or epoch == self.config.epochs
        new = step == 0 and self.step > self.record.validated
        return self._validation is not None and new and asked

    def mining_is_due(self) -> bool:
        """Return whether the round that begins now still needs its tuples."""
        if self._mined is None or self.is_done():
            return False
        return self.step % self._rounds.steps == 0 and int(self._mined.step) != self.step

    def mine(self, on_bad_image: OnBadImage, signals: SignalState) -> str:
        """Mine the tuples of the round that begins, by the model as it is.

        The primary process mines, and the others wait. States that are saved in the round have its
        tuples; one from before mines again.

        Returns:
            How hard they are, in words.
        """
        assert self._queries is not None
        assert self._mined is not None
        queries, mined = self._queries, self._mined
        params, words = self.params(), ""

        def on_primary() -> None:
            nonlocal mined, words
            with signals.at_once():
                mined, words = self._mine(params, queries, mined, on_bad_image)

        distributed.run_on_primary(on_primary)
        self._mined = Mined(*map(np.asarray, distributed.broadcast(tuple(mined))))
        self._stepped_at = time.monotonic()
        return words

    def _mine(
        self, params: Crisalad, queries: QuerySet, before: Mined, on_bad_image: OnBadImage
    ) -> tuple[Mined, str]:
        """Return the tuples, and how hard they are in words."""
        config, unreadable = self.config, 0
        epoch, step = divmod(self.step, self.steps_per_epoch)
        chosen = draw_queries(
            config.mining,
            len(queries.queries),
            self._rounds.steps * config.places_per_batch,
            seed=config.seed,
            epoch=epoch,
            number=step // self._rounds.steps,
        )

        def describe(images: np.ndarray) -> np.ndarray:
            nonlocal unreadable
            rows = np.full((len(images), config.model.descriptor_dim), np.nan, np.float32)
            stream = describe_alone(
                params,
                config.model,
                [queries.path(image) for image in images],
                batch_size=DESCRIBED_AT_ONCE,
                on_bad_image=on_bad_image,
                cache=self._cache,
            )
            for part in stream:
                rows[part.indices] = part.descriptors
                unreadable += len(part.unreadable)
            return rows

        mined = mine_tuples(
            config.mining,
            queries,
            chosen,
            before.hardest,
            describe,
            seed=config.seed,
            step=self.step,
        )
        words = describe_mined(mined)
        return mined, words + (f"; {unreadable} unreadable images left out" if unreadable else "")

    def rest_of_round(self, on_bad_image: OnBadImage, threads: int) -> Generator[Batch, None, None]:
        """Yield the batches from the next step to the end of its round; none if the run is done.

        Each is copied to the devices while they compute the one before.
        """
        if self.is_done():
            return
        options: dict[str, Any] = {
            "start_step": self.step % self._rounds.steps,
            "part": (jax.process_index(), jax.process_count()),
            "on_bad_image": on_bad_image,
            "threads": threads,
            "cache": self._cache,
        }
        if self._queries is not None:
            assert self._mined is not None
            batches = batches_of_tuples(self.config, self._queries, self._mined, **options)
        else:
            epoch = self.step // self.steps_per_epoch
            batches = batches_of(
                self.config,
                self._groups[epoch % len(self._groups)],
                epoch,
                steps=self.steps_per_epoch,
                **options,
            )
        yield from one_ahead(
            Batch(*map(self._devices.shard_batch, (batch.images, batch.labels, batch.valid)))
            for batch in batches
        )

    def params(self) -> Crisalad:
        """Gather the whole model as it is now, in float32; all processes call it together."""
        return self._merged(self._devices.gather(self.state.trainable))

    def _merged(self, trainable: PyTree) -> Crisalad:
        return merge_params(trainable, jax.tree.map(jnp.asarray, self._frozen), self.config.model)

    def next_batch(self, batches: Iterator[Batch]) -> Batch | None:
        """Wait for the next batch of an epoch; return None after the last."""
        begin = time.monotonic()
        batch = next(batches, None)
        self._waited = time.monotonic() - begin
        return batch

    def steps_left_of_round(self) -> int:
        """Return how many steps of the round are to be taken; 0 if the run is done."""
        return 0 if self.is_done() else self._rounds.steps - self.step % self._rounds.steps

    def start_step(self, batch: Batch | None, told: Told) -> None:
        """Start a step, while the devices may still compute the one before.

        Args:
            batch: the images; None where this process has failed to read them. Then no process
                takes the step, which all start.
            told: of several processes, what this one tells the others with the step.
        """
        before = self._before = self._pending
        proceed: Any = self._all_is_well if before is None else before.metrics.updated
        batch = self._no_images() if batch is None else batch
        self.state, metrics = train_step(
            self.state,
            self._frozen_there,
            *batch,
            self._step_key,
            self._step_config,
            proceed,
            *self._with_step(told),
        )
        self._pending = _Pending(metrics, len(batch.images), self._waited)

    def finish_step_before(self) -> str | None:
        """Finish the step before the one that was started last, as `finish_step`."""
        before, self._before = self._before, None
        return self._finish(before)

    def _with_step(self, told: Told) -> tuple[jax.Array, ...]:
        """Return what a step tells the other processes, if there are others."""
        if not distributed.are_several():
            return ()
        rows = np.tile(np.array(told, np.int32), (self._devices.mesh.local_mesh.size, 1))
        return (self._devices.shard_batch(rows),)

    def _no_images(self) -> Batch:
        """Return a batch of images that are not valid."""
        count = self.config.places_per_batch * self.config.images_per_place
        own = count // jax.process_count()
        size = (own, *self.config.model.input_size, 3)
        parts = np.zeros(size, np.uint8), np.full(own, -1, np.int32), np.zeros(own, bool)
        return Batch(*map(self._devices.shard_batch, parts))

    def finish_step(self) -> str | None:
        """Wait for the step that was started last, if any, and log it.

        Returns:
            How it went, in a few words; None where all steps are finished.

        Raises:
            InputError: no image was readable, or the loss is not finite; the state before that step
                is saved.
        """
        pending, self._pending = self._pending, None
        return self._finish(pending)

    def _finish(self, pending: _Pending | None) -> str | None:
        if pending is None:
            return None
        fetched, size = jax.device_get(pending.metrics), pending.images
        if fetched.told is not None:
            self.told = Told(*fetched.told.tolist())
            if self.told.failed:
                return None  # which the caller raises, in all processes alike
        metrics = _numbers(fetched._replace(told=None))
        skipped = size - int(metrics.pop("images"))
        if not metrics.pop("updated"):
            self._pending = None  # the step after it was skipped as well
            self._refuse(metrics, size, skipped)
        now = time.monotonic()
        seconds, self._stepped_at = now - self._stepped_at, now
        self.record.skipped_images += skipped
        self.step += 1
        if self._files is not None:
            self._files.log_step(
                {
                    "step": self.step,
                    "epoch": (self.step - 1) // self.steps_per_epoch + 1,
                    # The shares of a transport plan without mass are NaN, which JSON lacks.
                    **{name: value for name, value in metrics.items() if math.isfinite(value)},
                    "images_per_second": round(size / seconds, 2),
                    "waited_for_images": round(min(pending.waited / seconds, 1), 4),
                    "skipped_images": skipped,
                }
            )
        note = f"loss {metrics['loss']:.3f}  "
        if "accuracy" in metrics:
            note += f"accuracy {metrics['accuracy']:.2f}"
        else:
            note += f"easy anchors {metrics['easy_anchor_fraction']:.2f}"
        note += f"  {size / seconds:.0f} images/s"
        if self.record.best:
            note += f"  best {self.config.select_by} {100 * self.record.best[0][0]:.1f}"
        return note

    def _refuse(self, metrics: Mapping[str, int | float], size: int, skipped: int) -> None:
        """Raise the error of a step that was not taken."""
        if skipped == size:
            raise InputError(
                f"training: found none of the {size} images of step {self.step + 1} readable, "
                "expected at least one"
            )
        self.save()
        numbers = ", ".join(f"{name} {metrics[name]:.4g}" for name in ("loss", "gradient_norm"))
        raise InputError(
            f"training: found {numbers} at step {self.step + 1}, expected finite numbers; the "
            f"state after step {self.step} is kept in {self.out}"
        )

    def validate(self, signals: SignalState, on_bad_image: OnBadImage = "stop") -> str:
        """Log the recalls, keep the best weights, and decide on an early stop.

        The primary process evaluates, and the others wait.

        Returns:
            The recalls in words.
        """
        trainable = self._devices.gather(self.state.trainable)

        def validated() -> tuple[str, dict[str, Any]]:
            words = self._validate(self._merged(trainable), on_bad_image, signals)
            return words, dataclasses.asdict(self.record)

        words, record = distributed.run_on_primary(validated)
        self.record = RunRecord(**record)
        self._stepped_at = time.monotonic()
        return words

    def _validate(self, params: Crisalad, on_bad_image: OnBadImage, signals: SignalState) -> str:
        assert self._validation is not None
        assert self._files is not None
        record, benchmark = self.record, self._validation
        with signals.at_once():
            (result,) = evaluate(
                params,
                self.config.validation_model,
                benchmark,
                groupings=("single",),
                cache=self._cache,
                on_bad_image=on_bad_image,
                quiet=True,
            )
            watched = self._watch_transport(params, result.skipped.rest_of(benchmark))
        epoch = self.step // self.steps_per_epoch
        recalls = {f"R@{k}": recall for k, recall in result.recalls.items()}
        line = {"step": self.step, "epoch": epoch, **recalls, **watched}
        self._files.log_step(line, of=benchmark.name)
        selected = sum(result.recalls[k] for k in SELECTED[self.config.select_by])
        newest, keep = [selected, self.step], self.config.keep_best
        # Of equal recalls the first counts as the best.
        record.best = sorted([*record.best, newest], key=lambda best: (-best[0], best[1]))[:keep]
        record.without_gain = 0 if record.best[0] == newest else record.without_gain + 1
        self._files.keep_if_best(self.step, record, params)
        patience = self.config.patience
        record.stopped_early = patience is not None and record.without_gain >= patience
        record.validated = self.step
        words = "  ".join(f"{name} {100 * recall:.1f}" for name, recall in recalls.items())
        skipped = sum(map(len, result.skipped))
        if skipped:
            words += f"; {skipped} unreadable images left out"
        return f"epoch {epoch}, step {self.step}: {words}"

    def _watch_transport(self, params: Crisalad, benchmark: Benchmark) -> dict[str, float]:
        """Compute statistics of the transport on the first queries, without dropout."""
        model = self.config.validation_model
        paths = benchmark.queries[:WATCHED_QUERIES]
        batches = photograph_batches(model, paths, batch_size=len(paths), cache=self._cache)
        batch = next(iter(batches))  # of the size of the first, where sizes differ
        transport = extract_tokens(params, batch.images[batch.valid], model).transport
        return (
            {} if transport is None else _numbers(jax.device_get(jax.tree.map(jnp.mean, transport)))
        )

    def save_is_due(self) -> bool:
        """Return whether the last saved state is old, by the primary process's clock."""
        return self._files is not None and time.monotonic() - self._saved_at > SAVE_SECONDS

    def save(self) -> None:
        """Write the weights and the state to resume from; the state while training goes on.

        Raises:
            InputError: what `finish_step` raises, or a file cannot be written.
        """
        self.finish_step()
        state = self._devices.gather(self.state)
        if self._files is not None:
            params = functools.partial(self._merged, state.trainable)
            arrays = RunState.of(state, self._mined)
            self._files.save(self.step, self.record, arrays, params)
        self._saved_at = self._stepped_at = time.monotonic()
        self.told = Told()  # whose processes did not know that this would save

    def close(self) -> None:
        """Wait for files that are being written, and close them."""
        if self._files is not None:
            self._files.close()


def check_set(config: TrainConfig, places: Places | QuerySet) -> None:
    """Check that a training set is what a configuration trains on: places, or queries.

    Raises:
        InputError: it is not.
    """
    if config.mines != isinstance(places, QuerySet):
        found, expected = ("places", "a QuerySet") if config.mines else ("a QuerySet", "places")
        raise InputError(
            f"places: found {found} with mining {config.mining.kind!r}, expected {expected}"
        )


@jax.jit
def _copied(tree: PyTree) -> PyTree:
    return jax.tree.map(jnp.copy, tree)


def _devices(config: TrainConfig) -> Devices:
    """Choose the devices of a step: all that share its images, or one for each process."""
    spread = shards_batch(config.trainable)
    images = config.places_per_batch * config.images_per_place
    if images % jax.process_count():
        raise InputError(
            f"processes: found {jax.process_count()}, expected a divisor of {images} images"
        )
    devices = devices_for(images if spread else jax.process_count(), processes=True)
    found, used = len(jax.devices()), devices.mesh.size
    if spread and used < found and distributed.is_primary():
        warn(
            f"training: found {found} devices for {images} images a step, of which {used} share "
            "them, the most that divide them in each process"
        )
    return devices


def _numbers(metrics: Metrics | TransportStatistics) -> dict[str, float]:
    """List metrics by name, those of the transport among them."""
    numbers: dict[str, float] = {}
    for name, value in metrics._asdict().items():
        if isinstance(value, TransportStatistics):
            numbers |= _numbers(value)
        elif value is not None:
            numbers[name] = float(value)
    return numbers
