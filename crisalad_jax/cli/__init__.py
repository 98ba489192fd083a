"""The command line: parse, make a configuration, call the library; a module for each command.

Exit codes: 0 done, 2 bad arguments or input (one line on stderr), 130 interrupted, 143 told to end
(SIGTERM) and its work saved, 1 anything else.
"""

import contextlib
import io
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import tyro

from crisalad_jax import platform
from crisalad_jax.cli import (
    ablate,
    compare,
    convert,
    demo,
    evaluate,
    export,
    extract,
    index,
    info,
    pca,
    query,
    train,
    vocabulary,
)
from crisalad_jax.config import choose
from crisalad_jax.errors import InputError, Stopped

# What only some commands need is imported when they run, for the others to start sooner.

_COMMANDS: dict[str, tuple[Any, Callable[[Any], None]]] = {
    "demo": (demo.Demo, demo.run),
    "train": (train.Train, train.run),
    "convert": (convert.Convert, convert.run),
    "evaluate": (evaluate.Evaluate, evaluate.run),
    "compare": (compare.Compare, compare.run),
    "ablate": (ablate.Ablate, ablate.run),
    "extract": (extract.Extract, extract.run),
    "index": (index.Index, index.run),
    "query": (query.Query, query.run),
    "vocabulary": (vocabulary.Vocabulary, vocabulary.run),
    "export": (export.Export, export.run),
    "pca": (pca.Pca, pca.run),
    "info": (info.Info, info.run),
}


def _parse(kind: Any, given: list[str], options: dict[str, Any]) -> Any:
    """The flags as an instance of `kind`; what tyro finds wrong, in a box, becomes one line."""
    program = f"crisalad {given[0]}"
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=program, args=given[1:], **options)
    except SystemExit as stop:
        if not stop.code:
            raise
        error: BaseException | None = stop
        while error is not None and not isinstance(error, InputError):
            error = error.__context__
        reason = _unboxed(complaint.getvalue()) if error is None else str(error)
        raise InputError(f"{reason} (see {program} --help)") from stop


# How the parts of tyro's boxes begin that say no more than the first.
_ASIDES = ("Argument help", "Got errors", "For full")


def _unboxed(box: str) -> str:
    """The text of one of tyro's boxes, without its frame, the helptexts and the footer."""
    sections = [[]]
    # The title goes; the frame is of spaces and hyphens where stdout is not known to take UTF-8.
    for line in box.splitlines()[1:]:
        row = line[2:].rstrip("│ ")
        if not row.strip("─╯-"):
            sections.append([])
        elif not row.startswith(" " * 5):
            sections[-1].append(row.strip())
    texts = [" ".join(rows) for rows in sections]
    return "; ".join(t for t in texts if t and not t.startswith(_ASIDES))


def _usage() -> str:
    lines = ["usage: crisalad COMMAND [--help] ...", "", "commands:"]
    lines += [f"  {name:<12}{kind.__doc__}" for name, (kind, _) in _COMMANDS.items()]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if given else sys.stderr)
        return 0 if given else 2
    try:
        kind, run = choose("command", given[0], _COMMANDS)
        # Nested settings are annotated with an empty name, so their flags carry no prefix.
        options: dict[str, Any] = {}
        if kind is train.Train:
            kind = Annotated[kind, tyro.conf.AvoidSubcommands]
            options["default"] = train.Train(
                data=tyro.MISSING, out=tyro.MISSING, settings=train.defaults(given[1:])
            )
        chosen = _parse(kind, given, options)
        platform.set_up()
        run(chosen)
    except (InputError, OSError) as error:  # the disk's: it is full, or what no check foresaw
        print("crisalad:", *str(error).splitlines(), file=sys.stderr)
        return 2
    except SystemExit:  # from tyro, after --help
        return 0
    except Stopped as stopped:
        print(f"crisalad: {stopped}", file=sys.stderr)
        return 128 + stopped.number
    except KeyboardInterrupt:
        print("crisalad: interrupted", file=sys.stderr)
        return 130
    return 0
