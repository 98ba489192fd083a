"""A process that takes runs of a comparison; `workers` starts it by its module's name.

Its task comes as a line of JSON on standard input, which stays open as long as the parent lives.
What it says goes to standard output, an object of JSON a line.
"""

import contextlib
import json
import os
import pathlib
import signal
import sys
import threading
import warnings
from typing import Any

from crisalad_jax.utils.errors import InputError, Interrupted
from crisalad_jax.utils.signals import end_at_signals


def main() -> int:
    """Take runs until none is left; return the exit code of a command."""
    end_at_signals()
    # What libraries and plug-ins print must not mix with the lines for the parent.
    talk = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
    os.dup2(2, 1)
    with open(0, "rb", buffering=0, closefd=False) as tasks:
        task = json.loads(tasks.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def send(kind: str, text: str) -> None:
        with contextlib.suppress(BrokenPipeError):
            talk.write(json.dumps({kind: text}) + "\n")

    try:
        _work(task, send)
    except InputError as error:
        send("error", str(error))
        return 2
    except Interrupted as stopped:
        return 128 + stopped.number
    return 0


def _work(task: dict[str, Any], send: Any) -> None:
    # Imported after the environment is known to be the task's, and signals are handled.
    from crisalad_jax.config.io import from_plain
    from crisalad_jax.config.plugins import load_entry_points, load_plugin
    from crisalad_jax.experiments.comparison.ledger import claim
    from crisalad_jax.experiments.comparison.plan import (
        ComparisonConfig,
        prepare,
        without_unreadable,
    )
    from crisalad_jax.experiments.comparison.runner import take_runs
    from crisalad_jax.utils.locks import lock
    from crisalad_jax.utils.output import Note

    show = warnings.showwarning

    def showwarning(message: Any, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, Note):
            send("note", str(message))
        else:
            show(message, category, *rest, **more)

    warnings.showwarning = showwarning
    warnings.simplefilter("always", Note)
    load_entry_points()
    for plugin in task["plugins"]:
        load_plugin(plugin)
    config = from_plain(ComparisonConfig, task["config"], source="--jobs")
    prepared = prepare(config, task["on_bad_image"])
    prepared, _ = without_unreadable(prepared, task["on_bad_image"], quiet=True)
    out = pathlib.Path(task["out"])
    with lock(out, wait=True, quiet=True):  # after the other processes, in a moment
        claim(out, prepared)
    take_runs(
        prepared,
        out,
        say=lambda line: send("say", line),
        quiet=True,
        jobs=task["jobs"],
        beside=task["beside"],
    )


def _end_with_parent() -> None:
    """End this process, its work saved, when the parent ends by whatever means."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
