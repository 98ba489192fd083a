"""Compiled programs that outlive their process."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.config import PRESETS
from crisalad_jax.utils import compiler, executable_cache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of kept programs, as a program of its own sets it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(executable_cache._Folder, "path", None)
    executable_cache.cache_executables()
    assert executable_cache._Folder.path == tmp_path / "crisalad-jax" / "programs"
    return executable_cache._Folder.path


def next_process(monkeypatch):
    """Forget the programs of this one."""
    monkeypatch.setattr(executable_cache, "_programs", {})


def counting():
    """Make a compiled function, and the list that each of its traces is added to."""
    traces = []

    def scaled(tree, *, factor, by=None):
        traces.append(factor)
        total = tree["a"] * factor + tree["b"]
        return {"total": total if by is None else total * by}

    scaled.__qualname__ = "scaled"  # as of a module
    return compiler.jit(scaled, static_argnames="factor"), traces


TREE = {"a": np.arange(3.0, dtype=np.float32), "b": np.float32(2)}


def programs(folder):
    return sorted(path for path in folder.iterdir() if not path.suffix)


def test_the_next_process_traces_nothing_and_gives_the_same(folder, monkeypatch):
    function, traces = counting()
    expected = function(TREE, factor=3)
    np.testing.assert_array_equal(expected["total"], [2, 5, 8])
    assert traces == [3]
    assert len(programs(folder)) == 1
    next_process(monkeypatch)
    again, traces_again = counting()
    np.testing.assert_array_equal(again(TREE, factor=3)["total"], expected["total"])
    np.testing.assert_array_equal(again(TREE, factor=3)["total"], expected["total"])
    assert traces_again == []


@pytest.mark.parametrize(
    "call",
    [
        lambda f: f(TREE, factor=4),
        lambda f: f(TREE | {"a": np.arange(4.0, dtype=np.float32)}, factor=3),
        lambda f: f(TREE | {"a": np.arange(3)}, factor=3),
        lambda f: f(TREE, factor=3, by=np.float32(2)),
        lambda f: f({"b": TREE["a"], "a": TREE["b"]}, factor=3),
        lambda f: f(TREE | {"a": jax.device_put(TREE["a"], jax.devices()[0])}, factor=3),
    ],
    ids=["static", "shape", "type", "argument", "places", "committed"],
)
def test_another_call_is_another_program(folder, call):
    function, _ = counting()
    function(TREE, factor=3)
    call(function)
    assert len(programs(folder)) == 2


def test_every_field_of_a_configuration_counts():
    config = PRESETS["tiny"]
    assert "iterations" in executable_cache._whole(config)  # a default, which its repr lacks
    assert executable_cache._whole(config) != executable_cache._whole(PRESETS["s14"])


def test_surroundings_count(monkeypatch):
    def digest():
        return executable_cache._surroundings.__wrapped__()

    def changed(path):
        return "another" if path.name == "layers.py" else real(path)

    found, real = [digest()], executable_cache.sha256_of
    assert digest() == found[0]
    for name in ("JAX_ENABLE_X64", "XLA_FLAGS"):
        monkeypatch.setenv(name, "anything")
        found.append(digest())
    monkeypatch.setattr(executable_cache, "sha256_of", changed)
    found.append(digest())
    assert len(set(found)) == 4


@pytest.mark.parametrize("damage", [lambda data: data[:-1], lambda data: data[:40] + b"?" * 60])
def test_a_damaged_program_is_compiled_anew(folder, monkeypatch, damage):
    function, traces = counting()
    expected = function(TREE, factor=3)
    (path,) = programs(folder)
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    next_process(monkeypatch)
    np.testing.assert_array_equal(function(TREE, factor=3)["total"], expected["total"])
    next_process(monkeypatch)
    function(TREE, factor=3)
    assert len(traces) <= 2  # JAX keeps the trace of one process
    assert path.stat().st_size == len(whole)


def test_what_others_may_write_is_not_run(folder, monkeypatch):
    function, _ = counting()
    function(TREE, factor=3)
    (path,) = programs(folder)
    path.chmod(0o666)
    next_process(monkeypatch)
    again, traces = counting()
    again(TREE, factor=3)
    assert traces == [3]
    folder.chmod(0o777)
    monkeypatch.setattr(executable_cache._Folder, "path", None)
    executable_cache.cache_executables()
    assert executable_cache._Folder.path is None


def test_only_the_latest_are_kept(folder, monkeypatch):
    monkeypatch.setattr(executable_cache, "_MOST", 2)
    function, _ = counting()
    for factor in range(4):
        function(TREE, factor=factor)
        for age, path in enumerate(reversed(programs(folder))):
            os.utime(path, (1000 - age, 1000 - age))
    assert len(programs(folder)) == 2


@pytest.mark.slow  # four commands
def test_the_command_line_keeps_programs_unless_a_plugin_is_loaded(shared, tmp_path):
    """As a process: `crisalad.main` within another one must not."""
    plugin = tmp_path / "plugin.py"
    plugin.write_text("import crisalad_jax\n")
    folder = tmp_path / "cache" / "crisalad-jax" / "programs"

    def extract(*flags):
        images = shared / "town" / "images" / "test" / "queries"
        given = ["--weights", shared / "weights.safetensors", "--images", images, "--quiet"]
        run = [sys.executable, "-m", "crisalad_jax", "extract", *given]
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
        out = tmp_path / "out.npy"
        run += ["--out", out, *flags]
        subprocess.run(run, env=environment, check=True, capture_output=True)
        return out.read_bytes()

    expected = extract("--plugin", plugin)
    assert not folder.exists()
    for _ in range(2):
        assert extract() == expected
        assert len(programs(folder)) == 2  # tokens, and descriptors from them


def some(first, unused, last, *, config):
    return first * config - last


def test_many_arguments_keep_their_places(folder, monkeypatch):
    """A program takes no argument that it does not use, and the others in their order."""
    function = compiler.jit(some, static_argnames=("config",))
    given = (jnp.ones(2), jnp.zeros(5), np.full(2, 4, np.float32))
    for _ in range(2):
        np.testing.assert_array_equal(function(*given, config=3), [-1, -1])
        next_process(monkeypatch)
    assert len(programs(folder)) == 1


def test_what_a_function_has_from_another_is_not_part_of_the_key(folder):
    """So none of their programs is cached: that of one factor would answer for the other."""
    for factor in (2, 3):
        assert compiler.jit(lambda x, factor=factor: x * factor)(jnp.ones(())) == factor
    assert programs(folder) == []
