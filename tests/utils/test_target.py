"""The platform that a program is traced for: who is asked, and that traces do not mix."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import AbstractMesh, NamedSharding, PartitionSpec

from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import describe, parameter_shapes
from crisalad_jax.utils import compiler
from crisalad_jax.utils import target as targets
from crisalad_jax.utils.devices import parts_for_caches
from crisalad_jax.utils.target import CPU, GPU, PORTABLE, TPU, Target, lowering_for, target

HALF = dataclasses.replace(PRESETS["tiny"], compute_dtype="bfloat16")
"""50 tokens, an even number; gradients of an odd one are tested with attention."""
CUDNN, PALLAS = "__cudnn$fmha", "tpu_custom_call"


def test_without_being_told_the_target_is_this_machine() -> None:
    assert target() == targets.machine()
    with lowering_for(TPU):
        with lowering_for(CPU):
            assert target() == CPU
        assert target() == TPU
    assert target() == targets.machine()


@pytest.mark.parametrize(
    ("backend", "compiles", "expected"),
    [
        ("cpu", True, CPU),
        ("gpu", True, GPU),
        ("gpu", False, Target("gpu", cudnn=False)),
        ("tpu", True, TPU),
        ("another", True, PORTABLE),
    ],
)
def test_a_machine_is_told_by_its_backend_and_what_compiles(
    monkeypatch: pytest.MonkeyPatch, backend: str, compiles: bool, expected: Target
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(targets, "_compiles_cudnn", lambda: compiles)
    assert targets.machine.__wrapped__() == expected


@pytest.mark.parametrize(
    ("chosen", "dtype", "expected"),
    [
        (CPU, "bfloat16", "float32"),
        (PORTABLE, "bfloat16", "float32"),
        (GPU, "bfloat16", "bfloat16"),
        (GPU, "float32", "float32"),
        (CPU, "float64", "float64"),
    ],
)
def test_products_have_the_platforms_fastest_type(
    chosen: Target, dtype: str, expected: str
) -> None:
    assert chosen.product_dtype(dtype) == jnp.dtype(expected)


def test_other_platforms_compute_a_batch_whole() -> None:
    """A prime number of images, above that of devices, so that one device has them all."""
    with lowering_for(CPU):
        assert parts_for_caches(17, 1) == 17
    with lowering_for(TPU):
        assert parts_for_caches(17, 1) == 1


def test_a_function_is_traced_again_for_another_target() -> None:
    """Inside and outside of another trace, in which JAX keeps the inner function's by itself."""
    traced = []

    @compiler.jit
    def choose(x: jax.Array) -> jax.Array:
        traced.append(target().platform)
        return x

    outer = jax.jit(lambda x: choose(x))
    x = jnp.ones(3)
    for chosen in (GPU, TPU, CPU, GPU, TPU, CPU):
        before = len(traced)
        seen = chosen.platform in traced
        with lowering_for(chosen):
            jax.make_jaxpr(lambda x: choose(x))(x)
            outer.trace(x)
            choose.lower(x)  # pyright: ignore[reportFunctionMemberAccess]
        # The second time all of its traces are found.
        assert set(traced[before:]) == (set() if seen else {chosen.platform})


def text(chosen: Target, config: ModelConfig, *, gradient: bool) -> str:
    """The lowered program of a description, or of the gradient of one number of it."""
    params = parameter_shapes(config)
    images = jax.ShapeDtypeStruct((2, *config.image_size, 3), jnp.uint8)

    @compiler.jit
    def program(params: object, images: jax.Array) -> object:
        def first(params: object) -> jax.Array:
            return describe(params, images, config)[0, 0]

        return jax.grad(first)(params) if gradient else describe(params, images, config)

    with lowering_for(chosen):
        return program.lower(params, images).as_text()  # pyright: ignore


FRESH = """
import sys
from tests.utils.test_target import CPU, HALF, text
sys.stdout.write(text(CPU, HALF, gradient=True))
"""


@pytest.mark.slow  # starts another process
def test_programs_for_several_platforms_in_one_process() -> None:
    """Each has its own attention, and the CPU's is the one of a process that lowers no other."""
    for chosen in (GPU, CPU, TPU, CPU):
        for gradient in (False, True):
            found = text(chosen, HALF, gradient=gradient)
            assert (CUDNN in found) == (chosen == GPU)
            assert ("Backward" in found) == (chosen == GPU and gradient)
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": os.getcwd()}
    fresh = subprocess.run(
        [sys.executable, "-c", FRESH], env=environment, capture_output=True, text=True, check=False
    )
    assert fresh.returncode == 0, fresh.stderr
    assert text(CPU, HALF, gradient=True) == fresh.stdout


def test_a_kernel_is_told_the_devices_of_the_arguments() -> None:
    """It cannot be sharded without; where they are not known, a kernel is not used."""
    mesh = AbstractMesh((4,), ("image",))
    rows = NamedSharding(mesh, PartitionSpec("image"))
    leaves = [
        jax.ShapeDtypeStruct((2,), "float32"),
        jax.ShapeDtypeStruct((8,), "int8", sharding=rows),
    ]
    with lowering_for(TPU):
        with targets.over_devices_of(leaves):
            assert targets.traced_mesh() == mesh
        with targets.over_devices_of(leaves[:1]):
            alone = targets.traced_mesh()
            assert alone is not None
            assert alone.size == 1
    with lowering_for(GPU), targets.over_devices_of(leaves):
        found = targets.traced_mesh()
        assert found is None or found.size == 1


def test_without_arguments_the_devices_are_the_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    for count, known in ((1, True), (8, False)):
        monkeypatch.setattr(jax, "device_count", lambda count=count: count)
        assert (targets.traced_mesh() is not None) == known
