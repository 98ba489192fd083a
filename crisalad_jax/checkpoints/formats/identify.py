"""Infer what a public checkpoint is, whatever training tools put around its names.

torch.compile, DataParallel, FSDP and activation checkpointing wrap modules, each under a name of
its own; Lightning has the network in a field `model`. The training of facebookresearch/dinov2 and
dinov3 saves its teacher with heads, or next to its student, and its blocks in chunks.
"""

import re
from collections.abc import Iterator, Set
from typing import NamedTuple

from crisalad_jax.checkpoints.formats.families import FORMATS
from crisalad_jax.checkpoints.formats.sizes import State
from crisalad_jax.checkpoints.formats.table import public_shapes
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_WRAPPERS = r"(?<![^.])(?:_orig_mod|module|_fsdp_wrapped_module|_checkpoint_wrapped_module)\."
_CHUNKS = r"(?<![^.])(blocks\.)\d+\.(?=\d+\.)"
"""Number of a chunk, before that of the block, which counts on from chunk to chunk."""
_HEADS = ("dino_head.", "ibot_head.")


class _Reading(NamedTuple):
    """A way to read a state."""

    state: State
    inside: str = ""
    """Prefix of the names that it has, without that prefix."""
    left_out: tuple[str, ...] = ()
    """Names that it leaves out."""


def infer(state: State, *, source: str) -> tuple[str, ModelConfig]:
    """Return the format and the configuration that `identify` infers, and raise what it raises."""
    return identify(state, source=source)[:2]


def identify(state: State, *, source: str) -> tuple[str, ModelConfig, State]:
    """Infer the format and the configuration of a state, from its names and shapes.

    Settings that no shape shows are the published ones: heads of width 64 in the backbone, 16 heads
    in the encoder, alpha 0.2, three Sinkhorn iterations, the family's image size and resize. Names
    of wrappers are taken away; a note says what else is left out.

    Returns:
        (format, configuration, the arrays by the format's own names).

    Raises:
        InputError: naming `source`, if the names are of no format or the widths of no model.
    """
    found: list[tuple[int, str, ModelConfig, _Reading]] = []
    problems: list[str] = []
    for reading in _readings(state):
        for each in FORMATS.values():
            if each.has_backbone(reading.state) and each.has_head(reading.state):
                try:
                    config = each.infer(reading.state)
                    names = public_shapes(config, each.name).keys()
                except InputError as error:
                    problems.append(f"{error}, as in {each.holds}")
                else:
                    unlike = len(names ^ reading.state.keys())
                    found.append((unlike, each.name, config, reading))
        if any(unlike == 0 for unlike, *_ in found):
            break
    if found:
        # Families share names: the one that holds most of them, and the first of equals.
        _, name, config, reading = min(found, key=lambda each: each[0])
        _tell_left_out(reading, source)
        return name, config, reading.state
    if problems:
        raise InputError(f"{source}: {problems[0]}")
    for reading in _readings(state):
        _check_halves(reading.state, source)
    names = ", ".join(sorted(state)[:3]) or "none"
    raise InputError(
        f"{source}: found no checkpoint that we know (its first names: {names}), expected one of "
        f"the {len(FORMATS)} kinds that `crisalad convert --help-all` lists"
    )


def renamed_to(state: State, names: Set[str]) -> State:
    """Return the reading of a state that has the most of these names, and no others."""
    return min((each.state for each in _readings(state)), key=lambda x: len(names ^ x.keys()))


def _readings(state: State) -> Iterator[_Reading]:
    """Yield a state as it is, without wrappers' names, and then what is inside it, step by step."""
    reading = _Reading(state)
    yield reading
    names = {name: re.sub(_CHUNKS, r"\1", re.sub(_WRAPPERS, "", name)) for name in state}
    if len(set(names.values())) < len(names):
        return  # of two networks: no name may stand for two arrays
    reading = _Reading({names[name]: array for name, array in state.items()})
    if reading.state.keys() != state.keys():
        yield reading
    while prefix := _prefix(reading.state):
        inside = {
            n.removeprefix(prefix): x for n, x in reading.state.items() if n.startswith(prefix)
        }
        others = tuple(name for name in reading.state if not name.startswith(prefix))
        reading = _Reading(inside, reading.inside + prefix, reading.left_out + others)
        yield reading


def _prefix(state: State) -> str | None:
    """Return the prefix of what may be a model by itself inside a state."""
    for prefix in ("model.", "teacher."):
        if any(name.startswith(prefix) for name in state):
            return prefix
    others = [name for name in state if not name.startswith("backbone.")]
    is_training = bool(others) and all(name.startswith(_HEADS) for name in others)
    return "backbone." if is_training else None


def _tell_left_out(reading: _Reading, source: str) -> None:
    if reading.left_out:
        kinds = dict.fromkeys(name.partition(".")[0] for name in reading.left_out)
        warn(
            f"{source}: took the model under {reading.inside.removesuffix('.')}, and left out "
            f"{len(reading.left_out)} tensors of {', '.join(kinds)}"
        )


def _check_halves(state: State, source: str) -> None:
    """Raise InputError where a state is the head of a family without its backbone, or the reverse.

    Families share the names of their parts: the message has all that it may be of.
    """
    formats = [each for each in FORMATS.values() if not each.has_head({})]
    heads = [each.holds for each in formats if each.has_head(state)]
    backbones = [each.holds for each in formats if each.has_backbone(state)]
    for here, families, missing in (("head", heads, "backbone"), ("backbone", backbones, "head")):
        if families:
            raise InputError(
                f"{source}: found a {here} without its {missing}, expected both in one file, as in "
                f"{' or '.join(families)}"
            )
