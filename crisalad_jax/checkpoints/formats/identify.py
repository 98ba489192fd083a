"""Infer what a public checkpoint is, whatever prefixes training tools add to its names.

torch.compile, DataParallel, FSDP and activation checkpointing each insert a name of their own, and
Lightning puts the network in a field `model`. The training code of facebookresearch/dinov2 and
dinov3 saves the teacher with its heads, or next to the student, and groups blocks into chunks.
"""

import re
from collections.abc import Iterator, Set

from crisalad_jax.checkpoints.formats.families import FORMATS
from crisalad_jax.checkpoints.formats.sizes import State
from crisalad_jax.checkpoints.formats.table import public_shapes
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_WRAPPERS = r"(?<![^.])(?:_orig_mod|module|_fsdp_wrapped_module|_checkpoint_wrapped_module)\."
_CHUNKS = r"(?<![^.])(blocks\.)\d+\.(?=\d+\.)"
"""Number of a chunk, before that of the block; blocks are numbered across chunks."""
_HEADS = ("dino_head.", "ibot_head.")


def infer(state: State, *, source: str) -> tuple[str, ModelConfig]:
    """Infer only the format and the configuration; see `identify` for the arguments and errors."""
    return identify(state, source=source)[:2]


def identify(state: State, *, source: str) -> tuple[str, ModelConfig, State]:
    """Infer the format and configuration of `state`, a checkpoint's arrays by name.

    Settings that shapes do not show are the published ones: heads of width 64 in most backbones, 16
    heads in the encoder, adapters with alpha 0.2 (side adapters 0.5 or 1), three Sinkhorn
    iterations, the family's image size and resize. A warning counts tensors that are left out.

    Returns:
        (name of the format, configuration, arrays by name without the prefixes of wrappers).

    Raises:
        InputError: the names fit no format, or the sizes no model; the message names the file.
    """
    found: list[tuple[int, str, ModelConfig, str, State]] = []
    problems: list[str] = []
    for prefix, inside in _readings(state):
        for each in FORMATS.values():
            if each.has_backbone(inside) and each.has_head(inside):
                try:
                    config = each.infer(inside)
                    names = public_shapes(config, each.name).keys()
                except InputError as error:
                    problems.append(f"{error}, as in {each.holds}")
                else:
                    unlike = len(names ^ inside.keys())
                    found.append((unlike, each.name, config, prefix, inside))
        if any(unlike == 0 for unlike, *_ in found):
            break
    if found:
        # Families share names: take the one that fits most of them, the first among equals.
        _, name, config, prefix, inside = min(found, key=lambda each: each[0])
        if others := len(state) - len(inside):
            place = prefix.removesuffix(".")
            warn(f"{source}: took the model under {place}, and left out {others} other tensors")
        return name, config, inside
    if problems:
        raise InputError(f"{source}: {problems[0]}")
    names = ", ".join(sorted(state)[:3]) or "none"
    raise InputError(
        f"{source}: found no checkpoint that we know (its first names: {names}), expected one of "
        f"the {len(FORMATS)} kinds that `crisalad convert --help-all` lists, backbone and head in "
        "one file"
    )


def renamed_to(state: State, names: Set[str]) -> State:
    """Return a state with wrappers and prefixes stripped from its names, to fit `names` best."""
    return min((inside for _, inside in _readings(state)), key=lambda x: len(names ^ x.keys()))


def _readings(state: State) -> Iterator[tuple[str, State]]:
    """Yield a state as it is, then without wrapper names, then what is under longer prefixes."""
    yield "", state
    names = {name: re.sub(_CHUNKS, r"\1", re.sub(_WRAPPERS, "", name)) for name in state}
    if len(set(names.values())) < len(names):
        return  # two networks, of which one name would mean two arrays
    whole, inside = "", {names[name]: array for name, array in state.items()}
    if inside.keys() != state.keys():
        yield whole, inside
    while prefix := _prefix(inside):
        whole += prefix
        inside = {n.removeprefix(prefix): x for n, x in inside.items() if n.startswith(prefix)}
        yield whole, inside


def _prefix(state: State) -> str | None:
    """Return the prefix of a part of a state that may be a complete model."""
    for prefix in ("model.", "teacher."):
        if any(name.startswith(prefix) for name in state):
            return prefix
    others = [name for name in state if not name.startswith("backbone.")]
    is_training = bool(others) and all(name.startswith(_HEADS) for name in others)
    return "backbone." if is_training else None
