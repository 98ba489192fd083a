"""Files of weights (safetensors, configuration inside) and the state that a run resumes from."""

import dataclasses
import functools
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import safetensors
import safetensors.numpy
from jaxtyping import PyTree

from crisalad_jax.config import ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.files import atomic_path, check_source
from crisalad_jax.model import Crisalad, init_crisalad
from crisalad_jax.pytree import named_leaves
from crisalad_jax.serial import differences, from_plain, to_plain

FORMAT = "crisalad-jax 1"
"""The one key of a weight file's metadata; its value is the configuration as JSON."""
EXTRA = "extra."
"""What names of arrays begin with that are kept for the way back to a public checkpoint alone."""


def save_weights(
    path: str | os.PathLike[str],
    params: Crisalad,
    config: ModelConfig,
    *,
    extras: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write parameters under their dotted names, and the configuration in the file's metadata.

    `extras` are arrays of a public checkpoint that no description needs (see `convert`).

    Raises:
        InputError: the folder cannot be made.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(params).items()}
    arrays |= {EXTRA + name: array for name, array in (extras or {}).items()}
    metadata = {FORMAT: json.dumps(to_plain(config))}
    with atomic_path(path) as temporary:
        safetensors.numpy.save_file(arrays, temporary, metadata=metadata)
        # The library makes files that only their owner can read.
        temporary.chmod(0o644)


def is_ours(path: str | os.PathLike[str]) -> bool:
    """Whether this is a whole safetensors file that `save_weights` wrote."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return FORMAT in (file.metadata() or {})
    except (safetensors.SafetensorError, OSError):
        return False


def load_extras(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The `extras` that `save_weights` wrote."""
    with safetensors.safe_open(path, framework="numpy") as file:
        names = [name for name in file.keys() if name.startswith(EXTRA)]  # noqa: SIM118
        return {name.removeprefix(EXTRA): file.get_tensor(name) for name in names}


def load_weights(
    path: str | os.PathLike[str], expected: ModelConfig | None = None
) -> tuple[Crisalad, ModelConfig]:
    """Read what `save_weights` wrote: (params, config).

    Args:
        path: the file.
        expected: if given, the configuration that the file must have, except for what parameters
            do not depend on: image size, dropout, compute type.

    Raises:
        InputError: the file is missing, cut short or no such file; its parameters do not fit its
            configuration or are not finite (all that are missing, unknown or wrong are listed); or
            its configuration is not `expected` (all fields that differ are listed).
    """
    path = pathlib.Path(path)
    check_source(path, "a .safetensors file of weights")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if FORMAT not in metadata:
                raise InputError(
                    f"{path}: found metadata {sorted(metadata)}, expected {FORMAT!r}, as this "
                    "package writes it; `crisalad convert` reads public checkpoints"
                )
            names = [name for name in file.keys() if not name.startswith(EXTRA)]  # noqa: SIM118
            found = {name: file.get_tensor(name) for name in names}
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a whole safetensors file: {error}; `crisalad convert` reads torch files"
        ) from error
    try:
        plain = json.loads(metadata[FORMAT])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: found no configuration in its metadata: {error}") from error
    config = from_plain(ModelConfig, plain, source=f"{path} (metadata)")
    if expected is not None:
        wrong = differences(_with_free_fields_of(expected, config), expected)
        if wrong:
            raise InputError(f"{path}: these weights are of another model: {'; '.join(wrong)}")
    return _fill(config, found, path), config


def _with_free_fields_of(other: ModelConfig, config: ModelConfig) -> ModelConfig:
    return dataclasses.replace(
        config,
        image_size=other.image_size,
        compute_dtype=other.compute_dtype,
        salad=dataclasses.replace(config.salad, dropout=other.salad.dropout),
        encoder=dataclasses.replace(config.encoder, dropout=other.encoder.dropout),
    )


