"""The help of a command: its common flags (`--help`) or all of them (`--help-all`).

commands.toml names the common flags of each command, and has an example.
"""

import argparse
import re
import shutil
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from crisalad_jax.config.flags import plain_metavar

SHORT, ALL = "--help", "--help-all"
_WIDTH, _LEAST, _COLUMN = 100, 60, 30
"""Maximum and minimum columns of the help, which a narrower terminal wraps, and the maximum for a
flag; a wider flag has its text on the next line."""
_RAGGED = 12
"""Columns that a line may leave empty where a long word follows."""
_CHOICES = 6
"""Maximum choices that are shown as a flag's value; more are listed in its text."""

_ENDS = re.compile(r"[.;](?= )|$")
"""Ends of clauses."""


def asked_for(arguments: Sequence[str]) -> str | None:
    """Return the help that the arguments ask for: `SHORT`, `ALL`, or None if they ask for none."""
    if ALL in arguments:
        return ALL
    return SHORT if SHORT in arguments or "-h" in arguments else None


def class_of(name: str, module: Any, arguments: Sequence[str]) -> type:
    """Return the class that a command's arguments are parsed into."""
    if hasattr(module, "command"):
        return module.command(arguments)
    return getattr(module, name.capitalize())


def flags_parser(kind: type, program: str) -> argparse.ArgumentParser:
    """Make an argparse parser, whose actions describe the flags of the command class `kind`."""
    import tyro

    with warnings.catch_warnings():
        # Tyro has no other function that describes the flags.
        warnings.simplefilter("ignore", DeprecationWarning)
        parser: Any = tyro.extras.get_parser(kind, prog=program, add_help=False)
    return parser


def short_help(name: str, about: Mapping[str, str], kind: type) -> str:
    """Return the help that fits a screen: usage, summary, common flags and an example.

    Args:
        name: the command's name.
        about: the command's entry in commands.toml.
        kind: the class that the command's flags are parsed into.
    """
    actions = flags_parser(kind, f"crisalad {name}")._actions
    named = {(each.option_strings or [each.dest])[0].removeprefix("--"): each for each in actions}
    width = min(_WIDTH, max(_LEAST, shutil.get_terminal_size((_WIDTH, 24)).columns))
    for action in actions:
        _shorten(action, width - _COLUMN)
    required = [each for each in actions if each.required or not each.option_strings]
    shown = argparse.ArgumentParser(
        usage=" ".join(["crisalad", name, *map(_heading, required), "[FLAGS]"]),
        description=(kind.__doc__ or "").partition("\n\n")[0],
        epilog=f"example: {about['example']}\nall flags: crisalad {name} {ALL}",
        add_help=False,
        formatter_class=lambda prog: _Formatter(prog, max_help_position=_COLUMN, width=width),
    )
    group = shown.add_argument_group()
    for flag in about.get("common", " ".join(named)).split():
        group._add_action(named[flag])
    return shown.format_help().rstrip()


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)


def _heading(action: argparse.Action) -> str:
    """Return a flag and its value as they are typed."""
    heading = " ".join([*action.option_strings[:1], str(action.metavar or "")]).rstrip()
    return f"[{heading}]" if action.nargs == "?" else heading


_DEFAULT = re.compile(r"\s*\((?:default: (.*?)|required)\)\s*$", re.DOTALL)
"""Suffix that tyro adds to a flag's text."""


def _shorten(action: argparse.Action, width: int) -> None:
    """Shorten a flag's value, and its text to the clauses that fit two lines of this width."""
    text, metavar = action.help or "", str(action.metavar or "")
    default = _DEFAULT.search(text)
    text = " ".join(_DEFAULT.sub("", text).split()).rstrip(".")
    if action.choices is not None and len(choices := tuple(action.choices)) > _CHOICES:
        metavar, text = "NAME", f"{', '.join(sorted(choices))}. {text}"
    action.metavar = plain_metavar(metavar)
    tail = ""
    if action.required and action.option_strings:
        tail = " (required)"
    elif default is not None and default[1] not in (None, "", "None", "False"):
        tail = f" ({default[1].replace('True', 'on')})"
    if action.option_strings:
        flag = action.option_strings[0]
        action.option_strings = [flag.replace("--", "--[no-]", 1) if tail == " (on)" else flag]
    lines = 1 if len(_heading(action)) > _COLUMN - 4 else 2
    room = max(_RAGGED, lines * width - len(tail) - (lines - 1) * _RAGGED)
    clauses = [text[: match.start()] for match in _ENDS.finditer(text)]
    whole = [each for each in clauses if len(each) <= room and each.count("(") == each.count(")")]
    short = whole[-1] if whole else textwrap.shorten(text, room, placeholder=" ...")
    action.help = short + tail
    if action.nargs not in (0, "?"):
        action.nargs = None  # the metavar shows how many
