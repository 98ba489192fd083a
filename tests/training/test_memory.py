"""Which micro-batch is told where a step does not fit, of programs that take known memory."""

import dataclasses
import types
from collections.abc import Callable

import jax
import pytest

from crisalad_jax.training import memory
from crisalad_jax.training.memory import check_memory, memory_limit, memory_of
from crisalad_jax.utils.errors import InputError
from tests.conftest import RECIPE

GB = 10**9
CONFIG = dataclasses.replace(RECIPE, places_per_batch=48, images_per_place=4, min_images=4)
Needed = Callable[[int], float]


def told(needed: Needed, limit: float, devices: int, given: int | None = None) -> tuple[str, int]:
    """The message, and how many programs were compiled."""
    sizes = []

    def compiled_size(micro_batch: int | None) -> int:
        sizes.append(micro_batch)
        return int(needed(micro_batch or 192) * GB)

    config = dataclasses.replace(CONFIG, micro_batch=given)
    with pytest.raises(InputError) as caught:
        check_memory(compiled_size, config, int(limit * GB), devices)
    assert len(sizes) == len(set(sizes))
    return str(caught.value), len(sizes)


NEEDED: dict[str, Needed] = {
    "a line": lambda size: 4 + size / 10,
    # Recomputing takes more than the whole batch would by the line, as it does in bfloat16.
    "a line and a step": lambda size: 4 + size / 10 + (size < 192),
    "a curve": lambda size: 4 + (size / 40) ** 2,
    "steps": lambda size: 4 + size // 30 * 3,
}


@pytest.mark.parametrize("name", NEEDED)
@pytest.mark.parametrize("devices", [1, 8])
@pytest.mark.parametrize("given", [None, 96])
@pytest.mark.parametrize("limit", [6.5, 8.1, 11.1, 13.1])
def test_the_largest_micro_batch_that_fits_is_told(name, devices, given, limit):
    needed = NEEDED[name]
    whole = given or 192
    # Each device takes as many images at once, and a divisor of its own.
    own = 192 // devices
    sizes = [size for size in range(1, whole) if 192 % size == size % devices == 0]
    sizes = [size for size in sizes if own % (size // devices) == 0]
    if needed(whole) <= limit:
        return  # nothing to tell
    best = max(size for size in sizes if needed(size) <= limit)
    words, compiled = told(needed, limit, devices, given)
    assert words == (
        f"training: found a step that takes {needed(whole):.1f} GB of each device, expected at "
        f"most {limit:.1f} GB; --micro-batch {best} takes {needed(best):.1f} GB"
    )
    # The whole, the smallest, then the guess and its neighbour; more where there is no line.
    assert compiled <= (4 if name == "a line" else 7)


def test_where_nothing_fits_other_ways_are_told():
    words, compiled = told(NEEDED["a line"], 4.5, 8)
    assert words.endswith(
        "found a step that takes 23.2 GB of each device, expected at most 4.5 GB; no --micro-batch "
        "is small enough: take --model.compute-dtype bfloat16, --model.remat full, --shard-state, "
        "a smaller image or model, or more devices"
    )
    assert compiled == 2


def test_a_compiler_that_knows_the_limit_itself_is_heard():
    def compiled_size(micro_batch: int | None) -> int:
        if (micro_batch or 192) > 48:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: XLA:TPU compile permanent error")
        return 11 * GB

    words = "more than there is of each device, expected at most 16.0 GB; --micro-batch 48 takes 11"
    with pytest.raises(InputError, match=words):
        check_memory(compiled_size, CONFIG, 16 * GB, 1)


def test_what_fits_is_compiled_once_and_where_nothing_is_known_nothing_is():
    assert memory_limit(jax.local_devices()) is None  # a CPU tells none
    check_memory(lambda _: pytest.fail("compiled"), CONFIG, None, 1)
    compiled = []

    def compiled_size(micro_batch: int | None) -> int:
        compiled.append(micro_batch)
        return 11 * GB

    check_memory(compiled_size, CONFIG, 16 * GB, 1)
    assert compiled == [None]


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


def test_processes_of_different_limits_decide_alike(monkeypatch):
    """The least memory of all counts: else some would compile another program, and wait."""
    asked = []

    def all_max(*numbers: int) -> tuple[int, ...]:
        asked.append(numbers)
        # Another process has 5 GB, told as what it lacks of the most that there may be.
        return (max(numbers[0], memory._MOST - 5 * GB // memory._KIB),)

    monkeypatch.setattr(memory.distributed, "all_max", all_max)
    words, _ = told(lambda size: 4 + size / 10, 100.0, 1)
    assert "expected at most 5.0 GB; --micro-batch 8 takes 4.8 GB" in words
    assert len(asked) == 1