def _fill(config: ModelConfig, found: dict[str, np.ndarray], path: pathlib.Path) -> Crisalad:
    # Said before a template is made of sizes that any text may claim; small ones are listed below.
    largest = max(n for n in jax.tree.leaves(to_plain(config)) if type(n) is int)
    if largest > max(2**20, sum(array.size for array in found.values())) or (
        config.encoder.layers > max(64, len(found))
    ):
        raise InputError(
            f"{path}: found {len(found)} arrays, far from the sizes that its configuration says, "
            f"of up to {largest}"
        )
    template = jax.eval_shape(functools.partial(init_crisalad, config=config), jax.random.key(0))
    wanted = named_leaves(template)
    problems = [f"{name} missing" for name in wanted.keys() - found.keys()]
    problems += [f"{name} unknown" for name in found.keys() - wanted.keys()]
    for name, leaf in wanted.items():
        if name not in found:
            continue
        array = found[name]
        if (array.dtype, array.shape) != (leaf.dtype, leaf.shape):
            problems.append(
                f"{name} found {array.dtype} {array.shape}, expected {leaf.dtype} {leaf.shape}"
            )
        elif not np.isfinite(array).all():
            problems.append(f"{name} holds NaN or infinity")
    if problems:
        raise InputError(f"{path}: weights do not fit: {'; '.join(sorted(problems))}")
    leaves = [jnp.asarray(found[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


class Saved(NamedTuple):
    """One restored state of a run."""

    step: int
    state: PyTree
    record: dict[str, Any]


class StateStore:
    """The resumable states of a run (orbax): each step is written whole or not at all."""

    def __init__(self, folder: str | os.PathLike[str], *, keep: int = 2) -> None:
        """Open or make the folder; the last `keep` states stay.

        Raises:
            InputError: the folder cannot be made or read.
        """
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep, enable_async_checkpointing=False, cleanup_tmp_directories=True
        )
        try:
            self._manager = ocp.CheckpointManager(
                pathlib.Path(folder).absolute(),
                options=options,
                item_handlers={
                    "state": ocp.StandardCheckpointHandler(),
                    "record": ocp.JsonCheckpointHandler(),
                },
            )
        except OSError as error:
            raise InputError(f"{folder}: cannot keep states here: {error.strerror}") from error

    def save(self, step: int, state: PyTree, record: dict[str, Any]) -> None:
        """Write the arrays of `state` and the JSON values of `record`; an existing step stays."""
        if step in self._manager.all_steps():
            return
        arrays = ocp.args.StandardSave(_stored(state))
        self._manager.save(
            step, args=ocp.args.Composite(state=arrays, record=ocp.args.JsonSave(record))
        )

    def load(self, template: PyTree) -> Saved | None:
        """The last state, in the structure of `template`; None if there is none.

        Raises:
            InputError: the stored arrays are damaged or do not fit the template.
        """
        step = self._manager.latest_step()
        if step is None:
            return None
        wanted = jax.tree.map(ocp.utils.to_shape_dtype_struct, _stored(template))
        try:
            # Before any array is read: orbax reads all at once, and every misfit is an exception
            # in a thread of its own.
            found = self._manager.item_metadata(step)["state"].tree
            misfits = _misfits(wanted, found)
            if misfits:
                raise ValueError(misfits)
            saved = self._manager.restore(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardRestore(wanted), record=ocp.args.JsonRestore()
                ),
            )
        except Exception as error:  # whatever a damaged file makes orbax and its threads raise
            reason = " ".join(str(error).split())[:200]
            older = [other for other in self._manager.all_steps() if other != step]
            advice = f"; delete it to go on from step {max(older)}" if older else ""
            raise InputError(
                f"{self._manager.directory / str(step)}: this state is damaged or not of this run"
                f"{advice} ({reason})"
            ) from error
        # Through numpy, for arrays that orbax has bound to a device would compile the step anew.
        leaves = [
            jnp.asarray(np.asarray(saved["state"].get(name, leaf)))
            for name, leaf in named_leaves(template).items()
        ]
        return Saved(
            step, jax.tree.unflatten(jax.tree.structure(template), leaves), saved["record"]
        )

    def close(self) -> None:
        """Wait for what is being written."""
        self._manager.close()


def _stored(state: PyTree) -> dict[str, Any]:
    """Leaves by name, without the empty ones (absent registers), which orbax refuses."""
    return {name: leaf for name, leaf in named_leaves(state).items() if leaf.size}


def _misfits(wanted: dict[str, jax.ShapeDtypeStruct], found: dict[str, Any]) -> str:
    """What keeps the stored arrays from being the wanted ones; empty if nothing does."""
    differing = sorted(
        name
        for name in wanted.keys() | found.keys()
        if name not in wanted or name not in found or wanted[name].shape != found[name].shape
    )
    if not differing:
        return ""
    first = differing[0]
    shapes = [tree[first].shape if first in tree else "none" for tree in (found, wanted)]
    return f"{len(differing)} arrays differ, as {first}: found {shapes[0]}, expected {shapes[1]}"
