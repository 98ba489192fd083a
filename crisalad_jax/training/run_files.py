"""The files of a run: what it writes, what it resumes from, and the lock on its folder."""

import contextlib
import copy
import dataclasses
import json
import pathlib
import time
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from crisalad_jax.checkpoints.train_state import StateStore
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.config.checks import require
from crisalad_jax.config.io import differences, read_config, to_plain
from crisalad_jax.config.plugins import changed_sources
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.frames import file_of
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.data.remote import for_each, size_of
from crisalad_jax.nn.model import Crisalad, Model
from crisalad_jax.training import distributed
from crisalad_jax.training.batches import Drawn, TrainingSet, sets_of
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import MetricsLog
from crisalad_jax.training.mining import Mined
from crisalad_jax.training.step import TrainState
from crisalad_jax.utils.files import check_no_links, read_json, wrap_os_errors, write_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.temporaries import holds_other_files, made_folder, remove_temporaries

SAVE_SECONDS = 300
"""Maximum seconds between saved states; validations and the end of a run save too."""

DATA = "data.json"
"""File in which a run records its data (`write_data`)."""


class RunState(NamedTuple):
    """The arrays of a run."""

    training: TrainState
    mined: Mined | Drawn | None
    """The images drawn for the current round; None if the draw does not depend on the model."""


@dataclasses.dataclass
class RunRecord:
    """The state of a run other than its arrays, as plain values saved with every checkpoint."""

    checksums: dict[str, int]
    """Checksums of the weights before the first step, of the names of all training images and their
    division into places, and of the validation benchmark (0 if there is none)."""
    sources: dict[str, list[Any]]
    """[name, source digest] of every part, by the dotted name of its configuration field."""
    step: int = 0
    """Number of steps taken and logged."""
    validated: int = 0
    """Step of the last validation."""
    best: list[list[Any]] = dataclasses.field(default_factory=list)
    """[recall, step] of the best validations, best first; the recall is `TrainConfig.monitor`'s."""
    without_gain: int = 0
    """Number of validations since the best one."""
    stopped_early: bool = False
    skipped_images: int = 0

    def add_validation(self, recall: float, config: TrainConfig) -> None:
        """Record the recall of a validation at `step`, and decide whether to stop early."""
        newest = [recall, self.step]
        # Among equal recalls, the first counts as the best.
        best = sorted([*self.best, newest], key=lambda each: (-each[0], each[1]))
        self.best = best[: config.save_top_k]
        self.without_gain = 0 if best[0] == newest else self.without_gain + 1
        self.stopped_early = config.patience is not None and self.without_gain >= config.patience
        self.validated = self.step


