"""Callbacks, which receive the metrics of a run and can stop it."""

import csv
import importlib
import pathlib
import secrets
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from crisalad_jax.config.checks import require
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.plugins import load_entry_points
from crisalad_jax.config.registry import add_named
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.distributed import is_primary
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, wrap_os_errors

if TYPE_CHECKING:
    from crisalad_jax.training.loop import FitResult

Numbers = Mapping[str, int | float]


class StopTraining(Exception):
    """Raised by a callback to end a run; the run is saved, and the same call of `fit` resumes it.

    Example:
        >>> class FirstStep(Callback):
        ...     def on_step(self, numbers):
        ...         raise StopTraining
    """


class Callback:
    """The base class of callbacks: methods are called during a run, and do nothing by default.

    When a killed run resumes, the steps and validations after its last saved state are repeated.

    Example:
        >>> class Print(Callback):
        ...     def on_step(self, numbers):
        ...         print(numbers["step"], numbers["loss"])
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Check that all methods beginning with on_ are known."""
        super().__init_subclass__(**options)
        hooks = [name for name in dir(Callback) if name.startswith("on_")]
        unknown = [name for name in vars(cls) if name.startswith("on_") and name not in hooks]
        require(
            not unknown,
            f"{cls.__name__}: found a method {', '.join(unknown)}, which nothing calls, expected "
            f"{', '.join(hooks)}",
        )

    def on_start(self, out: pathlib.Path, config: TrainConfig, step: int) -> None:
        """Handle the start of a run.

        Args:
            out: the run's folder.
            config: the run's configuration.
            step: number of steps already taken; not 0 if the run resumes.
        """

    def on_step(self, numbers: Numbers) -> None:
        """Handle a step, with the metrics of its line in metrics.jsonl: step, epoch, loss, ..."""

    def on_validation(self, numbers: Numbers) -> None:
        """Handle a validation, with its metrics as in metrics.jsonl: step, epoch, R@1, ..."""

    def on_end(self, result: "FitResult") -> None:
        """Handle the end of a run; not called after an error or a signal."""


CALLBACKS: dict[str, type[Callback]] = {}
"""Registered callbacks by name."""
_C = TypeVar("_C", bound=type[Callback])


def register_callback(name: str) -> Callable[[_C], _C]:
    """Make a decorator that registers a callback class.

    Args:
        name: name of the class for `--callback` and `make_callback`.

    Returns:
        The decorator, for a class that inherits from `Callback` and is made without arguments.

    Raises:
        InputError: on decoration, the name is taken, or the object is not such a class.

    Example:
        >>> @register_callback("print-recall")
        ... class PrintRecall(Callback):
        ...     def on_validation(self, numbers):
        ...         print(numbers["R@1"])
        >>> make_callback("print-recall")  # doctest: +ELLIPSIS
        <...PrintRecall object at ...>
    """

    def decorate(kind: _C) -> _C:
        is_kind = isinstance(kind, type) and issubclass(kind, Callback)
        require(is_kind, f"register_callback {name!r}: found {kind!r}, expected a Callback class")
        add_named("callback", CALLBACKS, name, kind)
        return kind

    return decorate


def make_callback(callback: Callback | str) -> Callback:
    """Return a callback unchanged, or make one from its name.

    Raises:
        InputError: no callback has this name, or it needs a package that is not installed.
    """
    if isinstance(callback, Callback):
        return callback
    if callback not in CALLBACKS:
        load_entry_points()
    known = isinstance(callback, str) and callback in CALLBACKS
    names = ", ".join(sorted(CALLBACKS))
    require(known, f"callback: found {callback!r}, expected a Callback object or one of {names}")
    return CALLBACKS[callback]()


class Callbacks:
    """The callbacks of a run, which only the primary process calls."""

    def __init__(self, callbacks: Sequence[Callback | str]) -> None:
        """Make the callbacks given by name; raises like `make_callback`."""
        made = [make_callback(each) for each in callbacks]
        self._each = made if is_primary() else []
        self.stopped = False
        """Whether a callback has asked to stop."""

    def call(self, method: str, *arguments: Any) -> None:
        """Call a method of each callback, in order; `StopTraining` sets `stopped`."""
        for each in self._each:
            try:
                getattr(each, method)(*arguments)
            except StopTraining:
                self.stopped = True


