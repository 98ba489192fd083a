"""The training loop: epochs, validation, early stop, and the files of a run (paper section 4.2)."""

import dataclasses
import json
import math
import pathlib
import time
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from crisalad_jax.checkpoint import save_weights
from crisalad_jax.config import TrainConfig
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.loader import (
    ImageBatch,
    ImageCache,
    OnBadImage,
    image_batches,
    training_batches,
)
from crisalad_jax.data.places import Places, epoch_batches
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import evaluate
from crisalad_jax.files import atomic_path, write_json
from crisalad_jax.model import Crisalad, init_crisalad, watch_transport
from crisalad_jax.platform import on_every_device, on_one_device, over_devices
from crisalad_jax.progress import progress_bar
from crisalad_jax.serial import differences, read_config, to_plain
from crisalad_jax.states import StateStore
from crisalad_jax.training import (
    StepConfig,
    TrainState,
    init_state,
    learning_rate_schedule,
    merge_params,
    spreads_images,
    train_step,
)

WATCHED_QUERIES = 16
"""So many images show how the transport does, at every validation."""
SAVE_SECONDS = 300
"""Longest time between saved states; validations and the end of a run save too."""


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
    best_recall: float | None = None
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
    quiet: bool = False,
) -> FitResult:
    """Train, or go on with the run that `out` holds, and leave its files there.

    Written: `config.json`; `metrics.jsonl`, a line a step and a line a validation; `state/`, what a
    later call resumes from; `last.safetensors`; and with a validation `best.safetensors`, the
    weights of the best Recall@5 (every image alone, see `evaluation.GROUPINGS`).

    Args:
        config: everything but the files.
        places: training images.
        out: folder of the run.
        validation: evaluated every `config.validate_every` epochs, for early stopping.
        initial: parameters to start from; None starts from `init_crisalad` with the run's seed.
        on_bad_image: "stop", or "skip" to mask out unreadable images and count them.
        quiet: no progress bar.

    Raises:
        InputError: `out` holds something else, or a run of another configuration or start; an image
            cannot be read; there are too few places or images; or the loss is no longer finite (the
            state before that step is saved).
    """
    run = _Run(config, places, out, initial)
    with progress_bar("training", run.steps, "steps", quiet=quiet, done=run.step) as bar:
        while run.step < run.steps and not run.record.stopped_early:
            epoch, start_step = divmod(run.step, run.steps_per_epoch)
            batches = training_batches(
                places,
                image_size=config.model.image_size,
                places_per_batch=config.places_per_batch,
                images_per_place=config.images_per_place,
                order=config.batch_order,
                augment=config.augmentation,
                seed=config.seed,
                epoch=epoch,
                start_step=start_step,
                on_bad_image=on_bad_image,
                cache=run.cache,
            )
            for batch in batches:
                bar.advance(1, note=run.take_step(batch, epoch))
            ended = epoch + 1
            if validation is not None and (
                ended % config.validate_every == 0 or ended == config.epochs
            ):
                bar.say(run.validate(validation, ended))
                run.save()
    run.save()
    run.store.close()
    record = run.record
    return FitResult(
        run.params(), run.step, record.best_recall, record.stopped_early, record.skipped_images
    )


