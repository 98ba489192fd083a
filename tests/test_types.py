"""Type checkers know the types of the public names."""

import pathlib
import subprocess
import sys

import crisalad_jax as cj


def test_the_typed_examples_are_right():
    """No result is Any, and each wrong call has an `ignore` that must be needed."""
    examples = pathlib.Path(__file__).with_name("typed_examples.py")
    command = [sys.executable, "-m", "pyright", str(examples)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_checkers_read_the_types():
    assert pathlib.Path(cj.__file__).with_name("py.typed").exists()
