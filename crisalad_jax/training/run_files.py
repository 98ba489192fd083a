"""The files of a run: what it writes, what it resumes from, and the claim on its folder."""

import contextlib
import copy
import dataclasses
import pathlib
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.train_state import SavedState, StateStore
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.config.io import differences, read_config, to_plain
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.places import Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import MetricsLog
from crisalad_jax.training.mining import Mined
from crisalad_jax.training.step import TrainState
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.temporaries import holds_other_files, made_folder, remove_temporaries


class RunState(NamedTuple):
    """The arrays of a run: those of `TrainState`, and the tuples of the round that it is in."""

    step: Any
    trainable: Any
    optimiser: Any
    classifiers: Any
    mined: Mined | None
    """None where nothing is mined."""

    @classmethod
    def of(cls, state: TrainState, mined: Mined | None) -> "RunState":
        """Join the two."""
        return cls(*state, mined)

    @property
    def of_training(self) -> TrainState:
        """The training state alone."""
        return TrainState(*self[:-1])


@dataclasses.dataclass
class RunRecord:
    """The state of a run besides its arrays, as plain values saved with every checkpoint."""

    weights_checksum: int
    """Checksum of all parameters before the first step."""
    places_checksum: int
    """Checksum of the names of all training images and of their division into places."""
    validation_checksum: int
    """Checksum of the validation benchmark; 0 where there is none."""
    validated: int = 0
    """Step of the last validation."""
    best: list[list[Any]] = dataclasses.field(default_factory=list)
    """Recall, by `TrainConfig.select_by`, and step of the best validations, best first."""
    without_gain: int = 0
    """Number of validations since the best one."""
    sources: dict[str, list[Any]] = dataclasses.field(default_factory=dict)
    """Name and source's digest of every part of the configuration."""
    stopped_early: bool = False
    skipped_images: int = 0


class RunFiles:
    """The files in a run's folder; the primary process alone writes them."""

    def __init__(self, out: pathlib.Path, config: TrainConfig) -> None:
        """Claim the folder `out` for a run with this configuration, until it is closed.

        Raises:
            InputError: what `claim_run` raises; or another process writes there.
        """
        check_run(out, config)
        with contextlib.ExitStack() as opened:
            opened.enter_context(lock(out))
            self.extends = claim_run(out, config)
            """Epochs of the run before `config` gave it more; None where it gives none."""
            for folder in (out, out / "best"):
                remove_temporaries(folder)
            self._out, self._config = out, config
            # A signal, or an error, before the first state leaves no empty folder.
            opened.enter_context(made_folder(out / "state"))
            self._states = StateStore(out / "state")
            self._log: MetricsLog | None = None
            self._saved: tuple[int, RunRecord] | None = None
            self._lock = opened.pop_all()

    def load(self, like: RunState) -> SavedState | None:
        """Load the saved state; see `StateStore.load`."""
        return self._states.load(like)

    def go_on(self, step: int, record: RunRecord, *, is_saved: bool) -> None:
        """Resume the files at this step; `is_saved` tells whether they hold its state."""
        self._saved = (step, record) if is_saved else None
        with self._writing():
            if self.extends is not None:
                extend_run(self._out, self._config, step)
            self._drop_old_best(record)
            # A validation after the saved state will be repeated, so its line is dropped.
            self._log = MetricsLog(self._out, keep_up_to=step, validated=record.validated)

    def log_step(self, values: Mapping[str, int | float], *, of: str = "") -> None:
        """Append a line to the log; see `MetricsLog.write`."""
        assert self._log is not None
        with self._writing():
            self._log.write(values, of=of)

    def keep_if_best(self, step: int, record: RunRecord, params: Crisalad) -> None:
        """Write the weights of this step, if the record counts it among the best."""
        steps = [best_step for _, best_step in record.best]
        paths = [self._out / "best.safetensors"] if steps[0] == step else []
        paths += [self._best_path(step)] if self._config.keep_best > 1 and step in steps else []
        with self._writing():
            for path in paths:
                save_weights(path, params, self._config.model)

    def save(
        self, step: int, record: RunRecord, state: RunState, params: Callable[[], Crisalad]
    ) -> None:
        """Write the weights and the state, unless they are saved already."""
        record = copy.deepcopy(record)
        if self._saved == (step, record):
            return
        with self._writing():
            save_weights(self._out / "last.safetensors", params(), self._config.model)
            self._states.save(step, state, dataclasses.asdict(record))
            self._drop_old_best(record)
        self._saved = step, record

    def close(self) -> None:
        """Wait for files that are being written, and close them."""
        with self._lock, self._writing(), contextlib.ExitStack() as closed:
            if self._log is not None:
                closed.callback(self._log.close)
            closed.callback(self._states.close)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn a disk's errors in this block into an error of the run."""
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{self._out}: cannot write: {error.strerror or error}; the same command goes on "
                "from the last state that was saved"
            ) from error

    def _best_path(self, step: int) -> pathlib.Path:
        return self._out / "best" / f"step-{step:08}.safetensors"

    def _drop_old_best(self, record: RunRecord) -> None:
        """Remove weights that the record does not count among the best, or not yet."""
        best_paths = {self._best_path(step) for _, step in record.best}
        for path in set((self._out / "best").glob("step-*.safetensors")) - best_paths:
            self._states.wait()  # a kill before would leave a state that still lists them
            path.unlink()


