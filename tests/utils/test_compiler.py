"""Compiler options, virtual devices, the compile cache: what is asked of JAX, and what it does."""

import dataclasses
import os
import pathlib
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.config import PRESETS
from crisalad_jax.utils import compiler
from crisalad_jax.utils.target import CPU, GPU, PORTABLE, TPU, Target, lowering_for


def in_a_program(source: str, home: pathlib.Path, *arguments: str, **environment: str) -> str:
    """What a fresh Python prints: devices are counted once, when JAX starts."""
    inherited = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("JAX_", "XLA_", "XDG_"))
    }
    done = subprocess.run(
        [sys.executable, "-c", source, *arguments],
        env={**inherited, "HOME": str(home), "JAX_PLATFORMS": "cpu", **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


START = """
import sys, jax
jax.__version__, jax.__version_info__ = sys.argv[1], tuple(map(int, sys.argv[1].split(".")))
from crisalad_jax.cli import main
sys.stderr = sys.stdout
main(["info", "--preset", "tiny", "--json", "-"])
"""


@pytest.mark.parametrize(
    ("version", "warned"), [pytest.param("0.10.2", 0, marks=pytest.mark.slow), ("0.11.2", 1)]
)
def test_an_untested_jax_is_said_in_one_line(
    tmp_path: pathlib.Path, version: str, warned: int
) -> None:
    printed = in_a_program(START, tmp_path, version).splitlines()
    lines = [line for line in printed if "jax" in line]
    assert len(lines) == warned
    for line in lines:
        assert line.startswith(f"crisalad: note: found jax {version}, tested with 0.10 and 0.12: ")


@pytest.mark.parametrize("chosen", [CPU, GPU, TPU, PORTABLE], ids=lambda chosen: chosen.platform)
@pytest.mark.parametrize("version", [(0, 10, 2), (0, 11, 2), (0, 12, 0, 1), (0, 13, 0)])
@pytest.mark.parametrize("runs_long", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16", None])
@pytest.mark.parametrize("flags", [("avx2",), ("avx2", "amx_tile")], ids="+".join)
def test_only_a_cpu_with_a_tested_jax_has_options(
    monkeypatch: pytest.MonkeyPatch,
    chosen: Target,
    version: tuple[int, ...],
    runs_long: bool,
    dtype: str | None,
    flags: tuple[str, ...],
) -> None:
    monkeypatch.setattr(jax, "__version_info__", version)
    monkeypatch.setattr(compiler, "processor_flags", lambda: frozenset(flags))
    with lowering_for(chosen):
        options = compiler.compiler_options(runs_long=runs_long, compute_dtype=dtype)
    here = chosen == CPU and version[1] in (10, 12)
    assert ("xla_cpu_scheduler_type" in options) == (here and not runs_long)
    by_eigen = here and dtype == "float32" and "amx_tile" in flags
    assert ("xla_cpu_experimental_ynn_fusion_type" in options) == by_eigen
    assert len(options) <= 2


def test_the_options_are_those_of_the_configuration_s_type(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def options(**given: Any) -> dict[str, Any]:
        asked.append(given["compute_dtype"])
        return {}

    monkeypatch.setattr(compiler, "compiler_options", options)
    function = compiler.jit(lambda x, config=None: x + 1, static_argnames="config")
    tiny = PRESETS["tiny"]
    for config in (None, tiny, dataclasses.replace(tiny, compute_dtype="bfloat16")):
        function(jnp.ones(3), config=config)
    assert asked == [None, "float32", "bfloat16"]


def test_the_options_reach_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that it does not know stops it."""
    monkeypatch.setattr(compiler, "compiler_options", lambda *_, **__: {"xla_no_such_option": True})
    function = compiler.jit(lambda x: x + 1)
    for compiled in (function, lambda x: function.lower(x).compile()):
        with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
            compiled(jnp.ones(3))


WAYS: dict[str, Callable[[Any], Any]] = {
    "by itself": lambda f: f(jnp.arange(3.0), "by", power=3),
    "in jit": lambda f: jax.jit(lambda x: f(x, "by", power=3))(jnp.arange(3.0)),
    "in jit, of constants": lambda f: jax.jit(lambda: f(jnp.arange(3.0), "by", power=3))(),
    "in vmap": lambda f: jax.vmap(lambda x: f(x, "by", power=3))(jnp.arange(3.0)),
    "in a gradient": lambda f: jax.grad(lambda x: f(x, "by", power=4).sum() / 4)(jnp.arange(3.0)),
    "in grad, of constants": lambda f: (
        jax.grad(lambda x: x * f(jnp.arange(3.0), "by", power=3)[2])(1.0) * jnp.array([0, 1 / 8, 1])
    ),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_compiled_function_may_be_used_anywhere(way: str) -> None:
    function = compiler.jit(lambda x, how, power: x**power, static_argnames=("how", "power"))
    # Whole numbers below 10: nothing to round but the logarithm of XLA's power.
    np.testing.assert_allclose(WAYS[way](function), [0, 1, 8], rtol=1e-6)


def test_arguments_can_be_donated() -> None:
    function = compiler.jit(lambda x: x + 1, donate_argnums=0)
    given = jnp.ones(1000)
    np.testing.assert_array_equal(function(given), np.full(1000, 2.0))
    assert given.is_deleted()


SPREAD = """
import sys, jax, jax.numpy as jnp, numpy as np
from crisalad_jax.utils import compiler
compiler.configure()
from crisalad_jax.utils.devices import devices_for
from tests.conftest import MODEL, random_params
from crisalad_jax.nn.model import extract_tokens
count = len(jax.local_devices())
params = random_params(MODEL)
images = np.random.default_rng(0).integers(0, 256, (6, *MODEL.image_size, 3), dtype=np.uint8)
expected = extract_tokens(params, jnp.asarray(images), MODEL)
devices = devices_for(6)
spread, everywhere = devices.shard_batch(images), devices.replicate(params)
found = extract_tokens(everywhere, spread, MODEL)
# Unit vectors of 8 numbers, rounded at 1e-7 some hundred times on the way.
for ours, theirs in zip(found[:2], expected[:2]):
    np.testing.assert_allclose(np.asarray(ours), theirs, atol=1e-5)
leaf = everywhere.backbone.blocks.attn.qkv.weight
places = {shard.data.unsafe_buffer_pointer() for shard in leaf.addressable_shards}
print(count, len(spread.sharding.device_set), len(found.local.sharding.device_set), len(places))
"""


@pytest.mark.slow  # the next one spreads images too
def test_images_are_spread_and_parameters_shared(tmp_path: pathlib.Path) -> None:
    """Six images, on as many devices as have the same number of them; one copy of a parameter."""
    told = {"JAX_NUM_CPU_DEVICES": "4", "PYTHONPATH": os.getcwd()}
    assert in_a_program(SPREAD, tmp_path, **told) == "4 3 3 1\n"


IN_PARTS = """
import numpy as np
from crisalad_jax.nn.backbones import stages
from crisalad_jax.utils.devices import devices_for, parts_for_caches
from tests.nn.backbones.test_cnn import SMALL, random_params
from crisalad_jax.nn.model import describe
print(*(parts_for_caches(*each) for each in ((6, 1), (6, 2), (8, 3), (7, 9), (5, 0))))
stages._PIXELS = 1
images = np.zeros((6, *SMALL.image_size, 3), np.float32)
devices = devices_for(6)
params, spread = devices.replicate(random_params(SMALL)), devices.shard_batch(images)
text = describe.lower(params, spread, SMALL).compile().as_text()
print(" while(" in text, any(f" {name}" in text for name in ("all-", "collective-")))
"""


def test_devices_compute_parts_of_their_own_images(tmp_path: pathlib.Path) -> None:
    """Of four devices six images are on three: each computes two, one by one, and sends none."""
    told = {"JAX_NUM_CPU_DEVICES": "4", "PYTHONPATH": os.getcwd()}
    assert in_a_program(IN_PARTS, tmp_path, **told) == "2 1 1 1 5\nTrue False\n"


SET_UP = """
import os, jax
if os.environ.get("FEWER"):
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
import crisalad_jax as cj
from crisalad_jax.utils import compiler
session = cj.set_up()
assert session.devices == len(jax.devices())
print(session.devices, len(os.sched_getaffinity(0)), session.cache)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
def squared(x):
    return x @ x
compiler.jit(squared)(jax.numpy.ones((64, 64))).block_until_ready()
"""
HAS_CORES = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no cores are told")


@HAS_CORES
@pytest.mark.parametrize("fewer", ["", "yes"], ids=("all cores", "one core"))
def test_a_device_a_core_and_programs_are_kept(tmp_path: pathlib.Path, fewer: str) -> None:
    cache = tmp_path / ".cache" / "crisalad-jax" / "xla"
    devices, cores, place = in_a_program(SET_UP, tmp_path, FEWER=fewer).split()
    assert devices == cores
    assert not fewer or cores == "1"
    assert place == str(cache)
    assert list(cache.glob("jit_squared-*"))


@HAS_CORES
def test_without_a_place_for_them_programs_are_not_kept(tmp_path: pathlib.Path) -> None:
    nowhere = tmp_path / "file"
    nowhere.write_text("")
    assert in_a_program(SET_UP, tmp_path, XDG_CACHE_HOME=str(nowhere)).split()[2] == "None"


@HAS_CORES
@pytest.mark.parametrize(
    "told",
    [
        {"JAX_NUM_CPU_DEVICES": "3"},
        {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"},
    ],
)
def test_the_environment_is_heeded(told: dict[str, str], tmp_path: pathlib.Path) -> None:
    kept, elsewhere = str(tmp_path / "kept"), tmp_path / "elsewhere"
    folders = {"JAX_COMPILATION_CACHE_DIR": kept, "XDG_CACHE_HOME": str(elsewhere)}
    devices, _, place = in_a_program(SET_UP, tmp_path, **told, **folders).split()
    assert (devices, place) == ("3", kept)
    assert not elsewhere.exists()


def test_a_session_is_one_line() -> None:
    session = compiler.Session("tpu", 8, "/c")
    assert repr(session) == "8 tpu devices; compiled programs in /c"
