"""Change single bytes of every kind of file, and see that no change passes in silence.

    python -m tests.attack.damage --out rows.json [--changes 300] [--seed 0]

A change is refused if the reader raises one line, told if it loads with a note, and silent
otherwise. Descriptors without their record are told of.
"""

import argparse
import contextlib
import functools
import pathlib
import random
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.attack.world import ROOT, Row, World, make_products, make_world, write_rows

PROMISE = "refused with one line, or told of; never silent"
Reader = Callable[[pathlib.Path], Any]
"""Reads a set of files in a folder."""


def readers(world: World) -> Mapping[str, tuple[str, Reader]]:
    """Return, for each kind of file, its name, and what reads it."""
    from crisalad_jax.checkpoints.train_state import StateStore
    from crisalad_jax.checkpoints.weights import load_weights
    from crisalad_jax.config.io import read_config
    from crisalad_jax.experiments.comparison.results import read_result
    from crisalad_jax.retrieval.descriptor_files import read_descriptors
    from crisalad_jax.retrieval.faiss_index import load_index
    from crisalad_jax.retrieval.maps.map import Map
    from crisalad_jax.retrieval.pca import load_pca
    from crisalad_jax.training.config import TrainConfig

    def state(folder: pathlib.Path) -> None:
        store = StateStore(folder / "run" / "state")
        try:
            store.load(_state_like(world))
        finally:
            store.close()

    def exported(folder: pathlib.Path) -> None:
        sys.path.insert(0, str(ROOT / "scripts"))
        import run_exported

        try:
            manifest = run_exported.read_manifest(folder / "program")
            for part in ("program", "weights"):
                run_exported.read_whole(folder / "program", manifest[part])
        except (SystemExit, ValueError, LookupError, TypeError, AttributeError) as error:
            raise InputError(str(error)) from error

    def opened(folder: pathlib.Path) -> None:
        with Map.open(folder / "map"):
            pass

    def config(folder: pathlib.Path) -> None:
        read_config(TrainConfig, folder / "run" / "config.json")

    return {
        "weights": ("run/last.safetensors", lambda f: load_weights(f / "run/last.safetensors")),
        "principal components": ("pca.safetensors", lambda f: load_pca(f / "pca.safetensors")),
        "descriptors .npy": ("d.npy", lambda f: read_descriptors(f / "d.npy")),
        "names of descriptors": ("d.names.txt", lambda f: read_descriptors(f / "d.npy")),
        "record of descriptors": ("d.npy.json", lambda f: read_descriptors(f / "d.npy")),
        "descriptors .h5": ("d.h5", lambda f: read_descriptors(f / "d.h5")),
        "description of a map": ("map/map.json", opened),
        "record of a map": ("map/segments/0000000000.json", opened),
        "descriptors of a map": ("map/segments/0000000000.npy", opened),
        "state of training": ("run/state", state),
        "configuration of a run": ("run/config.json", config),
        "result of a comparison": ("result.json", lambda f: read_result(f / "result.json")),
        "exported program": ("program/describe.jax_export", exported),
        "manifest of an export": ("program/manifest.json", exported),
        "weights of an export": ("program/weights.safetensors", exported),
        "index of faiss": ("some.index", lambda f: load_index(f / "some.index")),
    }


@functools.cache
def _state_like(world: World) -> Any:
    """Return a state of the run's structure."""
    import jax

    from crisalad_jax.checkpoints.weights import load_weights
    from crisalad_jax.training.run_files import RunState
    from crisalad_jax.training.step import StepConfig, init_train_state
    from tests.conftest import RECIPE

    params, config = load_weights(world.weights)
    step = StepConfig(config, RECIPE.loss, RECIPE.optimiser, 6, 2, None, None, ())
    state, _ = init_train_state(params, RECIPE.trainable, step, key=jax.random.key(0))
    return RunState(state, None)


def make_rest(folder: pathlib.Path) -> None:
    """Write the kinds of files that the verbs of `make_products` do not."""
    from crisalad_jax.retrieval.faiss_index import build, save_index
    from crisalad_jax.utils.files import write_json

    rows = np.random.default_rng(0).standard_normal((40, 16)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    save_index(folder / "some.index", build("hnsw", rows))
    ranks = {"single": [1, 2, 0, 4, 5] * 8}
    value = {"settings": {}, "training": None, "ranks": {"town": ranks}, "seconds": 1.5}
    write_json(folder / "result.json", value)


def outcome(read: Reader, folder: pathlib.Path) -> str:
    """Return what a reader does with a folder: refused, told or silent; or raise as it does."""
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", Note)
        try:
            read(folder)
        except InputError as error:
            return "refused" if "\n" not in str(error) else "many lines"
    return "told" if any(issubclass(note.category, Note) for note in notes) else "silent"


def attack(world: World, folder: pathlib.Path, changes: int, seed: int) -> list[Row]:
    """Change bytes of each kind of file in a copy of the products."""
    rows = []
    for kind, (name, read) in readers(world).items():
        row = Row(f"a changed byte: {kind}", PROMISE)
        generator = random.Random(f"{seed} {kind}")
        copy = folder / kind.replace(" ", "-")
        shutil.copytree(world.root / "products", copy)
        before = outcome(read, copy)
        assert before == "silent", (kind, before)
        target = copy / name
        files = [path for path in target.rglob("*") if path.is_file()] if target.is_dir() else []
        if files:
            newest = max(int(path.name) for path in target.iterdir() if path.name.isdecimal())
            files = sorted(path for path in files if str(newest) in path.parts)
            # Of orbax's bookkeeping beside the seal only the presence counts.
            files = [
                path
                for path in files
                if path.stat().st_size
                and (path.parent != target / str(newest) or "sha" in path.name)
            ]
        for number in range(changes):
            path = generator.choice(files) if files else target
            data = path.read_bytes()
            # Half of the changes fall into the first kilobyte, where headers are.
            first = len(data) if number % 2 else min(len(data), 1024)
            place = generator.randrange(first)
            value = generator.choice([v for v in range(256) if v != data[place]])
            words = f"{path.relative_to(copy)}: byte {place} {data[place]} -> {value} (seed {seed})"
            path.write_bytes(data[:place] + bytes([value]) + data[place + 1 :])
            try:
                found = outcome(read, copy)
            except Exception as error:
                found = f"raised {type(error).__name__}"
            row.note(found in ("refused", "told"), f"{words}: {found}")
            path.write_bytes(data)
        rows.append(row)
        print(f"{kind}: {row.tries} changes, {len(row.failures)} failures", file=sys.stderr)
    return rows


def main() -> int:
    """Attack, and write the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--changes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        world = make_world(folder / "world")
        make_products(world)
        make_rest(world.root / "products")
        rows = attack(world, folder, given.changes, given.seed)
    write_rows(given.out, rows)
    failures = [line for row in rows for line in row.failures]
    print(*failures[:20], sep="\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
