"""The light core starts light: what a fresh interpreter loads (import contracts: pyproject)."""

import pathlib
import subprocess
import sys

PACKAGE = "crisalad_jax"
ROOT = pathlib.Path(__file__).parents[1]


def loaded_after(statement: str, candidates: set[str]) -> set[str]:
    """Which of the top-level modules a fresh interpreter has loaded after a statement."""
    program = f"import sys\n{statement}\nprint(*sorted({candidates!r} & sys.modules.keys()))"
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=ROOT
    )
    return set(done.stdout.split())


HEAVY = {
    *("cv2", "faiss", "h5py", "matplotlib", "numba", "optax", "orbax", "rich", "safetensors"),
    "tyro",
}


def test_a_model_needs_no_file_formats():
    statement = f"import {PACKAGE}; {PACKAGE}.describe, {PACKAGE}.sinkhorn, {PACKAGE}.metric_loss"
    assert loaded_after(statement, HEAVY | {"torch", "jax"}) == {"jax"}


def test_a_recipe_needs_no_files_but_what_augments():
    assert loaded_after(f"import {PACKAGE}; {PACKAGE}.recipe('tiny')", HEAVY) == {"cv2"}


def test_what_describes_starts_without_what_trains():
    loaded = loaded_after(f"import {PACKAGE}.cli.extract", HEAVY)
    assert {"rich", "cv2", "safetensors"} <= loaded
    assert not loaded & {"optax", "matplotlib", "faiss", "h5py"}


def test_the_command_line_starts_with_nothing():
    assert loaded_after(f"import {PACKAGE}.cli", HEAVY | {"jax"}) == set()


def test_pictures_need_no_jax():
    statement = f"import {PACKAGE}.data.images, {PACKAGE}.data.places, {PACKAGE}.data.benchmarks"
    assert loaded_after(statement, {"jax", "torch", "cv2", "scipy"}) == {"cv2"}


def test_a_map_is_asked_without_jax():
    """What describes by another runtime starts in a fraction of the time that JAX takes."""
    statement = f"import {PACKAGE}.cli.query, {PACKAGE}.cli; {PACKAGE}.Map, {PACKAGE}.query"
    assert loaded_after(statement, {"jax", "scipy", "faiss", "numba"}) == set()
