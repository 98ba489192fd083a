"""Draw parameters in seconds: the numbers of `jax.random`, from a handful of small programs.

`jax.random` compiles a program for every shape, which takes longer than all drawing. Here one
program of each distribution draws `_CHUNK` numbers, and is called until there are enough. The bits
of JAX's threefry depend on the key and the place alone, so the numbers are those of `jax.random`.
All are float32, in JAX's 64-bit mode too. While JAX traces (`jax.eval_shape`, `jax.jit`), and for
other generators, `jax.random` draws itself.
"""

import contextlib
import contextvars
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl, threefry2x32_p
from jaxtyping import Array, Float, PRNGKeyArray

_CHUNK = 2**16
"""Numbers that one call of a program draws."""
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)
"""Constants of Threefry-2x32 (Salmon et al., SC 2011, Table 2 and section 4.2)."""

Shape = Sequence[int]
_only_shapes: contextvars.ContextVar[bool] = contextvars.ContextVar("only_shapes", default=False)


def _bits_from(data: Array, bit_width: int, shape: Shape) -> Array:
    """Draw the 32 bits of places `data[2]` and on, with the key `data[:2]`.

    Each place is a counter of 64 bits, whose two encrypted words are combined, as JAX has it.
    """
    assert bit_width == 32
    low = data[2] + jnp.arange(math.prod(shape), dtype=jnp.uint32)
    words = threefry2x32_p.bind(data[0], data[1], jnp.zeros_like(low), low)
    return (words[0] ^ words[1]).reshape(shape)


def _only_draws(*_: Any) -> Array:
    raise NotImplementedError("a key with a place draws, and is not split")


_at_a_place = define_prng_impl(
    key_shape=(3,),
    seed=_only_draws,
    split=_only_draws,
    random_bits=_bits_from,
    fold_in=_only_draws,
    name="threefry_at_a_place",
    tag="fryp",
)


@functools.partial(jax.jit, static_argnames="distribution")
def _chunk(key: Array, distribution: Callable[..., Array], *limits: Any) -> Array:
    """Draw `_CHUNK` numbers of a distribution of `jax.random`, with a key of `_at_a_place`."""
    return distribution(jax.random.wrap_key_data(key, impl=_at_a_place), limits, (_CHUNK,))


def _uniform(key: PRNGKeyArray, limits: tuple[Any, ...], shape: Shape) -> Array:
    return jax.random.uniform(key, shape, jnp.float32, minval=limits[0], maxval=limits[1])


def _normal(key: PRNGKeyArray, _: tuple[Any, ...], shape: Shape) -> Array:
    return jax.random.normal(key, shape, jnp.float32)


def _truncated_normal(key: PRNGKeyArray, limits: tuple[Any, ...], shape: Shape) -> Array:
    return jax.random.truncated_normal(key, limits[0], limits[1], shape, jnp.float32)


@contextlib.contextmanager
def only_shapes() -> Iterator[None]:
    """Draw zeros in this context: a trace for shapes alone is several times as fast."""
    token = _only_shapes.set(True)
    try:
        yield
    finally:
        _only_shapes.reset(token)


def _is_plain(key: Any) -> bool:
    """Return whether the numbers that `jax.random` draws with a key can be drawn here."""
    if isinstance(key, jax.core.Tracer) or not jax.config.jax_threefry_partitionable:  # pyright: ignore
        return False
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return jax.random.key_impl(key) == "threefry2x32" and key.shape == ()
    return jax.config.jax_default_prng_impl == "threefry2x32" and key.shape == (2,)  # pyright: ignore


def _draw(
    distribution: Callable[..., Array], key: Any, shape: Shape, scale: float, *limits: float
) -> Array:
    if _only_shapes.get():
        return jnp.zeros(shape, jnp.float32)
    size = math.prod(shape)
    if not _is_plain(key) or size >= 2**32:
        drawn = distribution(key, limits, tuple(shape))
        return drawn if scale == 1 else scale * drawn
    data = np.asarray(jax.random.key_data(key))
    places = range(0, size, _CHUNK)
    numbers = np.empty(len(places) * _CHUNK, np.float32)
    for place in places:
        at = np.append(data, np.uint32(place))
        numbers[place : place + _CHUNK] = _chunk(at, distribution, *limits)
    drawn = numbers[:size].reshape(shape)
    return jax.device_put(drawn if scale == 1 else np.float32(scale) * drawn)


