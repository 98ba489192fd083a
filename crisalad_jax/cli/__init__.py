"""The command line: a module for each command, which parses its flags and calls the library.

Exit codes: 0 done; 2 bad arguments or input (one line on stderr); 130 interrupted; 143 ended by
SIGTERM; 129 ended by SIGHUP; 134 (or 2) a process of the run was lost; 1 anything else.
"""

import dataclasses
import difflib
import importlib
import os
import pathlib
import re
import signal
import sys
import tomllib
from collections.abc import Iterator, Sequence
from typing import Any

from crisalad_jax.config.checks import require
from crisalad_jax.config.plugins import (
    load_entry_points,
    load_plugin,
    loaded_plugins,
    plugin_failure,
)
from crisalad_jax.utils.errors import InputError, Interrupted, how_ended
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.output import one_line, print_notes, printable
from crisalad_jax.utils.version import VERSION

_COMMANDS: dict[str, dict[str, str]] = tomllib.loads(
    pathlib.Path(__file__).with_name("commands.toml").read_text(encoding="utf-8")
)
"""Help of each command, from commands.toml.

Each command is a module here, whose function `run` takes the parsed flags, and may return what
--json writes or prints. It may also have `needs_jax(flags)`; if that returns false, a command that
uses JAX after all calls `common.Jax.set_up` first.
"""


def _parse(name: str, module: Any, given: Sequence[str]) -> Any:
    """Parse the flags into an instance of a command's class; tyro's errors become one line."""
    import tyro

    from crisalad_jax.cli import help as helping
    from crisalad_jax.config.flags import refusals

    program = f"crisalad {name}"
    asked = helping.asked_for(given)
    try:
        if asked == helping.SHORT:
            print(helping.short_help(name, _COMMANDS[name], helping.class_of(name, module, given)))
            raise SystemExit(0)
        given = [helping.SHORT if each == helping.ALL else each for each in given]
        with refusals(given, wide=asked is None):
            if hasattr(module, "parse"):
                return module.parse(program, given)
            return tyro.cli(helping.class_of(name, module, given), prog=program, args=given)
    except InputError as error:
        if isinstance(error.__cause__, OSError):  # the help cannot be printed
            raise
        several = _COMMANDS[name].get("several", "")
        hint = f" ({several})" if re.match("--images: .* expected one value$", str(error)) else ""
        raise InputError(f"{error}{hint} (see {program} --help)") from error


def _usage() -> str:
    usage = "usage: crisalad COMMAND [--help | --help-all] ... | help [COMMAND] | --version"
    lines = [usage, "", "commands:"]
    lines += [f"  {name:<15}{about['summary']}" for name, about in _COMMANDS.items()]
    return "\n".join(lines)


_MAX_PIXELS = "OPENCV_IO_MAX_IMAGE_PIXELS"


def _limit_pixels(given: Sequence[str]) -> None:
    """Set the largest image that OpenCV decodes, before OpenCV is imported."""
    from crisalad_jax.config.flags import find_flag

    pixels, source = find_flag(given, "--max-pixels"), "--max-pixels"
    if pixels is None:  # OpenCV would abort the process
        pixels, source = os.environ[_MAX_PIXELS], _MAX_PIXELS
    require(
        pixels.isdecimal() and len(pixels) <= 12 and int(pixels) > 0,
        f"{source}: found {pixels!r}, expected a number of pixels",
    )
    os.environ[_MAX_PIXELS] = pixels