class RunFiles:
    """The files in a run's folder; only the primary process writes them."""

    def __init__(self, out: pathlib.Path, config: TrainConfig, record: RunRecord) -> None:
        """Store the folder, which `load` locks, and the record of a run before its first step."""
        self.out, self.record, self._config = out, record, config
        self._opened = contextlib.ExitStack()
        self._saved: RunRecord | None = None
        self._saved_at = time.monotonic()

    def load(self, state: RunState) -> RunState:
        """Lock the folder until `close`, and load the run in it, if there is one.

        All processes call it together.

        Args:
            state: the state of a run before its first step.

        Returns:
            The state to resume from, which `record` describes.

        Raises:
            InputError: the folder holds anything but a run of this configuration; another process
                is writing to it; or its run started from other weights, data or code.
        """

        def load() -> dict[str, Any]:
            nonlocal state
            state = self._load(state)
            return dataclasses.asdict(self.record)

        self.record = RunRecord(**distributed.run_on_primary(load))
        return distributed.broadcast(state)

    def _load(self, state: RunState) -> RunState:
        out, config = self.out, self._config
        has_fewer_epochs = check_run(out, config)
        with contextlib.ExitStack() as opened:
            opened.enter_context(lock(out))
            if not (out / "config.json").exists():
                write_json(out / "config.json", to_plain(config))
            for folder in (out, out / "best"):
                remove_temporaries(folder)
            # A signal or an error before the first state must not leave an empty folder.
            opened.enter_context(made_folder(out / "state"))
            self._states = StateStore(out / "state")
            opened.callback(self._states.close)
            saved = self._states.load(state)
            if saved is not None:
                _check_start(out, config, self.record, saved.record)
                self.record, state = RunRecord(**saved.record), saved.state
                self._saved = copy.deepcopy(self.record)
            step, validated = self.record.step, self.record.validated
            with wrap_os_errors(out):
                if has_fewer_epochs:
                    extend_run(out, config, self.record)
                self._drop_old_best()
                # A validation after the saved state will be repeated, so its line is dropped.
                self._log = MetricsLog(out, keep_up_to=step, validated=validated)
                opened.callback(self._log.close)
            self._opened = opened.pop_all()
        return state

    def log(self, values: Mapping[str, int | float], *, of: str = "") -> None:
        """Append a line to the log, in the primary process; `of` names a validation's benchmark."""
        if distributed.is_primary():
            with wrap_os_errors(self.out):
                self._log.write(values, of=of)

    def save_if_best(self, params: Crisalad, loss: PyTree) -> None:
        """Write the weights of this step if it is among the best steps recorded so far.

        Args:
            params: the model's parameters.
            loss: the loss's parameters, from `TrainState.saved_loss`.
        """
        steps = [step for _, step in self.record.best]
        paths = [self.out / "best.safetensors"] if steps[0] == self.record.step else []
        if self._config.save_top_k > 1 and self.record.step in steps:
            paths.append(self._best_path(self.record.step))
        with wrap_os_errors(self.out):
            for path in paths:
                self._save_weights(path, params, loss)

    def _save_weights(self, path: pathlib.Path, params: Crisalad, loss: PyTree) -> None:
        # A loss of pairs has a single group.
        learnt = None if loss is None else jax.tree.map(lambda leaf: leaf[0], loss)
        saved = None if loss is None else (self._config.loss, learnt)
        save_weights(path, Model(params, self._config.model), loss=saved)

    def save_is_due(self) -> bool:
        """Return whether this process is primary and its last save is over `SAVE_SECONDS` ago."""
        return distributed.is_primary() and time.monotonic() - self._saved_at > SAVE_SECONDS

    def save(self, state: RunState, params: Callable[[], Crisalad]) -> None:
        """Write the weights and the state, unless they are saved already.

        The state is written while training continues. `params` is called only to write weights.
        """
        if distributed.is_primary() and self._saved != self.record:
            with wrap_os_errors(self.out):
                loss = state.training.saved_loss(self._config.loss)
                self._save_weights(self.out / "last.safetensors", params(), loss)
                self._states.save(self.record.step, state, dataclasses.asdict(self.record))
                self._drop_old_best()
            self._saved = copy.deepcopy(self.record)
        self._saved_at = time.monotonic()

    def close(self) -> None:
        """Wait for files that are being written, and close them."""
        with wrap_os_errors(self.out):
            self._opened.close()

    def _best_path(self, step: int) -> pathlib.Path:
        return self.out / "best" / f"step-{step:08}.safetensors"

    def _drop_old_best(self) -> None:
        """Remove weights that the record does not list among the best, or does not list yet."""
        best_paths = {self._best_path(step) for _, step in self.record.best}
        for path in set((self.out / "best").glob("step-*.safetensors")) - best_paths:
            self._states.wait()  # or a kill could leave a state that still lists them
            path.unlink()


def _check_start(
    out: pathlib.Path, config: TrainConfig, started: RunRecord, saved: Mapping[str, Any]
) -> None:
    """Check that a saved run started from the same files and code as this one."""
    checksums = saved["checksums"]
    others = [
        f"other {what}" for what, each in started.checksums.items() if checksums[what] != each
    ]
    others += [f"another source of {name}" for name in changed_sources(config, saved["sources"])]
    require(
        not others,
        f"{out}: the run started from {', '.join(others)} than are given now; expected the same, "
        "or another folder",
    )


