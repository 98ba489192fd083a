"""Progress on the terminal: a bar with rate and time left, on stderr, silent when asked."""

import contextlib
from collections.abc import Callable, Iterator

import rich.console
import rich.progress


@contextlib.contextmanager
def progress_bar(
    label: str, total: int, unit: str, *, quiet: bool, done: int = 0
) -> Iterator[Callable[..., None]]:
    """Yield `advance(count, note="")`; the bar shows share, rate in `unit`/s and time left.

    `done` units of `total` were done before, and do not count for the rate.
    """
    bar = rich.progress.Progress(
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(bar_width=28),
        rich.progress.TaskProgressColumn(),
        rich.progress.TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        _RateColumn(unit),
        rich.progress.TimeRemainingColumn(elapsed_when_finished=True),
        rich.progress.TextColumn("{task.fields[note]}"),
        console=rich.console.Console(stderr=True),
        disable=quiet,
    )
    with bar:
        task = bar.add_task(label, total=total, completed=done, note="")

        def advance(count: int, note: str = "") -> None:
            bar.update(task, advance=count, note=note)

        yield advance


class _RateColumn(rich.progress.ProgressColumn):
    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: rich.progress.Task) -> str:
        speed = task.finished_speed or task.speed
        return "" if speed is None else f"{speed:.1f} {self._unit}/s"
