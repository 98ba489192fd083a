"""The set-up of a notebook, in a process of its own."""

import os
import pathlib
import subprocess
import sys

import pytest

from crisalad_jax.utils.compiler import Session

PROGRAM = """
import crisalad_jax as cj
print(cj.set_up())
import jax
print(jax.device_count(), jax.config.jax_compilation_cache_dir)
"""


def test_a_notebook_has_the_devices_and_the_cache_of_the_command_line(
    tmp_path: pathlib.Path,
) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "JAX_NUM_CPU_DEVICES": "3"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    )
    cache = tmp_path / "crisalad-jax" / "xla"
    assert done.stdout.splitlines() == [
        f"3 cpu devices; compiled programs in {cache}",
        f"3 {cache}",
    ]


@pytest.mark.parametrize(
    ("session", "words"),
    [
        (Session("gpu", 1, None), "1 gpu device; no compile cache"),
        (Session("tpu", 8, "/c"), "8 tpu devices; compiled programs in /c"),
    ],
)
def test_a_session_is_one_line(session: Session, words: str) -> None:
    assert repr(session) == words
