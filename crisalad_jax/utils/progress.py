"""Progress on the terminal: a bar with rate and time left, on stderr, unless quiet."""

import contextlib
import functools
import sys
from collections.abc import Iterator
from typing import Any

from crisalad_jax.utils.output import printable


class Bar:
    """A progress bar, or only its messages if no bar is drawn."""

    def __init__(self, progress: Any = None, task: Any = None, *, quiet: bool = True) -> None:
        """Wrap a task of rich's `progress`; without it only messages are shown, unless `quiet`."""
        self._progress, self._task, self._quiet = progress, task, quiet

    def advance(self, count: float, note: str = "") -> None:
        """Advance by `count` units, and show a short note after the bar."""
        if self._progress is not None:
            self._progress.update(self._task, advance=count, note=note)

    def say(self, line: str) -> None:
        """Print a line that stays on the terminal, above the bar."""
        if self._progress is not None:
            self._progress.console.print(printable(line), soft_wrap=True, highlight=False)
        elif not self._quiet:
            print(printable(line), file=sys.stderr)


@contextlib.contextmanager
def progress_bar(
    label: str, total: float, unit: str, *, quiet: bool, done: float = 0
) -> Iterator[Bar]:
    """Show the progress of long work while the block runs; without rich, only its messages.

    Args:
        label: name of the work.
        total: number of units.
        unit: name of the unit, for the rate.
        quiet: whether to show nothing.
        done: units that were done before, which do not count towards the rate.
    """
    if quiet:
        yield Bar()
        return
    try:
        import rich.console
        import rich.progress as parts
        import rich.table
        import rich.text
    except ModuleNotFoundError:  # every extra installs it
        yield Bar(quiet=False)
        return

    class Rate(parts.ProgressColumn):
        def render(self, task: parts.Task) -> str:
            speed = task.finished_speed or task.speed
            return "" if speed is None else f"{speed:.1f} {unit}/s"

    class Note(parts.ProgressColumn):
        def render(self, task: parts.Task) -> rich.text.Text:
            return rich.text.Text(task.fields["note"], no_wrap=True, overflow="ellipsis")

    console = rich.console.Console(stderr=True)
    # Only the note is shortened on a narrow terminal: no other column wraps.
    whole = functools.partial(rich.table.Column, no_wrap=True)
    progress = parts.Progress(
        parts.TextColumn("{task.description}"),
        parts.BarColumn(bar_width=28 if console.width >= 120 else 8),
        parts.TaskProgressColumn(),
        parts.TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        Rate(table_column=whole()),
        parts.TimeRemainingColumn(elapsed_when_finished=True, table_column=whole()),
        Note(),
        console=console,
    )
    with progress:
        task = progress.add_task(label, total=total, completed=done, note="")  # pyright: ignore
        yield Bar(progress, task)
