"""The memory of a step, by the compiler's analysis and the devices' limits."""

import types

import jax

from crisalad_jax.training.trainer import memory_limit, memory_of


def test_memory_is_that_of_the_compiled_program():
    """Arguments, results and what lies between, without what overwrites an argument."""

    def product(x: jax.Array, y: jax.Array) -> jax.Array:
        return x + (y @ y.T).sum()

    x, y = (jax.ShapeDtypeStruct((256, 256), "float32") for _ in range(2))
    size = 4 * 256**2
    plain = memory_of(jax.jit(product).lower(x, y).compile())
    donated = memory_of(jax.jit(product, donate_argnums=0).lower(x, y).compile())
    assert plain - donated == size
    assert 3 * size <= plain <= 6 * size


def test_a_limit_is_that_of_the_smallest_device():
    devices = [types.SimpleNamespace(memory_stats=lambda n=n: {"bytes_limit": n}) for n in (7, 5)]
    assert memory_limit(devices) == 5
    assert memory_limit(jax.local_devices()) is None  # a CPU names none
