"""Compile programs for machines, count their operations, and compare with expected figures."""

import dataclasses
import importlib.metadata
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax

from crisalad_jax.config.checks import choose
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.progress import progress_bar
from scripts.compile_check.counts import KERNEL, Counts, Work, count
from scripts.compile_check.hlo import parse_hlo
from scripts.compile_check.kernels import kernel_cycles
from scripts.compile_check.programs import PROGRAMS, compile_program
from scripts.compile_check.targets import MACHINES, Card, check_compiler

TOLERANCE = 0.05
"""Largest relative difference of memory and operations from the expected figures, because another
version of the compiler schedules differently."""
_PACKAGES = ("jax", "jaxlib", "libtpu", "jax-cuda12-plugin", "jax-cuda13-plugin")


@dataclasses.dataclass(frozen=True)
class ProgramCheck:
    """Resources and operations of one compiled program on each device."""

    target: str
    program: str
    images: int
    """Number of images in the batch, over all devices."""
    memory: int
    """Peak bytes of the program: inputs, outputs and temporary buffers."""
    card_memory: float
    """Memory of the card in bytes."""
    aliased: int
    """Bytes of outputs that reuse the memory of inputs."""
    flops: int
    """Floating-point operations of products."""
    hbm_bytes: int
    """Bytes of HBM read and written at the boundaries of fusions."""
    sent: int
    """Bytes sent to other devices."""
    collectives: Mapping[str, int]
    """Number of collectives in the program's text, by kind."""
    bfloat16_sums: int
    """Number of sums over devices in bfloat16, which round gradients."""
    fused_attention: int
    """Number of calls of cuDNN's attention, or of Pallas kernels."""
    host_callbacks: int
    """Number of operations that wait for the host."""
    roofline: float
    """Seconds by roofline: for each operation the larger of its compute and its memory time."""
    messages: float
    """Seconds of communication at the speed of the links, not overlapped with other work."""
    compiler: float | None
    """Seconds by libtpu's estimated cycles, and by its schedule of Pallas kernels; None for a GPU,
    whose compiler has no estimates."""
    kernels: float | None
    """Seconds of Pallas kernels among those; by roofline if libtpu wrote no schedule."""

    @property
    def images_per_second(self) -> float:
        """Return images per second over all devices, by the larger estimate plus communication."""
        return self.images / (max(self.roofline, self.compiler or 0) + self.messages)


