"""The names in a state without what training tools put around a model's own.

torch.compile, DataParallel, FSDP and activation checkpointing wrap modules, each under a name of
its own; Lightning has the network in a field `model`. The training of facebookresearch/dinov2 and
dinov3 saves its teacher with heads, or next to its student, and its blocks in chunks.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

from crisalad_jax.checkpoints.layouts.base import State

_WRAPPERS = r"(?<![^.])(?:_orig_mod|module|_fsdp_wrapped_module|_checkpoint_wrapped_module)\."
_CHUNKS = r"(?<![^.])(blocks\.)\d+\.(?=\d+\.)"
"""Number of a chunk, before that of the block, which counts on from chunk to chunk."""
_HEADS = ("dino_head.", "ibot_head.")


class Reading(NamedTuple):
    """A way to read a state."""

    state: State
    inside: str = ""
    """Prefix of the names that it has, without that prefix."""
    left_out: tuple[str, ...] = ()
    """Names that it leaves out."""


def readings(state: State) -> Iterator[Reading]:
    """Yield a state as it is, without wrappers' names, and then what is inside it, step by step."""
    reading = Reading(state)
    yield reading
    names = {name: re.sub(_CHUNKS, r"\1", re.sub(_WRAPPERS, "", name)) for name in state}
    if len(set(names.values())) < len(names):
        return  # of two networks: no name may stand for two arrays
    reading = Reading({names[name]: array for name, array in state.items()})
    if reading.state.keys() != state.keys():
        yield reading
    while prefix := _prefix(reading.state):
        inside = {
            n.removeprefix(prefix): x for n, x in reading.state.items() if n.startswith(prefix)
        }
        others = tuple(name for name in reading.state if not name.startswith(prefix))
        reading = Reading(inside, reading.inside + prefix, reading.left_out + others)
        yield reading


def _prefix(state: State) -> str | None:
    """Return the prefix of what may be a model by itself inside a state."""
    for prefix in ("model.", "teacher."):
        if any(name.startswith(prefix) for name in state):
            return prefix
    others = [name for name in state if not name.startswith("backbone.")]
    is_training = bool(others) and all(name.startswith(_HEADS) for name in others)
    return "backbone." if is_training else None