@register_callback("csv")
class CsvCallback(Callback):
    """A callback that writes tables `steps.csv` and `validations.csv` in the run's folder."""

    def on_start(self, out: pathlib.Path, config: TrainConfig, step: int) -> None:
        """Drop the lines that a resumed run will repeat."""
        self._out = out
        for name in ("steps", "validations"):
            path = self._path(name)
            if path.exists():
                with path.open(encoding="utf-8", newline="") as file:
                    rows = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
                with atomic_path(path) as temporary:
                    _write_rows(temporary, rows)

    def on_step(self, numbers: Numbers) -> None:
        """Append a line to `steps.csv`."""
        _write_rows(self._path("steps"), [numbers])

    def on_validation(self, numbers: Numbers) -> None:
        """Append a line to `validations.csv`."""
        _write_rows(self._path("validations"), [numbers])

    def _path(self, name: str) -> pathlib.Path:
        return self._out / f"{name}.csv"


def _write_rows(path: pathlib.Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Append rows with the file's columns or, in a new file, those of the first row."""
    with wrap_os_errors(path), path.open("a+", encoding="utf-8", newline="") as file:
        file.seek(0)
        columns = next(csv.reader(file), [])
        writer = csv.DictWriter(file, columns or [*rows[0]] if rows else [], extrasaction="ignore")
        if rows and not columns:
            writer.writeheader()
        writer.writerows(rows)


@register_callback("wandb")
class WandbCallback(Callback):
    """A callback that logs to Weights & Biases, configured by WANDB_* environment variables.

    The W&B run is named after the run's folder. Resuming a run continues the same W&B run.
    """

    def __init__(self) -> None:
        """Import the package."""
        self._wandb = _imported("wandb")

    def on_start(self, out: pathlib.Path, config: TrainConfig, step: int) -> None:
        """Start the run, or resume the one recorded in the folder."""
        identity = out / "wandb-run"
        if not identity.exists():
            identity.write_text(secrets.token_hex(4), encoding="utf-8")
        options = {"dir": str(out), "id": identity.read_text(encoding="utf-8"), "resume": "allow"}
        self._wandb.init(name=out.absolute().name, config=to_plain(config), **options)

    def on_step(self, numbers: Numbers) -> None:
        """Log the metrics."""
        self._wandb.log(dict(numbers), step=numbers["step"])

    on_validation = on_step

    def on_end(self, result: "FitResult") -> None:
        """End the run."""
        self._wandb.finish()


@register_callback("mlflow")
class MlflowCallback(Callback):
    """A callback that logs to MLflow (set MLFLOW_* variables), in a run named after the folder."""

    def __init__(self) -> None:
        """Import the package."""
        self._mlflow = _imported("mlflow")

    def on_start(self, out: pathlib.Path, config: TrainConfig, step: int) -> None:
        """Start the run and log the configuration, or resume the one recorded in the folder."""
        identity = out / "mlflow-run"
        if identity.exists():
            self._mlflow.start_run(run_id=identity.read_text(encoding="utf-8"))
            return
        run = self._mlflow.start_run(run_name=out.absolute().name)
        identity.write_text(run.info.run_id, encoding="utf-8")
        self._mlflow.log_dict(to_plain(config), "config.json")

    def on_step(self, numbers: Numbers) -> None:
        """Log the metrics; R@1 becomes R1, because MLflow names cannot contain @."""
        metrics = {name.replace("@", ""): value for name, value in numbers.items()}
        self._mlflow.log_metrics(metrics, step=int(numbers["step"]))

    on_validation = on_step

    def on_end(self, result: "FitResult") -> None:
        """End the run."""
        self._mlflow.end_run()


def _imported(package: str) -> Any:
    """Import a package that none of our extras installs.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise InputError(
            f"callback {package}: found no module {error.name}, expected it: pip install {package}"
        ) from error
