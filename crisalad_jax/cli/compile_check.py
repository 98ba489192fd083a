"""`crisalad compile-check`."""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from crisalad_jax.cli.common import check_json, show, talk_beside, write_or_print_json
from crisalad_jax.cli.train import defaults
from crisalad_jax.config.flags import parse_settings, with_settings
from crisalad_jax.utils.errors import InputError

COMMON = (
    "targets",
    "programs",
    "preset",
    "recipe",
    "config",
    "image-size",
    "batch-size",
    "model.aggregator",
    "micro-batch",
    "expect",
    "keep",
    "json",
    "quiet",
)
EXAMPLE = "crisalad compile-check --targets h100 --preset b14"


@dataclasses.dataclass(frozen=True)
class CompileCheck:
    """Compile describing and training for GPUs and TPUs that need not be here; run nothing.

    `jax[tpu]` and `jax-cuda12-plugin`, of the installed version of JAX, bring XLA's compilers. They
    take minutes on a CPU.
    """

    settings: Any
    targets: tuple[str, ...] = ("v5e-1", "v5e-8", "v6e-8", "h100", "h100-8")
    """Machines: v4, v5p, v5e-1, v5e-8, v5e-64, v5e-256, v6e-1, v6e-8, h100, h100-8 (the number of
    devices; of v4 and v5p a host with four)."""
    programs: tuple[str, ...] = ("describe", "train")
    """describe, train or both."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14: the size of the model that the other flags start from."""
    recipe: str | None = None
    """How it trains, as in `crisalad train`."""
    config: pathlib.Path | None = None
    """Configuration of a run (its config.json) to start from instead of a preset."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; replaces --model.image-size."""
    batch_size: int | None = None
    """Images in a batch on all devices together; by default those of a training step."""
    expect: pathlib.Path | None = None
    """JSON of an earlier check to compare with: memory and operations within 5 %, and equal numbers
    of collectives, sums in bfloat16, calls of fused attention and calls of the host."""
    keep: pathlib.Path | None = None
    """Existing folder for the texts of the compiled programs (HLO)."""
    json: pathlib.Path | None = None
    """File for the figures as JSON, which --expect reads; - prints it."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bar."""


def parse(program: str, arguments: Sequence[str]) -> CompileCheck:
    """Parse the flags, with one for every field of the configuration and of its parts."""
    return parse_settings(CompileCheck, program, arguments, defaults(arguments), ())


def command(arguments: Sequence[str]) -> type:
    """Return the class that these arguments are parsed into, for help and completion."""
    return with_settings(CompileCheck, arguments, defaults(arguments), ())[0]


def run(arguments: CompileCheck) -> None:
    """Print the table of what was compiled, write it as JSON, and compare it where asked."""
    from crisalad_jax.experiments.compile_check import compile_check, differences, read_check
    from crisalad_jax.experiments.compile_check.tables import check_tables
    from crisalad_jax.experiments.compile_check.targets import compile_on_cpu

    compile_on_cpu()
    check_json(arguments.json)
    talk_beside(arguments.json)
    expected = None if arguments.expect is None else read_check(arguments.expect)
    check = compile_check(
        arguments.settings,
        arguments.targets,
        programs=arguments.programs,
        images=arguments.batch_size,
        keep=arguments.keep,
        expected=expected,
        quiet=arguments.quiet,
    )
    for table in check_tables(check) if check.programs else ():
        show(table)
    if arguments.json is not None:
        write_or_print_json(arguments.json, check.as_json())
    lines = check.failures if expected is None else differences(check, expected)
    for line in lines:
        print(f"crisalad: {line}", file=sys.stderr)
    if lines:
        what = "programs that do not compile" if expected is None else "differences"
        raise InputError(f"compile-check: found {len(lines)} {what}, expected none")
