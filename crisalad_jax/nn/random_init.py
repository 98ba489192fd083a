"""Draw the initial parameters that `jax.random` draws, with only a few compiled programs.

`jax.random` compiles a program for every shape, which takes 9 s for a model. Here one program per
distribution draws `_CHUNK` numbers, and is called until there are enough: 1 to 2 s. The bits of
JAX's threefry depend only on the key and the position, so the numbers are those of `jax.random`.
While JAX traces, and for keys of other generators, `jax.random` itself is used. All numbers are
float32, in JAX's 64-bit mode too.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.random import define_prng_impl, threefry2x32_p
from jaxtyping import Array, Float, PRNGKeyArray

_CHUNK = 2**16
"""Numbers that one call of a program draws."""
_MOST_KEYS = 64
"""Number of keys that a key is always split into; the first keys do not depend on it."""

Shape = Sequence[int]


def _bits_from(data: Array, bit_width: int, shape: Shape) -> Array:
    """Draw 32 bits for each position from `data[2]` on, with the key `data[:2]`.

    A position is a counter of 64 bits, whose two encrypted words are combined, as in JAX.
    """
    assert bit_width == 32
    low = data[2] + jnp.arange(math.prod(shape), dtype=jnp.uint32)
    words = threefry2x32_p.bind(data[0], data[1], jnp.zeros_like(low), low)
    return (words[0] ^ words[1]).reshape(shape)


def _only_draws(*_: Any) -> Array:
    raise NotImplementedError("a key of `_at_a_place` can only draw")


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
def _chunk(key: Array, distribution: Callable[..., Array], **limits: Any) -> Array:
    """Draw `_CHUNK` numbers of a distribution of `jax.random`, with a key of `_at_a_place`."""
    key = jax.random.wrap_key_data(key, impl=_at_a_place)
    return distribution(key, shape=(_CHUNK,), dtype=jnp.float32, **limits)


def _is_plain(key: Any) -> bool:
    """Return whether a key is concrete and of the generator that is implemented here."""
    if isinstance(key, Tracer) or not jax.config.jax_threefry_partitionable:  # pyright: ignore
        return False
    return str(jax.random.key_impl(key)) == "threefry2x32"


def _draw(
    distribution: Callable[..., Array], key: Any, shape: Shape, scale: float = 1.0, **limits: float
) -> Float[Array, "*shape"]:
    size = math.prod(shape)
    if not _is_plain(key) or size >= 2**32:
        drawn = distribution(key, shape=tuple(shape), dtype=jnp.float32, **limits)
        return drawn if scale == 1 else scale * drawn
    data = np.asarray(jax.random.key_data(key))
    places = range(0, size, _CHUNK)
    numbers = np.empty(len(places) * _CHUNK, np.float32)
    for place in places:
        at = np.append(data, np.uint32(place))
        numbers[place : place + _CHUNK] = _chunk(at, distribution, **limits)
    return jax.device_put(np.float32(scale) * numbers[:size].reshape(shape))


def uniform(
    key: PRNGKeyArray, shape: Shape, *, minval: float, maxval: float
) -> Float[Array, "*shape"]:
    """Draw the same numbers as `jax.random.uniform`."""
    return _draw(jax.random.uniform, key, shape, minval=minval, maxval=maxval)


def normal(key: PRNGKeyArray, shape: Shape, *, scale: float = 1.0) -> Float[Array, "*shape"]:
    """Draw the same numbers as `jax.random.normal`, times `scale`."""
    return _draw(jax.random.normal, key, shape, scale)


def truncated_normal(
    key: PRNGKeyArray, lower: float, upper: float, shape: Shape, *, scale: float = 1.0
) -> Float[Array, "*shape"]:
    """Draw the same numbers as `jax.random.truncated_normal`, times `scale`."""
    return _draw(jax.random.truncated_normal, key, shape, scale, lower=lower, upper=upper)


def split(key: PRNGKeyArray, num: int = 2) -> list[PRNGKeyArray]:
    """Split a key as `jax.random.split` does, with the same program for every `num` up to 64."""
    return list(jax.random.split(key, max(num, _MOST_KEYS)))[:num]


def stacked(draw: Callable[[PRNGKeyArray], Any], keys: Sequence[PRNGKeyArray]) -> Any:
    """Draw with each key, and stack the results along a new first axis."""
    if not all(map(_is_plain, keys)):
        return jax.vmap(draw)(jnp.stack(list(keys)))

    def stack(*leaves: Array) -> Array:
        return jax.device_put(np.stack([np.asarray(leaf) for leaf in leaves]))

    return jax.tree.map(stack, *map(draw, keys))


def full(shape: Shape, value: float) -> Float[Array, "*shape"]:
    """Make a float32 array of one value, without compiling a program."""
    return jax.device_put(np.full(shape, value, np.float32))


def zeros(*shape: int) -> Float[Array, "*shape"]:
    """Make a float32 array of zeros, without compiling a program."""
    return full(shape, 0.0)


def ones(*shape: int) -> Float[Array, "*shape"]:
    """Make a float32 array of ones, without compiling a program."""
    return full(shape, 1.0)
