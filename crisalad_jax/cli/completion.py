"""`crisalad completion`."""

import argparse
import importlib
from typing import Annotated, Any, Literal

import tyro

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.published import PUBLISHED
from crisalad_jax.cli import help as helping
from crisalad_jax.cli.flags import Flags
from crisalad_jax.config.plugins import load_entry_points

Shell = Literal["bash", "zsh", "fish"]


class Completion(Flags):
    """Print a script that lets a shell complete commands, flags and choices."""

    shell: Annotated[tyro.conf.Positional[Shell], tyro.conf.arg(metavar="{bash,zsh,fish}")]
    """Shell that will read the script (docs/command-line.md)."""


def run(arguments: Completion) -> None:
    """Print the script."""
    print(completion_script(arguments.shell))


def completion_script(shell: Shell) -> str:
    """Return a completion script, which contains all completions and so never starts Python.

    Configuration flags are those of the default parts. If an extra that a command needs is not
    installed, only the command's name is completed.
    """
    import shtab

    from crisalad_jax.cli import _COMMANDS

    load_entry_points()
    root = argparse.ArgumentParser("crisalad", add_help=False)
    root.add_argument("-h", "--help", action="help", help="list the commands")
    root.add_argument("--version", action="version", version="", help="print the version")
    commands = root.add_subparsers()
    for name, about in _COMMANDS.items():
        try:
            parents = [_parser(name)]
        except ModuleNotFoundError:
            parents = []
        parser = commands.add_parser(name, help=about["summary"], parents=parents, add_help=False)
        parser.add_argument("-h", helping.SHORT, action="help", help="show the common flags")
        parser.add_argument(helping.ALL, action="help", help="show all flags")
    return shtab.complete(root, shell)


def _parser(name: str) -> argparse.ArgumentParser:
    """Make a command's parser, with names of presets, recipes and models as choices."""
    from crisalad_jax.nn.config import PRESETS
    from crisalad_jax.training.recipes import RECIPES

    module = importlib.import_module(f"crisalad_jax.cli.{name}")
    parser = helping.flags_parser(helping.class_of(name, module, ()), f"crisalad {name}")
    names = {"preset": PRESETS, "recipe": RECIPES, "name": (*starter.FILES, *PUBLISHED)}
    for action in parser._actions:
        choices = names.get(action.dest, action.choices or ())
        action.choices = tuple(each for each in choices if each != "None") or None
        if action.dest in ("weights", "rerank-weights", "backbone"):
            action.complete = _models_and_files()  # pyright: ignore
        action.help = " ".join((action.help or "").partition(". ")[0].split())
    return parser


def _models_and_files() -> dict[str, Any]:
    """Return how each shell completes weights: by model names and files."""
    names = " ".join((starter.NAME, *PUBLISHED))
    function = "_crisalad_models_and_files"  # shtab's bash looks for _file in it
    return {
        "bash": function,
        "zsh": function,
        "fish": f"{names} (__fish_complete_path (commandline -ct))",
        "preamble": {
            "bash": f'{function}() {{ compgen -W "{names}" -- "$1"; compgen -f -- "$1"; }}',
            "zsh": f"{function}() {{ _alternative 'models:model:({names})' 'files:file:_files'; }}",
        },
    }
