"""Progress on the terminal: a bar with rate and time left, on stderr, silent when asked."""

import contextlib
from collections.abc import Iterator

import rich.console
import rich.progress


class Bar:
    """A running bar."""

    def __init__(self, progress: rich.progress.Progress, task: rich.progress.TaskID) -> None:
        """See `progress_bar`."""
        self._progress, self._task = progress, task

    def advance(self, count: int, note: str = "") -> None:
        """Move on by `count` units, and show a few words behind the bar."""
        self._progress.update(self._task, advance=count, note=note)

    def say(self, line: str) -> None:
        """Print a line that stays, above the bar."""
        if not self._progress.disable:
            self._progress.console.print(line, soft_wrap=True, highlight=False)


@contextlib.contextmanager
def progress_bar(label: str, total: int, unit: str, *, quiet: bool, done: int = 0) -> Iterator[Bar]:
    """Show share, rate in `unit`/s and time left of work of `total` units while the block runs.

    `done` of the units were done before, and do not count for the rate.
    """
    progress = rich.progress.Progress(
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
    with progress:
        yield Bar(progress, progress.add_task(label, total=total, completed=done, note=""))


class _RateColumn(rich.progress.ProgressColumn):
    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: rich.progress.Task) -> str:
        speed = task.finished_speed or task.speed
        return "" if speed is None else f"{speed:.1f} {self._unit}/s"