class _Run:
    """The state of a run in memory and its files."""

    def __init__(
        self, config: TrainConfig, places: Places, out: pathlib.Path, initial: Crisalad | None
    ) -> None:
        # What does not fit raises before claim_run writes the first file.
        self.steps_per_epoch = len(
            epoch_batches(
                places,
                places_per_batch=config.places_per_batch,
                images_per_place=config.images_per_place,
                order=config.batch_order,
                seed=config.seed,
                epoch=0,
            )
        )
        self.config, self.out = config, out
        self._spread = spreads_images(config.trains)
        self.steps = self.steps_per_epoch * config.epochs
        self.cache = ImageCache()
        self._compiled = StepConfig(config.model, config.loss, config.optimiser, self.steps)
        self._schedule = learning_rate_schedule(config.optimiser, self.steps)
        init_key, self._step_key = jax.random.split(jax.random.key(config.seed))
        params = init_crisalad(init_key, config.model) if initial is None else initial
        state, frozen = init_state(params, config.trains, self._compiled)
        self._frozen = self._share(frozen)
        claim_run(out, config)
        self.store = StateStore(out / "state")
        self.record = _Record(
            weights_checksum=_checksum(jax.tree.leaves(params)),
            places_checksum=_checksum(
                [np.frombuffer("\n".join(places.files).encode(), np.uint8), places.place_start]
            ),
        )
        self.step = 0
        saved = self.store.load(state)
        if saved is not None:
            for what in ("weights", "places"):
                if saved.record[f"{what}_checksum"] != getattr(self.record, f"{what}_checksum"):
                    raise InputError(
                        f"{out}: the run started from other {what} than are given now; "
                        "expected the same, or another folder"
                    )
            self.step, state, self.record = saved.step, saved.state, _Record(**saved.record)
        # A copy of its own on each device: a step takes over the buffers of its state.
        self.state: TrainState = jax.tree.map(jnp.copy, self._share(state))
        self._log = MetricsLog(out / "metrics.jsonl", keep_up_to=self.step)
        self._saved_at = self._stepped_at = time.monotonic()

    def _share(self, tree: PyTree) -> PyTree:
        """On the devices that the images of a batch are spread over."""
        batch = self.config.places_per_batch * self.config.images_per_place
        return on_every_device(tree, batch if self._spread else 1)

    def params(self) -> Crisalad:
        return merge_params(*on_one_device((self.state.trainable, self._frozen)))

    def take_step(self, batch: ImageBatch, epoch: int) -> str:
        """Train on a batch, log it, and say in a few words how it went."""
        if not batch.valid.any():
            raise InputError(
                f"training: found none of the {len(batch.valid)} images of step {self.step + 1} "
                "readable, expected at least one"
            )
        # Before the step: after an epoch's last one its validation still has to enter the state.
        if time.monotonic() - self._saved_at > SAVE_SECONDS:
            self.save()
        self.state, device_metrics = train_step(
            self.state,
            self._frozen,
            over_devices(batch.images) if self._spread else batch.images,
            batch.labels,
            batch.valid,
            self._step_key,
            self._compiled,
        )
        metrics = {name: float(value) for name, value in device_metrics._asdict().items()}
        if not all(math.isfinite(value) for value in metrics.values()):
            self.save()
            raise InputError(
                f"training: found {_words(metrics)} at step {self.step + 1}, expected finite "
                f"numbers; the state after step {self.step} is kept in {self.out}"
            )
        now = time.monotonic()
        rate, self._stepped_at = len(batch.images) / (now - self._stepped_at), now
        skipped = int((~batch.valid).sum())
        self.record.skipped_images += skipped
        learning_rate = float(np.asarray(self._schedule(self.step)))
        self.step += 1
        self._log.write(
            {
                "step": self.step,
                "epoch": epoch + 1,
                **metrics,
                "learning_rate": learning_rate,
                "images_per_second": round(rate, 2),
                "skipped_images": skipped,
            }
        )
        note = f"loss {metrics['loss']:.3f}  b_acc {metrics['b_acc']:.2f}  {rate:.0f} images/s"
        if self.record.best_recall is not None:
            note += f"  best R@5 {100 * self.record.best_recall:.1f}"
        return note

    def validate(self, benchmark: Benchmark, epoch: int) -> str:
        """Log the recalls, keep the best weights, decide on an early stop; the recalls in words."""
        params, record = self.params(), self.record
        (result,) = evaluate(
            params,
            self.config.model,
            benchmark,
            groupings=("single",),
            cache=self.cache,
            quiet=True,
        )
        recalls = {f"R@{k}": recall for k, recall in result.recalls.items()}
        watched = self._watch_transport(params, benchmark)
        self._log.write({"step": self.step, "epoch": epoch, **recalls, **watched})
        if record.best_recall is None or result.recalls[5] > record.best_recall:
            record.best_recall, record.without_gain = result.recalls[5], 0
            save_weights(self.out / "best.safetensors", params, self.config.model)
        else:
            record.without_gain += 1
        patience = self.config.patience
        record.stopped_early = patience is not None and record.without_gain >= patience
        self._stepped_at = time.monotonic()
        words = "  ".join(f"{name} {100 * recall:.1f}" for name, recall in recalls.items())
        return f"epoch {epoch}, step {self.step}: {words}"

    def _watch_transport(self, params: Crisalad, benchmark: Benchmark) -> dict[str, float]:
        """Statistics of the transport on the first queries, always the same ones."""
        model = self.config.model
        if model.aggregator != "salad":
            return {}
        paths = benchmark.queries[:WATCHED_QUERIES]
        batches = image_batches(
            paths, image_size=model.image_size, batch_size=len(paths), cache=self.cache
        )
        statistics = watch_transport(params, next(iter(batches)).images, model)
        return {name: float(value) for name, value in statistics._asdict().items()}

    def save(self) -> None:
        """Write the weights and the resumable state."""
        save_weights(self.out / "last.safetensors", self.params(), self.config.model)
        self.store.save(self.step, self.state, dataclasses.asdict(self.record))
        self._saved_at = time.monotonic()


def claim_run(out: pathlib.Path, config: TrainConfig) -> None:
    """Make `out` the folder of a run with this configuration, or check that it is.

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
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: found files but no run, expected a run or a new or empty folder")
    else:
        write_json(path, to_plain(config))


class MetricsLog:
    """A file of JSON lines, one a step and one a validation."""

    def __init__(self, path: pathlib.Path, *, keep_up_to: int) -> None:
        """Open the log and drop lines past step `keep_up_to`, which a resumed run repeats."""
        self._path = path
        kept = [r for r in read_metrics(path) if r["step"] <= keep_up_to] if path.exists() else []
        with atomic_path(path) as temporary:
            temporary.write_text("".join(map(_line, kept)), encoding="utf-8")

    def write(self, values: Mapping[str, float]) -> None:
        """Append a line."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(_line(values))


def _line(values: Mapping[str, float]) -> str:
    return json.dumps(values) + "\n"


def read_metrics(path: pathlib.Path) -> list[dict[str, Any]]:
    """The lines of a metrics file; a last line that was cut off by a kill is left out.

    Raises:
        InputError: the file is missing, or a line is no record of a step.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
        records = [json.loads(line) for line in lines[:-1]]
        if not all(isinstance(r, dict) and type(r.get("step")) is int for r in records):
            raise ValueError("a line has no step")
        return records
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read this log of a run: {error}") from error


def _words(metrics: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())


def _checksum(arrays: Sequence[Any]) -> int:
    """CRC of all arrays, to tell others from the same."""
    value = 0
    for leaf in arrays:
        value = zlib.crc32(np.asarray(leaf).tobytes(), value)
    return value