@dataclasses.dataclass(frozen=True)
class CompileCheck:
    """The compiled programs and their configuration."""

    config: TrainConfig
    programs: tuple[ProgramCheck, ...]
    failures: tuple[str, ...] = ()
    """One line for each program that doesn't compile."""
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Versions of the installed compilers."""

    def as_json(self) -> dict[str, Any]:
        """Convert to JSON values that `read_check` reads."""
        return {
            "versions": dict(self.versions),
            "config": to_plain(self.config),
            "programs": [dataclasses.asdict(each) for each in self.programs],
            "failures": list(self.failures),
        }


def compile_check(
    config: TrainConfig,
    targets: Sequence[str],
    *,
    programs: Sequence[str] = PROGRAMS,
    images: int | None = None,
    keep: pathlib.Path | None = None,
    expected: CompileCheck | None = None,
    quiet: bool = False,
) -> CompileCheck:
    """Compile describing and training for machines that may be absent.

    Nothing is executed. XLA's compilers for TPUs and GPUs run on a CPU, with the packages
    `jax[tpu]` and `jax-cuda12-plugin`. They take minutes and about 3 GB of memory.

    Args:
        config: the model and its training.
        targets: names of `MACHINES`.
        programs: "describe", "train" or both.
        images: number of images in a batch, over all devices; None uses the configuration's.
        keep: existing folder for the text of the compiled programs; None writes none.
        expected: an earlier check to compare with later; its configuration is checked first.
        quiet: hide the progress bar.

    Returns:
        Resources and operations of each program. Programs that don't compile are in `failures`.

    Raises:
        InputError: an unknown target, program or folder, a compiler that isn't installed, a batch
            that the devices can't share equally, or expected figures of another configuration.

    Example:
        >>> from crisalad_jax import recipe
        >>> compile_check(recipe("tiny"), ["v5e-8"], images=4)
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: batch size: found 4 images for 8 devices, ...
    """
    batch = config.places_per_batch * config.images_per_place if images is None else images
    if expected is not None:
        _check_same(config, expected.config)
    if keep is not None and not keep.is_dir():
        raise InputError(f"{keep}: found no folder, expected one for the programs' texts")
    for program in programs:
        choose("program", program, dict.fromkeys(PROGRAMS))
    machines = {name: choose("target", name, MACHINES) for name in dict.fromkeys(targets)}
    for name, each in machines.items():
        each.check_batch(batch)
        check_compiler(each, name)
    found, failures = [], []
    with progress_bar("compiling", len(machines) * len(programs), "programs", quiet=quiet) as bar:
        for name, each in machines.items():
            for program in programs:
                try:
                    compiled = compile_program(program, each, config, batch)
                except jax.errors.JaxRuntimeError as error:
                    failures.append(
                        f"{name} {program}: found that it does not compile: {one_line(error)[:300]}"
                    )
                    bar.advance(1, note=f"{name} {program} failed")
                    continue
                text = compiled.as_text() or ""
                if keep is not None:
                    (keep / f"{name}-{program}-{batch}.hlo").write_text(text)
                parsed = parse_hlo(text)
                cycles = kernel_cycles(parsed) if each.platform == "tpu" else {}
                counts = count(parsed, each.devices, cycles)
                memory = compiled.memory_analysis()
                found.append(_check(name, program, batch, each.card, counts, memory))
                bar.advance(1, note=f"{name} {program}")
    return CompileCheck(config, tuple(found), tuple(failures), _versions())


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _check(
    target: str, program: str, images: int, card: Card, counts: Counts, memory: Any
) -> ProgramCheck:
    given, returned = memory.argument_size_in_bytes, memory.output_size_in_bytes
    aliased = memory.alias_size_in_bytes
    kernels = None
    if card.clock is not None:
        kernels = sum(_kernel(each, card, card.clock) for each in counts.work)
    return ProgramCheck(
        target=target,
        program=program,
        images=images,
        memory=given + returned - aliased + memory.temp_size_in_bytes,
        card_memory=card.memory,
        aliased=aliased,
        flops=counts.flops,
        hbm_bytes=counts.bytes,
        sent=counts.sent,
        collectives=counts.collectives,
        bfloat16_sums=counts.bfloat16_sums,
        fused_attention=counts.fused_attention,
        host_callbacks=counts.host_callbacks,
        roofline=sum(_roofline(each, card) for each in counts.work),
        messages=counts.sent / card.link,
        compiler=None if kernels is None else kernels + _cycles(counts) / (card.clock or 1),
        kernels=kernels,
    )


def _roofline(work: Work, card: Card) -> float:
    return work.times * card.seconds(work.flops, work.bytes)


def _kernel(work: Work, card: Card, clock: float) -> float:
    if work.target != KERNEL:
        return 0
    return _roofline(work, card) if work.cycles is None else work.times * work.cycles / clock


def _cycles(counts: Counts) -> int:
    others = (each for each in counts.work if each.target != KERNEL)
    return sum(each.times * (each.cycles or 0) for each in others)


def read_check(path: pathlib.Path) -> CompileCheck:
    """Read a check that was written as JSON from `CompileCheck.as_json`.

    Raises:
        InputError: the file can't be read, or isn't a check.
    """
    what = "the JSON of `scripts.compile_check --json`"
    value = read_json(path, what, sealed=False)
    try:
        programs = tuple(ProgramCheck(**each) for each in value["programs"])
        config, versions = value["config"], value["versions"]
    except (LookupError, TypeError) as error:
        raise InputError(f"{path}: found {error}, expected {what}") from error
    return CompileCheck(from_plain(TrainConfig, config, source=str(path)), programs, (), versions)


def differences(found: CompileCheck, expected: CompileCheck) -> list[str]:
    """List the differences between two checks.

    Memory and floating-point operations may differ by `TOLERANCE`; counts may not differ. Times and
    traffic are not compared.

    Args:
        found: the new check.
        expected: from `read_check`. Programs that are not in `found` are ignored.

    Returns:
        One line for each difference.

    Raises:
        InputError: the configurations differ.
    """
    _check_same(found.config, expected.config)
    by_name = {_name(each): each for each in expected.programs}
    lines = list(found.failures)
    for each in found.programs:
        other = by_name.get(_name(each))
        if other is None:
            lines.append(f"{_name(each)}: found no expected figures, expected some")
            continue
        for field in ("memory", "flops"):
            mine, theirs = getattr(each, field), getattr(other, field)
            if abs(mine - theirs) > TOLERANCE * theirs:
                lines.append(
                    f"{_name(each)}: found {field} {mine:,}, expected {theirs:,} within "
                    f"{100 * TOLERANCE:.0f} %"
                )
        for field in _EXACT:
            mine, theirs = getattr(each, field), getattr(other, field)
            if mine != theirs:
                lines.append(
                    f"{_name(each)}: found {field} {json.dumps(mine)}, expected "
                    f"{json.dumps(theirs)}"
                )
    return lines


_OF_PROGRAMS = ("model", "loss", "optimiser", "trainable", "micro_batch", "batch_norm")
"""Fields of a configuration that compiled programs depend on."""
_EXACT = ("aliased", "collectives", "bfloat16_sums", "fused_attention", "host_callbacks")


def _name(check: ProgramCheck) -> str:
    return f"{check.target} {check.program} of {check.images} images"


def _check_same(config: TrainConfig, expected: TrainConfig) -> None:
    mine, theirs = (
        _flat({name: to_plain(each)[name] for name in _OF_PROGRAMS}) for each in (config, expected)
    )
    names = sorted(name for name in mine | theirs if mine.get(name) != theirs.get(name))
    if names:
        first = names[0]
        more = f" and {len(names) - 1} more fields" if len(names) > 1 else ""
        raise InputError(
            f"--expect: found figures for {first} {json.dumps(theirs.get(first))}{more}, expected "
            f"those of this configuration, {json.dumps(mine.get(first))}"
        )


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix: value}
    flat = {}
    for name, each in value.items():
        flat |= _flat(each, f"{prefix}.{name}" if prefix else name)
    return flat
