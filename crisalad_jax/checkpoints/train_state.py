"""Save and load the states from which a training run resumes.

orbax writes the states. In a test that flipped 40 single bits in a stored state, orbax and
tensorstore detected none, and 39 changed the loaded values. The SHA-256 of every file is therefore
stored too.
"""

import contextlib
import logging
import os
import pathlib
import re
import shutil
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree

from crisalad_jax.nn.diff_trees import diff_trees
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.pytree import named_leaves

_DROPPED = "dropped"
_SEAL = "sha256.json"
# Drop orbax's error logs, a page for each of its threads: it raises the same errors.
logging.getLogger("absl").addFilter(lambda record: f"{os.sep}orbax{os.sep}" not in record.pathname)
_show_unraisable = sys.unraisablehook


def _show_but_late(unraisable: Any) -> None:
    """Show an unraisable error, unless it comes from results that arrive after the first error.

    tensorstore then still reports its other files to orbax's event loop, which the error has ended.
    """
    if not isinstance(unraisable.exc_value, RuntimeError) or (
        str(unraisable.exc_value) != "Event loop is closed"
    ):
        _show_unraisable(unraisable)


sys.unraisablehook = _show_but_late


class SavedState(NamedTuple):
    """A restored state of a run: its training step, its arrays, and the JSON record with them."""

    step: int
    state: Any
    record: dict[str, Any]


class StateStore:
    """A folder of the states from which a run can resume; orbax writes each one atomically."""

    def __init__(self, folder: str | os.PathLike[str], *, keep: int = 2) -> None:
        """Open or create the folder, in which only the last `keep` states are stored."""
        folder = pathlib.Path(folder).absolute()
        self._folder, self._dropped = folder, folder / _DROPPED
        # Only the primary process has a store: without this orbax would wait for the others.
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
        folder.mkdir(parents=True, exist_ok=True)
        self._manager = ocp.CheckpointManager(
            folder,
            options=options,
            item_handlers={
                "state": ocp.StandardCheckpointHandler(multiprocessing_options=alone),
                "record": ocp.JsonCheckpointHandler(multiprocessing_options=alone),
            },
        )
        self._clear()

    def save(self, step: int, state: PyTree, record: dict[str, Any]) -> None:
        """Write the arrays of `state` and the JSON values of `record` as the state of `step`.

        Any stored state of that step is replaced. Arrays are copied, and written in the background.

        Raises:
            InputError: this state, or an earlier one, cannot be written.
        """
        with self._written():
            self._manager.wait_until_finished()
            self._clear()
            if step in self._manager.all_steps():
                self._manager.delete(step)
            # Copy, because the next training step donates the buffers of this state.
            arrays = ocp.args.StandardSave(jax.tree.map(np.array, _stored(state)))
            self._manager.save(
                step, args=ocp.args.Composite(state=arrays, record=ocp.args.JsonSave(record))
            )

    def load(self, template: PyTree) -> SavedState | None:
        """Restore the last saved state.

        Args:
            template: a state of the same structure, shapes and types.

        Returns:
            The state; None if none was saved.

        Raises:
            InputError: the stored arrays are damaged or do not fit the template.
        """
        self.wait()
        step = self._manager.latest_step()
        if step is None:
            return None
        arrays = jax.tree.map(ocp.utils.to_shape_dtype_struct, _stored(template))
        try:
            # Check before orbax reads any array: it reads all at once, and raises in another thread
            # if one does not fit.
            problems = self._changed_files(step) or diff_trees(
                self._manager.item_metadata(step)["state"].tree, arrays
            )
        except (OSError, ValueError) as error:
            problems = [str(error)]
        if problems:
            older = [other for other in self._manager.all_steps() if other != step]
            advice = f"; delete it to resume from step {max(older)}" if older else ""
            raise InputError(
                f"{self._folder / str(step)}: this state is damaged or not of this run{advice} "
                f"({few(problems)})"
            )
        saved = self._manager.restore(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardRestore(arrays), record=ocp.args.JsonRestore()
            ),
        )
        # Convert with numpy: arrays that orbax commits to a device would recompile the step.
        leaves = [
            jnp.asarray(np.asarray(saved["state"].get(name, leaf)))
            for name, leaf in named_leaves(template).items()
        ]
        state = jax.tree.unflatten(jax.tree.structure(template), leaves)
        return SavedState(step, state, saved["record"])

    def _seal(self) -> None:
        """Write the digests of a state's files, before orbax renames it to its final name."""
        (temporary,) = ocp.utils.tmp_checkpoints(self._folder)
        folder = pathlib.Path(temporary.get())
        write_json(folder / _SEAL, _hashes(folder))

    def _changed_files(self, step: int) -> list[str]:
        """List the files of a state that have changed since they were saved."""
        folder = self._folder / str(step)
        found, saved = _hashes(folder), read_json(folder / _SEAL, "the digests of a state's files")
        return [
            f"{name}: found {'other bytes than were saved' if name in found else 'no file'}"
            for name in sorted(found.keys() | saved.keys())
            if found.get(name) != saved.get(name)
        ]

    def wait(self) -> None:
        """Wait until all states are on disk; raise InputError if one cannot be written."""
        with self._written():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Wait until all states are on disk (InputError if one fails), and close the store."""
        with self._written():
            self._manager.close()
        self._clear()

    @contextlib.contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # ValueError comes from tensorstore
            raise InputError(f"{self._folder}: cannot write this state: {_words(error)}") from error

    def _clear(self) -> None:
        # Dropped states are renamed before removal, so that a kill leaves no partial state.
        shutil.rmtree(self._dropped, ignore_errors=True)


def _words(error: Exception) -> str:
    """Return the system's error message; tensorstore puts its number after long names."""
    number = re.search(r"os_error_code='(\d+)'", str(error))
    return os.strerror(int(number[1])) if number else " ".join(str(error).split())[:200]


def _hashes(folder: pathlib.Path) -> dict[str, str]:
    """Compute the SHA-256 of all files of a state's arrays and record.

    Files at the top level are orbax's bookkeeping: it changes them later, and no loaded value
    depends on them.
    """
    files = (path for path in folder.glob("*/**/*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in files}


def _stored(state: PyTree) -> dict[str, Any]:
    """Return the leaves by name, without empty ones, which orbax rejects."""
    return {name: leaf for name, leaf in named_leaves(state).items() if leaf.size}
