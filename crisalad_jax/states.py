"""The states that a run resumes from (orbax)."""

import contextlib
import json
import os
import pathlib
import shutil
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree

from crisalad_jax.errors import InputError
from crisalad_jax.files import sha256_of, write_json
from crisalad_jax.pytree import named_leaves

_DROPPED = "dropped"
_SEAL = "sha256.json"


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
        folder = pathlib.Path(folder).absolute()
        self._folder, self._dropped = folder, folder / _DROPPED
        # Of several processes one alone has a store; orbax would wait for the others.
        alone = ocp.options.MultiprocessingOptions(
            primary_host=jax.process_index(), active_processes={jax.process_index()}
        )
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep,
            create=False,
            todelete_subdir=_DROPPED,
            enable_async_checkpointing=True,
            async_options=ocp.AsyncOptions(post_finalization_callback=self._seal),
            cleanup_tmp_directories=True,
            multiprocessing_options=alone,
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._manager = ocp.CheckpointManager(
                folder,
                options=options,
                item_handlers={
                    "state": ocp.StandardCheckpointHandler(multiprocessing_options=alone),
                    "record": ocp.JsonCheckpointHandler(multiprocessing_options=alone),
                },
            )
        except OSError as error:
            raise InputError(f"{folder}: cannot keep states here: {error.strerror}") from error
        self._clear()

    def save(self, step: int, state: PyTree, record: dict[str, Any]) -> None:
        """Write the arrays of `state` and the JSON values of `record`, in place of that step's.

        Copies are made before it returns, what is written is written while other work goes on.

        Raises:
            InputError: this one, or one before, cannot be written.
        """
        with self._written():
            self._manager.wait_until_finished()
            self._clear()
            if step in self._manager.all_steps():
                self._manager.delete(step)
            # Copies: the next step takes over the buffers of this one's state.
            arrays = ocp.args.StandardSave(jax.tree.map(np.array, _stored(state)))
            self._manager.save(
                step, args=ocp.args.Composite(state=arrays, record=ocp.args.JsonSave(record))
            )

    def load(self, template: PyTree) -> Saved | None:
        """The last state, in the structure of `template`; None if there is none.

        Raises:
            InputError: the stored arrays are damaged or do not fit the template.
        """
        self.wait()
        step = self._manager.latest_step()
        if step is None:
            return None
        wanted = jax.tree.map(ocp.utils.to_shape_dtype_struct, _stored(template))
        try:
            # Before any array is read: orbax reads all at once, and whatever does not fit is an
            # exception in a thread of its own.
            self._check_seal(step)
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
            reason = " ".join(str(error).partition("See full TensorStore")[0].split())[:200]
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
        state = jax.tree.unflatten(jax.tree.structure(template), leaves)
        return Saved(step, state, saved["record"])

    def _seal(self) -> None:
        """List the files of the state that is being written, before orbax gives it its name."""
        for folder in self._folder.glob("*.orbax-checkpoint-tmp*"):  # one
            write_json(folder / _SEAL, _hashes(folder))

    def _check_seal(self, step: int) -> None:
        folder = self._folder / str(step)
        sealed, found = json.loads((folder / _SEAL).read_text()), _hashes(folder)
        for name, sha256 in sealed.items():
            if found.get(name) != sha256:
                what = "other bytes than were saved" if name in found else "no file"
                raise ValueError(f"{name}: found {what}")

    def wait(self) -> None:
        """Return when all that was saved is on the disk; raises as `save`."""
        with self._written():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Wait for what is being written; raises as `save`."""
        with self._written():
            self._manager.close()
        self._clear()

    @contextlib.contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # the latter from tensorstore
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"{self._folder}: cannot write this state: {reason}") from error

    def _clear(self) -> None:
        # What is dropped is renamed first: a kill while it is removed leaves no half of a state.
        shutil.rmtree(self._dropped, ignore_errors=True)


def _hashes(folder: pathlib.Path) -> dict[str, str]:
    """SHA-256 of all files of a state's arrays and record."""
    files = (path for path in folder.glob("*/**/*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in files}


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
