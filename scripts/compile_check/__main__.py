"""Compile describing and training for absent GPUs and TPUs, without running anything.

    python -m scripts.compile_check --targets h100 --preset b14 [--expect FIGURES.json]

`pip install -r scripts/bench/compile_check.txt` installs XLA's compilers. They take minutes on a
CPU.
"""

import dataclasses
import pathlib
import sys
from typing import Annotated, Any

from crisalad_jax.cli.common import emit_json, prepare_output, show
from crisalad_jax.cli.flags import Target
from crisalad_jax.cli.train import defaults, preset_of
from crisalad_jax.config.flags import parse_settings
from crisalad_jax.utils.errors import InputError
from scripts.compile_check import compile_check, differences, read_check
from scripts.compile_check.tables import check_tables
from scripts.compile_check.targets import compile_on_cpu


@dataclasses.dataclass(frozen=True)
class CompileCheck:
    """Compile describing and training for absent GPUs and TPUs, without running anything."""

    settings: Any
    targets: tuple[str, ...] = ("v5e-1", "v5e-8", "v6e-8", "h100", "h100-8")
    """Machines: v4, v5p, v5e-1, v5e-8, v5e-64, v5e-256, v6e-1, v6e-8, h100, h100-8. The suffix is
    the number of devices; v4 and v5p are a host with four."""
    programs: tuple[str, ...] = ("describe", "train")
    """describe, train or both."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14: the model size that the other flags modify."""
    recipe: str | None = None
    """Training recipe, as in `crisalad train`."""
    config: pathlib.Path | None = None
    """Configuration of a run (its config.json) to use instead of a preset."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; replaces --model.image-size."""
    batch_size: int | None = None
    """Number of images in a batch, over all devices; by default that of a training step."""
    expect: pathlib.Path | None = None
    """JSON of an earlier check to compare with: memory and operations within 5 %, and equal counts
    of collectives, sums in bfloat16, calls of fused attention and host callbacks."""
    keep: pathlib.Path | None = None
    """Existing folder for the HLO text of the compiled programs."""
    json: Annotated[pathlib.Path | None, Target((".json",))] = None
    """File for the figures as JSON, to be read by --expect; - prints it."""
    quiet: bool = False
    """Hide the progress bar."""


def main() -> None:
    """Print the table of compiled programs, write it as JSON, and compare it with --expect."""
    given = sys.argv[1:]
    start = defaults(given), preset_of(given)
    arguments = parse_settings(CompileCheck, "compile_check", given, *start)
    compile_on_cpu()
    prepare_output(arguments)
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
    emit_json(arguments.json, check.as_json())
    lines = check.failures if expected is None else differences(check, expected)
    if lines:
        sys.exit("\n".join(lines))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(str(error))
