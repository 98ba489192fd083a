"""Run what the documentation shows; a program of its own, for parts that it registers stay.

    python tests/docs_blocks.py PAGE.md ...

A Python block below `<!-- run -->` is run, in one namespace for a page. One below
`<!-- run: FILE.py -->` is written to FILE.py, and loaded as a plug-in. Every `crisalad` command in
a bash block is parsed, and nothing of it is done.
"""

import contextlib
import importlib
import itertools
import os
import pathlib
import re
import shlex
import sys
import tempfile
import time

import crisalad_jax as cj
from crisalad_jax import cli
from crisalad_jax.config import plugins
from crisalad_jax.config import registry as registries
from crisalad_jax.config.flags import flag_values
from crisalad_jax.training.recipes import RECIPES

BLOCK = re.compile(
    r"^(?:<!-- (?P<run>run)(?:: (?P<file>\S+))? -->\n)?"
    r"```(?P<language>python|bash)[^\n]*\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


@contextlib.contextmanager
def own_parts():
    """Forget what is registered meanwhile: pages choose the same names."""
    tables = [RECIPES, plugins._LOADED]
    for registry in registries.REGISTRIES.values():
        tables += [registry._parts, registry._presets]
    before = [dict(table) for table in tables]
    yield
    for plugin in plugins._LOADED.keys() - before[1].keys():
        del sys.modules[plugins._LOADED[plugin]]
    for table, was in zip(tables, before, strict=True):
        table.clear()
        table.update(was)


def load(file: str, code: str, page: str, line: int) -> dict:
    """Write a plug-in, load it, and return its names."""
    pathlib.Path(file).write_text("\n" * line + code)  # so that errors name the page's line
    try:
        cj.load_plugin(file)
    except cj.InputError as error:
        raise RuntimeError(f"{page}: {error}") from error
    return vars(sys.modules[plugins._LOADED[str(pathlib.Path(file).resolve())]])


def parse(command: str) -> None:
    """Parse one command as the command line would."""
    _, verb, *given = shlex.split(command, comments=True)
    # What follows is the shell's: a pipe, or a file for the output.
    given = list(itertools.takewhile(lambda argument: argument not in ("|", ">"), given))
    given = [argument for argument in given if argument not in ("--help", "--help-all")]
    for files in flag_values(given, "--plugin"):
        for file in files:
            cj.load_plugin(file)
    if given:
        cli._parse(
            verb, importlib.import_module(f"crisalad_jax.cli.{verb.replace('-', '_')}"), given
        )


def run(page: str, text: str) -> int:
    """Run a page's blocks, and return how many."""
    names: dict = {"__name__": "__docs__"}
    count = 0
    for block in BLOCK.finditer(text):
        line, code = text.count("\n", 0, block.start("code")), block["code"]
        if block["language"] == "bash":
            for command in code.replace("\\\n", " ").splitlines():
                if command.startswith("crisalad "):
                    try:
                        parse(command)
                    except cj.InputError as error:
                        raise RuntimeError(f"{page}: {command}: {error}") from error
        elif block["file"]:
            names |= load(block["file"], code, page, line)
            count += 1
        elif block["run"]:
            exec(compile("\n" * line + code, page, "exec"), names)
            count += 1
    return count


def main() -> None:
    """Run every page in a folder of its own, beside the documentation and the examples."""
    root = pathlib.Path(__file__).resolve().parents[1]
    for page in sys.argv[1:]:
        text = pathlib.Path(page).read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder, own_parts():
            for beside in ("docs", "examples"):
                os.symlink(root / beside, pathlib.Path(folder) / beside)
            os.chdir(folder)
            start = time.process_time()
            count = run(page, text)
            print(f"{page}: {count} blocks in {time.process_time() - start:.1f} s", flush=True)
            os.chdir(root)


if __name__ == "__main__":
    main()