def claim_run(out: pathlib.Path, config: TrainConfig) -> int | None:
    """Make `out` the folder of a run with this configuration, or check that it is.

    Returns:
        The epochs of the run there where the configuration has more; else None.

    Raises:
        InputError: what `check_run` raises.
    """
    check_run(out, config)
    path = out / "config.json"
    if not path.exists():
        write_json(path, to_plain(config))
        return None
    epochs = read_config(TrainConfig, path).epochs
    return epochs if epochs < config.epochs else None


def extend_run(out: pathlib.Path, config: TrainConfig, step: int) -> None:
    """Write the configuration of a run that goes on for more epochs, and how it came to them.

    `epochs.json` lists the epochs that the run had before, each with the step that it had come to.

    Args:
        out: the run's folder.
        config: its configuration, with more epochs than the one there.
        step: the step that it goes on from.
    """
    path, history = out / "config.json", out / "epochs.json"
    before = read_config(TrainConfig, path).epochs
    known = read_json(history, "the epochs of a run")["before"] if history.exists() else []
    # After a kill between the two files, the last entry is there already.
    known = [each for each in known if each["epochs"] != before]
    write_json(history, {"before": [*known, {"epochs": before, "step": step}]})
    write_json(path, to_plain(config))


def check_run(out: pathlib.Path, config: TrainConfig) -> None:
    """Check that `out` is the folder of a run with this configuration, or can become one.

    A run there may have fewer epochs, which it is then extended by.

    Raises:
        InputError: it is a file, or holds a run of another configuration, or files but no run.
    """
    path = out / "config.json"
    if path.exists():
        there = read_config(TrainConfig, path)
        epochs = max(there.epochs, config.epochs)
        wrong = differences(config, dataclasses.replace(there, epochs=epochs))
        if wrong:
            raise InputError(
                f"{out}: holds a run of another configuration: {'; '.join(wrong)}; give the same "
                "to go on with it, or another folder"
            )
    elif out.exists() and not out.is_dir():
        raise InputError(f"{out}: found a file, expected the folder of a run, or a new one")
    elif out.exists() and holds_other_files(out):
        raise InputError(f"{out}: found files but no run, expected a run or a new or empty folder")


def _text(names: Iterable[Any]) -> np.ndarray:
    return np.frombuffer("\n".join(map(str, names)).encode(), np.uint8)


def checksum_of_places(places: Places | QuerySet) -> int:
    """Compute the CRC of all images' names, and of their places or of the queries' positives."""
    if isinstance(places, QuerySet):
        names = (pathlib.Path(file).name for file in places.files)
        return checksum([_text(names), places.queries, *places.positives, *places.near])
    return checksum([_text(places.files), places.place_start])


def checksum_of_benchmark(benchmark: Benchmark) -> int:
    """Compute the CRC of a benchmark's name and of its images' names, in any folder."""
    names = (path.name for path in (*benchmark.database, *benchmark.queries))
    return checksum([_text((benchmark.name, *names))])


def checksum(arrays: Sequence[Any]) -> int:
    """Compute the CRC of all arrays, which tells others from the same."""
    value = 0
    for leaf in arrays:
        value = zlib.crc32(np.asarray(leaf).tobytes(), value)
    return value
