"""Keep the tests' memory maps few."""

import gc
import pathlib

import jax

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