def _run(name: str, arguments: list[str], keep_programs: bool) -> None:
    require("" not in arguments, "arguments: found an empty one, expected a value")
    _limit_pixels(arguments)
    load_entry_points()
    from crisalad_jax.cli.common import Jax, emit_json, prepare_output
    from crisalad_jax.config.flags import flag_values

    for plugins in flag_values(arguments, "--plugin"):
        require(bool(plugins), "--plugin: found no value, expected FILE.py or MODULE")
        for plugin in plugins:
            load_plugin(plugin)

    module = importlib.import_module(f"{__name__}.{name}")
    if hasattr(module, "prepare"):
        arguments = module.prepare(arguments)
    chosen = _parse(name, module, arguments)
    for flag, number in _numbers("", chosen):
        # Arrays take no larger number, and no count or size comes near it.
        require(
            abs(number) <= 2**40, f"--{flag}: found {number}, expected a number of at most 2**40"
        )
    prepare_output(chosen)
    Jax.keeps_programs = keep_programs and not loaded_plugins()
    if not hasattr(module, "needs_jax") or module.needs_jax(chosen):
        Jax.set_up()
    values = module.run(chosen)
    if values is not None:
        emit_json(chosen.json, values)


def _numbers(flag: str, value: Any) -> Iterator[tuple[str, int]]:
    """Yield the flag and the value of each whole number in a command's arguments."""
    if isinstance(value, int):
        yield flag, value
    elif isinstance(value, tuple):
        for each in value:
            yield from _numbers(flag, each)
    elif dataclasses.is_dataclass(value):
        for name, each in vars(value).items():
            # The fields of a configuration are flags without a prefix.
            path = "" if name == "settings" else f"{flag}.{name}".strip(".").replace("_", "-")
            yield from _numbers(path, each)


def main(arguments: Sequence[str] | None = None, *, keep_programs: bool = False) -> int:
    """Run the command that `arguments` (by default `sys.argv[1:]`) name; return its exit code.

    `keep_programs` caches compiled programs (`utils.executable_cache`). Set it only in a process
    that runs nothing but this package, where nothing else changes the code.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["help"]:  # as in git
        given = [*given[1:], "--help"]
    if not given or given[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if given else sys.stderr)
        return 0 if given else 2
    if given == ["--version"]:
        print(f"crisalad-jax {VERSION}")
        return 0
    with print_notes():
        return _exit_code(given, keep_programs)


def _exit_code(given: list[str], keep_programs: bool) -> int:
    try:
        _check_command(given[0])
        _run(given[0], given[1:], keep_programs)
        return 0
    except Interrupted as stopped:
        reason, code = str(stopped), 128 + stopped.number
    except KeyboardInterrupt:
        reason, code = how_ended(signal.SIGINT), 128 + signal.SIGINT
    except BaseException as error:
        reason, code = _reason(error, given[0]), 2
        if reason is None and isinstance(error, SystemExit):  # from tyro, after --help
            return 0
        if reason is None:
            raise
    print(f"crisalad: {reason}", file=sys.stderr)
    return code


def _check_command(name: str) -> None:
    """Raise InputError for an unknown command, and suggest similar names or list all commands."""
    near = difflib.get_close_matches(name, _COMMANDS)
    words = f"did you mean {' or '.join(near)}?" if near else f"expected {', '.join(_COMMANDS)}"
    require(name in _COMMANDS, f"found no command {name!r}; {words} (see crisalad --help)")


_WORDS_OF_MEMORY = (
    *("RESOURCE_EXHAUSTED", "Insufficient memory", "bad_alloc", "Cannot allocate memory"),
    *("failed to map segment", "can't start new thread", "Unable to allocate"),
    "error return without exception set",
)
"""Out-of-memory errors of XLA, OpenCV, C++, the system, its linker, threads, numpy and C code."""


def _reason(error: BaseException, name: str) -> str | None:
    """Describe an error of known cause in one line; return None for others."""
    if isinstance(error, ModuleNotFoundError):
        return missing_extra(error, f"crisalad {name}")
    if isinstance(error, InputError | OSError):  # OSError: a full disk, or what no check foresaw
        return one_line(error)
    if (failure := plugin_failure(error)) is not None:
        return f"{printable(failure)} (from Python you see the traceback)"
    if isinstance(error, MemoryError) or any(each in str(error) for each in _WORDS_OF_MEMORY):
        advice = "expected more, or a smaller --batch-size, --image-size or model"
        return f"found not enough memory, {advice}"
    if isinstance(error, Exception) and "jax" in sys.modules:
        from crisalad_jax.utils.target import absent_platforms

        return absent_platforms(error)
    return None
