"""The log of a run: JSON lines for programs, TensorBoard's event files for people."""

import json
import pathlib
import time
from collections.abc import Mapping
from typing import Any

from crisalad_jax.config.checks import require
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, read_text


class MetricsLog:
    """Metrics by step, as lines of `metrics.jsonl` and in `tensorboard/`."""

    def __init__(self, folder: pathlib.Path, *, keep_up_to: int, validated: int) -> None:
        """Open the log of the run in `folder` and drop what a resumed run repeats.

        That is all after step `keep_up_to`, and validations after step `validated`.

        Raises:
            InputError: a log that is there cannot be read.
        """
        # Imported here: it imports torch where that is installed, which takes seconds, and a log is
        # read without it.
        from tensorboardX.event_file_writer import EventsWriter

        self._path = folder / "metrics.jsonl"
        records = read_metrics(self._path) if self._path.exists() else []
        with atomic_path(self._path) as temporary:
            lines = [
                json.dumps(record) + "\n"
                for record in records
                if record["step"] <= (keep_up_to if "loss" in record else validated)
            ]
            temporary.write_text("".join(lines), encoding="utf-8")
        (folder / "tensorboard").mkdir(exist_ok=True)
        # SummaryWriter of tensorboardX writes in a thread, where a full disk goes unnoticed until
        # nothing more can be written.
        self._events = EventsWriter(str(folder / "tensorboard" / "events"))
        if records:
            # Tells TensorBoard to drop the later steps that it has read already.
            from tensorboardX.proto import event_pb2  # made by protobuf when it is imported

            session: Any = event_pb2.SessionLog  # pyright: ignore[reportAttributeAccessIssue]
            begin = session(status=session.START)
            self._add(keep_up_to + 1, session_log=begin)

    def write(self, values: Mapping[str, int | float], *, of: str = "") -> None:
        """Append a line; `of` names the validation set for TensorBoard's tags.

        The tags are those of other VPR tools: `loss`, `{set}/R5`.
        """
        from tensorboardX.summary import scalar

        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")
        for name, value in values.items():
            if name not in ("step", "epoch"):
                tag = f"{of}/{name.replace('@', '')}" if of else name
                self._add(int(values["step"]), summary=scalar(tag, value))
        self._events.flush()

    def close(self) -> None:
        """Close TensorBoard's file."""
        self._events.close()

    def _add(self, step: int, **what: Any) -> None:
        from tensorboardX.proto import event_pb2

        event: Any = event_pb2.Event  # pyright: ignore[reportAttributeAccessIssue]
        self._events.write_event(event(step=step, wall_time=time.time(), **what))


def read_metrics(path: pathlib.Path) -> list[dict[str, Any]]:
    """Read the lines of a metrics file, without a last line that a kill cut off.

    Raises:
        InputError: the file is missing, or a line is no record of a step.
    """
    lines = read_text(path, "a log of a run").split("\n")[:-1]
    try:
        records = [json.loads(line) for line in lines]
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot read this log of a run: {error}") from error
    have_steps = all(isinstance(r, dict) and type(r.get("step")) is int for r in records)
    require(have_steps, f"{path}: cannot read this log of a run: a line has no step")
    return records