def extend_run(out: pathlib.Path, config: TrainConfig, record: RunRecord) -> None:
    """Write the configuration of a run that resumes with more epochs, and the epochs it had before.

    `epochs.json` lists the earlier numbers of epochs, each with the step that the run had reached.
    Warn if the learning rate differs from that of a run with all epochs from the start.

    Args:
        out: the run's folder.
        config: its configuration, with more epochs than the existing one.
        record: the record that it resumes from.
    """
    path, history = out / "config.json", out / "epochs.json"
    before = read_config(TrainConfig, path).epochs
    known = read_json(history, "the epochs of a run")["before"] if history.exists() else []
    # After a kill between the two writes, the last entry already exists.
    known = [each for each in known if each["epochs"] != before]
    write_json(history, {"before": [*known, {"epochs": before, "step": record.step}]})
    write_json(path, to_plain(config))
    if config.optimiser.schedule.spans_run and record.step and not record.stopped_early:
        warn(
            f"{out}: the learning rate falls over the whole run, so it jumps at step "
            f"{record.step}, unlike in a run of {config.epochs} epochs from the start; "
            "--optimiser.schedule.decay-steps fixes the length of the decay"
        )


def check_run(out: pathlib.Path, config: TrainConfig) -> bool:
    """Check that `out` is the folder of a run with this configuration, or can become one.

    Returns:
        Whether `out` holds a run of fewer epochs, which the caller then extends.

    Raises:
        InputError: `out` is a file, or holds another configuration's run, other files, or links.
    """
    path = out / "config.json"
    if not path.exists():
        found = "files but no run" if out.is_dir() else "a file"
        is_free = not out.exists() or (out.is_dir() and not holds_other_files(out))
        require(is_free, f"{out}: found {found}, expected a run or a new or empty folder")
        return False
    check_no_links(out)
    existing = read_config(TrainConfig, path)
    epochs = max(existing.epochs, config.epochs)
    wrong = differences(config, dataclasses.replace(existing, epochs=epochs))
    require(
        not wrong,
        f"{out}: holds a run of another configuration: {'; '.join(wrong)}; give the same to resume "
        "it, or another folder",
    )
    return existing.epochs < epochs


def write_data(
    out: pathlib.Path, name: str, places: TrainingSet, benchmark: Benchmark | None
) -> None:
    """Record in a run's folder what it was trained and validated on, for a model card.

    Args:
        out: the folder.
        name: name of the training data.
        places: the training data.
        benchmark: the validation set, if there is one.
    """
    counts = {"places": 0, "queries": 0, "images": 0}
    for each in sets_of(places):
        kind = "queries" if isinstance(each, QuerySet) else "places"
        counts[kind] += len(each.queries if isinstance(each, QuerySet) else each.names)
        counts["images"] += len(each.files)
    validation = None
    if benchmark is not None:
        sides = {"database": len(benchmark.database), "queries": len(benchmark.queries)}
        validation = {"name": benchmark.name, **sides}
    training = {"name": name} | {what: count for what, count in counts.items() if count}
    write_json(out / DATA, {"training": training, "validation": validation})


def checksum_of_places(places: TrainingSet) -> int:
    """Compute the CRC-32 of image names and of their places or, in a `QuerySet`, their pairs."""
    if isinstance(places, Mapping):
        return checksum(map(checksum_of_places, sets_of(places)))
    if isinstance(places, QuerySet):
        names = (pathlib.Path(file).name for file in places.files)
        return checksum([_text(names), places.queries, *places.positives, *places.near])
    return checksum([_text(places.files), places.place_start, _text(places.names)])


def checksum_of_sizes(places: TrainingSet) -> int:
    """Compute the CRC-32 of the sizes of all image files.

    Raises:
        InputError: the address of a remote image cannot be reached.
    """
    paths = (each.path(image) for each in sets_of(places) for image in range(len(each.files)))
    files = list(dict.fromkeys(map(file_of, paths)))
    return checksum([[-1 if size is None else size for size in for_each(size_of, files)]])


def checksum_of_config(config: TrainConfig) -> int:
    """Compute the CRC-32 of a configuration."""
    return checksum([_text([json.dumps(to_plain(config))])])


def checksum_of_benchmark(benchmark: Benchmark) -> int:
    """Compute the CRC-32 of the names of a benchmark and its images, without their folders."""
    names = (path.name for path in (*benchmark.database, *benchmark.queries))
    return checksum([_text((benchmark.name, *names))])


def _text(names: Iterable[Any]) -> np.ndarray:
    return np.frombuffer("\n".join(map(str, names)).encode(), np.uint8)


def checksum(arrays: Iterable[Any]) -> int:
    """Compute one CRC-32 of all arrays, to detect differences."""
    value = 0
    for each in arrays:
        value = zlib.crc32(np.asarray(each).tobytes(), value)
    return value
