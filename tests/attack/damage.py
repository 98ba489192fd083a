"""Change single bytes of every kind of file, and see that no change passes in silence.

    python -m tests.attack.damage --out rows.json [--scale 1] [--seed 0] [--only KIND ...]

A change is refused if the reader raises one line, told if it loads with a note, and silent
otherwise. Descriptors without their record are told of.
"""

import functools
import pathlib
import random
import shutil
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from crisalad_jax.checkpoints.train_state import StateStore
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.io import read_config
from crisalad_jax.experiments.comparison.results import read_result
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.faiss_index import build, load_index, save_index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.pca import load_pca
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.run_files import RunState
from crisalad_jax.training.step import StepConfig, init_train_state
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.output import Note
from tests.attack.world import PRODUCTS, ROOT, Attack, Bench, Row, carry_out, part_of

PROMISE = "refused with one line, or reported; never silent"


@functools.cache
def _state_like() -> RunState:
    """Return a state of the run's structure."""
    from tests.conftest import MODEL, RECIPE, random_params

    step = StepConfig(MODEL, RECIPE.loss, RECIPE.optimiser, 6, 2, None, None, ())
    params = random_params(MODEL)
    state, _ = init_train_state(params, RECIPE.trainable, step, key=jax.random.key(0))
    return RunState(state, None)


def _read_state(path: pathlib.Path) -> None:
    store = StateStore(path)
    try:
        store.load(_state_like())
    finally:
        store.close()


def _read_export(path: pathlib.Path) -> None:
    sys.path.insert(0, str(ROOT / "scripts"))
    import run_exported

    try:
        manifest = run_exported.read_manifest(path.parent)
        for part in ("program", "weights"):
            run_exported.read_whole(path.parent, manifest[part])
    except (SystemExit, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(str(error)) from error


def _read_map(folder: pathlib.Path) -> None:
    Map.open(folder).close()


Reader = Callable[[pathlib.Path], Any]
KINDS: Mapping[str, tuple[str, Reader]] = {
    "weights": ("run/last.safetensors", load_weights),
    "principal components": ("pca.safetensors", load_pca),
    "descriptors .npy": ("d.npy", read_descriptors),
    "names of descriptors": ("d.names.txt", lambda path: read_descriptors(path.parent / "d.npy")),
    "record of descriptors": ("d.npy.json", lambda path: read_descriptors(path.parent / "d.npy")),
    "descriptors .h5": ("d.h5", read_descriptors),
    "description of a map": ("map/map.json", lambda path: _read_map(path.parent)),
    "record of a map": (
        "map/segments/0000000000.json",
        lambda path: _read_map(path.parents[1]),
    ),
    "descriptors of a map": (
        "map/segments/0000000000.npy",
        lambda path: _read_map(path.parents[1]),
    ),
    "state of training": ("run/state", _read_state),
    "configuration of a run": ("run/config.json", functools.partial(read_config, TrainConfig)),
    "result of a comparison": ("result.json", read_result),
    "exported program": ("program/describe.jax_export", _read_export),
    "manifest of an export": ("program/manifest.json", _read_export),
    "weights of an export": ("program/weights.safetensors", _read_export),
    "index of faiss": ("some.index", load_index),
}
"""A file or folder among the products, and what reads it and what belongs to it."""


def make_files(bench: Bench) -> pathlib.Path:
    """Write files of all kinds, and return their folder."""
    folder = bench.world.root / "products"
    if not folder.exists():  # in forks, before this process reads and uses JAX
        for name in PRODUCTS:
            if name != "comparison":
                bench.world.path(name)
        rows = np.random.default_rng(0).standard_normal((40, 16)).astype(np.float32)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        save_index(folder / "some.index", build("hnsw", rows))
        ranks = {"single": [1, 2, 0, 4, 5] * 8}
        value = {"settings": {}, "training": None, "ranks": {"town": ranks}, "seconds": 1.5}
        write_json(folder / "result.json", value)
    return folder


def outcome(read: Reader, path: pathlib.Path) -> str:
    """Return what a reader does with a file: refused, told, silent or else."""
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", Note)
        try:
            read(path)
        except InputError as error:
            return "refused" if "\n" not in str(error) else "many lines"
        except Exception as error:
            return f"raised {type(error).__name__}"
    return "told" if any(issubclass(note.category, Note) for note in notes) else "silent"


def _files_of(target: pathlib.Path) -> list[pathlib.Path]:
    """List the files that count: of a state, those of the newest."""
    if target.is_file():
        return [target]
    states = [path for path in target.iterdir() if path.name.isdecimal()]
    newest = max(states, key=lambda path: int(path.name))
    # Of orbax's bookkeeping beside the seal only the presence counts.
    return sorted(
        path
        for path in newest.rglob("*")
        if path.is_file() and path.stat().st_size and (path.parent != newest or "sha" in path.name)
    )


def attack(kind: str, bench: Bench, scale: float) -> list[Row]:
    """Change bytes of a kind of file in a copy of all."""
    name, read = KINDS[kind]
    row = Row(f"a changed byte: {kind}", PROMISE)
    generator = random.Random(f"{bench.seed} {kind}")
    copy = bench.folder / kind
    shutil.copytree(make_files(bench), copy)
    before = outcome(read, copy / name)
    assert before == "silent", (kind, before)
    files = _files_of(copy / name)
    for number in range(part_of(300, scale, least=2)):
        path = generator.choice(files)
        data = path.read_bytes()
        # Half of the changes fall into the first kilobyte, where headers are.
        first = len(data) if number % 2 else min(len(data), 1024)
        place = generator.randrange(first)
        value = generator.choice([v for v in range(256) if v != data[place]])
        path.write_bytes(data[:place] + bytes([value]) + data[place + 1 :])
        found = outcome(read, copy / name)
        changed = f"{path.relative_to(copy)}: byte {place} {data[place]} -> {value}"
        row.note(found in ("refused", "told"), f"{changed} (seed {bench.seed}): {found}")
        path.write_bytes(data)
    return [row]


ATTACKS: Mapping[str, Attack] = {kind: functools.partial(attack, kind) for kind in KINDS}

if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
