"""The help of a command: the flags that people use, or all of them.

A command's module names those of `--help` in `COMMON`, in their order, and shows one call in
`EXAMPLE`. Without `COMMON` all flags are common.
"""

import argparse
import re
import shutil
import textwrap
import warnings
from collections.abc import Sequence
from typing import Any

from crisalad_jax.config.flags import plain_metavar

SHORT, ALL = "--help", "--help-all"
_WIDTH = 100
_COLUMN = 28
"""Widest column of flags; what is wider has its text on the next line."""
_CHOICES = 6
"""Most choices that stand beside a flag; more stand in its text."""
_SHORT = 24
"""Fewest letters of clauses that tell enough without the rest."""
_ON = {"True": "on"}
_LINES = 2
"""Most lines of a flag's text."""


def asked_for(arguments: Sequence[str]) -> str | None:
    """Return which help arguments ask for, `SHORT` or `ALL`; None where they ask for none."""
    if ALL in arguments:
        return ALL
    return SHORT if SHORT in arguments or "-h" in arguments else None


def class_of(name: str, module: Any, arguments: Sequence[str]) -> type:
    """Return the class that a command's arguments are parsed into."""
    if hasattr(module, "command"):
        return module.command(arguments)
    return getattr(module, "".join(map(str.capitalize, name.split("-"))))


def flags_parser(kind: type, program: str) -> argparse.ArgumentParser:
    """Make the parser of a command's class, whose actions tell of each flag."""
    import tyro

    with warnings.catch_warnings():
        # Tyro has no other function that tells of the flags.
        warnings.simplefilter("ignore", DeprecationWarning)
        parser: Any = tyro.extras.get_parser(kind, prog=program, add_help=False)
    return parser


def short_help(name: str, module: Any, kind: type) -> str:
    """Write the help that fits a screen: usage, summary, common flags and an example.

    Args:
        name: the command's.
        module: the command's.
        kind: the class that its flags are parsed into.
    """
    actions = flags_parser(kind, f"crisalad {name}")._actions
    named = {_name(action): action for action in actions}
    common = [named[flag] for flag in getattr(module, "COMMON", tuple(named))]
    required = [action for action in actions if action.required or not action.option_strings]
    usage = " ".join(["usage: crisalad", name, *map(_usage, required), "[FLAGS]"])
    width = min(_WIDTH, shutil.get_terminal_size((_WIDTH, 24)).columns)
    summary = (kind.__doc__ or "").partition("\n\n")[0]
    lines = [usage, "", *textwrap.wrap(summary, width), ""]
    column = 2 + min(_COLUMN, max(len(_heading(action)) for action in common)) + 2
    for action in common:
        lines += _entry(action, column, width)
    lines += ["", f"example: {module.EXAMPLE}", f"all flags: crisalad {name} {ALL}"]
    return "\n".join(lines)


def _name(action: argparse.Action) -> str:
    """Return a flag's name without hyphens before it, or a positional argument's."""
    return (action.option_strings or [action.dest])[0].removeprefix("--")


def _usage(action: argparse.Action) -> str:
    words = _heading(action)
    return (
        words
        if action.required or (not action.option_strings and action.nargs != "?")
        else f"[{words}]"
    )


def _heading(action: argparse.Action) -> str:
    """Return a flag and its value as they are typed."""
    value = _value(action)
    if not action.option_strings:
        return value
    flag = action.option_strings[0]
    if _default(action) == "True":
        flag = flag.replace("--", "--[no-]", 1)
    return f"{flag} {value}".rstrip()


def _value(action: argparse.Action) -> str:
    """Return what stands for a flag's value, without what means no value."""
    if _has_many_choices(action):
        return "NAME"
    return plain_metavar(action.metavar if isinstance(action.metavar, str) else "")


def _has_many_choices(action: argparse.Action) -> bool:
    return action.choices is not None and len(tuple(action.choices)) > _CHOICES


_DEFAULT = re.compile(r"\s*\((?:default: (.*?)|required)\)\s*$", re.DOTALL)


def _default(action: argparse.Action) -> str:
    """Return a flag's default as tyro's text tells it; nothing where there is none."""
    match = _DEFAULT.search(action.help or "")
    return (match[1] or "") if match else ""


def _entry(action: argparse.Action, column: int, width: int) -> list[str]:
    """Write a flag and its text in one line or two."""
    heading = f"  {_heading(action)}"
    default = _default(action)
    tail = "" if default in ("", "None", "False") else f" ({_ON.get(default, default)})"
    if action.required and action.option_strings:
        tail = " (required)"
    text = " ".join(_DEFAULT.sub("", action.help or "").replace("%%", "%").split())
    if _has_many_choices(action):
        text = f"{', '.join(sorted(action.choices or ()))}. {text}"
    beside = len(heading) + 2 <= column
    texts = _fitted(text, tail, width - column, _LINES if beside else _LINES - 1)
    first = heading.ljust(column) + texts.pop(0) if beside else heading
    return [first, *(" " * column + line for line in texts)]


_ENDS = re.compile(r"[.;](?= )|, (?=by default)|$")


def _fitted(text: str, tail: str, width: int, most: int) -> list[str]:
    """Wrap as many whole clauses of a text as fit into so many lines, or else its beginning."""
    ends = [match.start() for match in _ENDS.finditer(text.rstrip("."))]
    for end in reversed(ends):
        clauses = text[:end]
        lines = textwrap.wrap(clauses + tail, width, break_on_hyphens=False)
        is_whole = clauses.count("(") == clauses.count(")")
        if len(lines) <= most and is_whole and (end == ends[-1] or end > _SHORT):
            return lines
    for room in range(width * most - len(tail), 0, -4):
        short = textwrap.shorten(text, room, placeholder=" ...", break_on_hyphens=False)
        lines = textwrap.wrap(short + tail, width, break_on_hyphens=False)
        if len(lines) <= most:
            return lines
    return []
