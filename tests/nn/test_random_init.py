"""Parameters are drawn as `jax.random` draws them, to the bit, from a handful of programs."""

import contextlib
import logging
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import PRNGKeyArray

from crisalad_jax.nn import random_init
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import init_crisalad
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import assert_equal

Draw = Callable[[PRNGKeyArray, Sequence[int]], jax.Array]
# JAX has its bounds as arguments too, so that both multiply and add in the same order.
PAIRS: dict[str, tuple[Draw, Draw]] = {
    "uniform": (
        lambda key, shape: random_init.uniform(key, shape, minval=-0.3, maxval=0.1),
        lambda key, shape: jax.random.uniform(key, shape, minval=-0.3, maxval=0.1),
    ),
    "normal": (
        lambda key, shape: random_init.normal(key, shape, scale=0.02),
        lambda key, shape: 0.02 * jax.random.normal(key, shape),
    ),
    "truncated normal": (
        lambda key, shape: random_init.truncated_normal(key, -2.0, 2.0, shape),
        lambda key, shape: jax.random.truncated_normal(key, -2.0, 2.0, shape),
    ),
}


@pytest.mark.parametrize("shape", [(), (0, 3), (7,), (300, 2, 219)])  # the last takes three calls
@pytest.mark.parametrize("name", PAIRS)
def test_the_numbers_are_those_of_jax(name: str, shape: tuple[int, ...]) -> None:
    ours, theirs = PAIRS[name]
    key = jax.random.key(11)
    # XLA may round the last operation otherwise in a program of another shape: one ulp.
    np.testing.assert_array_max_ulp(
        np.asarray(ours(key, shape)), np.asarray(theirs(key, shape)), maxulp=1
    )


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg"])
@pytest.mark.parametrize("name", PAIRS)
def test_other_generators_traces_and_old_keys_draw_as_jax_does(name: str, impl: str) -> None:
    ours, theirs = PAIRS[name]
    for key in (jax.random.key(5, impl=impl), jax.random.PRNGKey(5, impl=impl)):
        if impl == "rbg" and key.dtype == jnp.uint32:
            continue  # JAX takes such keys for the default generator's only
        expected = np.asarray(theirs(key, (5, 2)))
        np.testing.assert_array_max_ulp(np.asarray(ours(key, (5, 2))), expected, maxulp=1)
        traced = jax.jit(lambda key: ours(key, (5, 2)))(key)
        np.testing.assert_allclose(traced, expected, rtol=1e-6, atol=1e-9)  # products are fused


@pytest.mark.parametrize("number", [1, 2, 40, 100])
def test_keys_are_split_as_jax_does(number: int) -> None:
    for key in (jax.random.key(2**32 - 1), jax.random.PRNGKey(7)):
        found = [jax.random.key_data(each) for each in random_init.split(key, number)]
        np.testing.assert_array_equal(
            np.stack(found), jax.random.key_data(jax.random.split(key, number))
        )


@pytest.mark.parametrize("name", PAIRS)
def test_64_bit_mode_draws_the_same_numbers(name: str) -> None:
    ours, key = PAIRS[name][0], jax.random.key(0)
    eager, traced = ours(key, (3,)), jax.jit(lambda key: ours(key, (3,)))(key)
    with jax.enable_x64(True):
        assert_equal((ours(key, (3,)), random_init.zeros(3)), (eager, jnp.zeros(3, jnp.float32)))
        assert_equal(jax.jit(lambda key: ours(key, (3,)))(key), traced)


def test_a_model_is_the_one_that_a_trace_draws() -> None:
    config = PRESETS["tiny"]
    key = jax.random.key(3)
    eager = named_leaves(init_crisalad(key, config))
    traced = named_leaves(jax.jit(lambda key: init_crisalad(key, config))(key))
    assert eager.keys() == traced.keys()
    for name, leaf in eager.items():
        # Fused products round otherwise; the largest weight is below 1.
        np.testing.assert_allclose(leaf, traced[name], atol=1e-7, err_msg=name)


@pytest.mark.slow  # compiles whole models
def test_a_model_is_drawn_by_a_handful_of_programs() -> None:
    compiled: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: compiled.append(record.getMessage())  # pyright: ignore
    logger = logging.getLogger("jax._src.interpreters.pxla")
    jax.clear_caches()
    with contextlib.ExitStack() as stack:
        logger.addHandler(handler)
        stack.callback(logger.removeHandler, handler)
        stack.enter_context(jax.log_compiles(True))
        init_crisalad(jax.random.key(1), PRESETS["tiny"])
    # Three distributions, the seed, splitting, and a few conversions of single numbers.
    programs = [line for line in compiled if line.startswith("Compiling")]
    assert 3 <= len(programs) <= 12, programs
