"""Keep the tests' memory maps few, and compile a program once for all workers."""

import gc
import os
import pathlib

import jax
import pytest

_MAPS = pathlib.Path("/proc/self/maps")
_MOST = 30_000
_EVERY = 20
"""Tests between two counts: counting so many takes 30 ms."""
_tests = 0


def pytest_runtest_teardown() -> None:
    """Drop compiled programs: each maps memory, and Linux allows a process 65,530 maps."""
    global _tests
    _tests += 1
    if _tests % _EVERY == 0 and _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session", autouse=True)
def _shared_programs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Share what is compiled with the other workers, and with later tests after a drop.

    A folder that the environment names is used as it is (`scripts/plant_faults.py`).

    Five files in one process take 103 s instead of 117, and 79 s with all programs compiled.
    """
    if jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore
        return
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    jax.config.update("jax_compilation_cache_dir", str(folder / "programs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