def uniform(
    key: PRNGKeyArray, shape: Shape, *, minval: float, maxval: float
) -> Float[Array, "*shape"]:
    """Draw what `jax.random.uniform` draws."""
    return _draw(_uniform, key, shape, 1.0, minval, maxval)


def normal(key: PRNGKeyArray, shape: Shape, *, scale: float = 1.0) -> Float[Array, "*shape"]:
    """Draw what `jax.random.normal` draws, times `scale`."""
    return _draw(_normal, key, shape, scale)


def truncated_normal(
    key: PRNGKeyArray, lower: float, upper: float, shape: Shape, *, scale: float = 1.0
) -> Float[Array, "*shape"]:
    """Draw what `jax.random.truncated_normal` draws, times `scale`."""
    return _draw(_truncated_normal, key, shape, scale, lower, upper)


def split(key: PRNGKeyArray, num: int = 2) -> list[PRNGKeyArray]:
    """Split a key as `jax.random.split` does."""
    if _only_shapes.get():
        return [key] * num
    return _derived(key, range(num)) if _is_plain(key) else list(jax.random.split(key, num))


def fold_in(key: PRNGKeyArray, number: int) -> PRNGKeyArray:
    """Derive a key as `jax.random.fold_in` does."""
    if _only_shapes.get():
        return key
    return _derived(key, [number])[0] if _is_plain(key) else jax.random.fold_in(key, number)


def _derived(key: PRNGKeyArray, numbers: Sequence[int]) -> list[PRNGKeyArray]:
    words = _encrypted(np.asarray(jax.random.key_data(key)), np.array(numbers, np.uint32))
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return [jax.random.wrap_key_data(each, impl="threefry2x32") for each in words]
    return list(map(jax.device_put, words))


def _encrypted(key: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Encrypt counters of 64 bits below 2**32, by Threefry-2x32 of 20 rounds, in numpy."""
    keys = (key[0], key[1], key[0] ^ key[1] ^ _PARITY)
    with np.errstate(over="ignore"):  # sums of 32 bits wrap
        first, second = np.full_like(low, key[0]), low + key[1]
        for group in range(5):
            for rotation in _ROTATIONS[group % 2]:
                first = first + second
                second = (second << rotation | second >> (32 - rotation)) ^ first
            first = first + keys[(group + 1) % 3]
            second = second + keys[(group + 2) % 3] + np.uint32(group + 1)
    return np.stack([first, second], axis=1)


def stacked(draw: Callable[[PRNGKeyArray], Any], keys: Sequence[PRNGKeyArray]) -> Any:
    """Draw with each key, and stack the results along a new first axis."""
    if _only_shapes.get():
        first = jax.eval_shape(draw, keys[0])
        return jax.tree.map(lambda leaf: jnp.zeros((len(keys), *leaf.shape), leaf.dtype), first)
    if not all(map(_is_plain, keys)):
        return jax.vmap(draw)(jnp.stack(list(keys)))

    def stack(*leaves: Array) -> Array:
        return jax.device_put(np.stack([np.asarray(leaf) for leaf in leaves]))

    return jax.tree.map(stack, *map(draw, keys))


def full(shape: Shape, value: float) -> Float[Array, "*shape"]:
    """Make a float32 array of one value, without a program for it."""
    return jax.device_put(np.full(shape, value, np.float32))


def zeros(*shape: int) -> Float[Array, "*shape"]:
    """Make a float32 array of zeros, without a program for it."""
    return full(shape, 0.0)


def ones(*shape: int) -> Float[Array, "*shape"]:
    """Make a float32 array of ones, without a program for it."""
    return full(shape, 1.0)
