"""Matrix products and convolutions, in the types that are fastest on each platform."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Float

from crisalad_jax.utils.target import target, widens_slices


def product_precision(dtype: Any) -> jax.lax.Precision | None:
    """Return the precision of a matrix product in `dtype`; None is that of JAX's configuration.

    An accelerator multiplies 8-bit significands exactly in one pass, so bfloat16 needs only one.
    """
    single = dtype == jnp.bfloat16 and target().platform != "cpu"
    return jax.lax.Precision.DEFAULT if single else None


def rule_precision(dtype: Any) -> str | None:
    """Return the current precision, for custom gradients, whose backward pass is traced later."""
    if product_precision(dtype) is not None:
        return "default"
    return None if target().platform == "cpu" else jax.config.jax_default_matmul_precision  # pyright: ignore


def row_major(x: Array) -> Array:
    """Lay out an array in the order of its axes.

    XLA's library for CPUs supports a bfloat16 product only if both sides are laid out like this,
    and the left one ends with the axis that is summed over; others are computed in float32.
    """
    return with_layout_constraint(x, Layout(tuple(range(x.ndim))))


def keep(x: Array, name: str) -> Array:
    """Name a result, so that a policy of `jax.checkpoint` saves it for the gradient.

    Where XLA would widen saved bfloat16 arrays (`widens_slices`), their bits are saved instead.
    """
    if x.dtype == jnp.bfloat16 and widens_slices():
        return _keep_bits(x, name)
    return checkpoint_name(x, name)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _keep_bits(x: Array, name: str) -> Array:
    return x


@_keep_bits.defjvp
def _keep_bits_jvp(name: str, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    bits = jax.lax.bitcast_convert_type(*primals, jnp.uint16)
    return jax.lax.bitcast_convert_type(checkpoint_name(bits, name), jnp.bfloat16), tangents[0]


def map_first_axis(function: Callable[[Any], Array], stacks: Any) -> Array:
    """Map a function over the first axis of a tree of arrays, one index after the other.

    Where XLA would widen a stack of bfloat16 (`widens_slices`), the loop reads and writes its bits.
    The map can't be differentiated.
    """

    def bits(x: Array) -> Array:
        narrow = x.dtype == jnp.bfloat16 and widens_slices()
        return jax.lax.bitcast_convert_type(x, jnp.uint16) if narrow else x

    def number(x: Array) -> Array:
        is_bits = x.dtype == jnp.uint16
        return jax.lax.bitcast_convert_type(x, jnp.bfloat16) if is_bits else x

    def each(slices: Any) -> Array:
        return bits(function(jax.tree.map(number, slices)))

    return number(jax.lax.map(each, jax.tree.map(bits, stacks)))


def matmul(rows: Float[Array, "row d_in"], weight: Float[Array, "d_in d_out"]) -> Array:
    """Multiply rows by a weight cast to their dtype; for bfloat16, the result may be float32."""
    dtype = rows.dtype
    if dtype == jnp.bfloat16 and target().platform == "cpu":
        return _narrow_matmul(rows, weight)
    multiply = functools.partial(jnp.matmul, precision=product_precision(dtype))

    def product(rows: Array, weight: Array) -> Array:
        out = target().product_dtype(dtype)
        return multiply(rows, weight.astype(dtype), preferred_element_type=out)

    def weight_gradient(rows: Array, change: Array, weight: Array) -> Array:
        return multiply(rows.T, change, preferred_element_type=weight.dtype)

    return _with_wide_gradient(product, weight_gradient, rows, weight)


@jax.custom_vjp
def _narrow_matmul(rows: Array, weight: Array) -> Array:
    """Multiply in bfloat16 in both directions: JAX's own rule takes the float32 cotangent as it is.

    Here it is rounded to bfloat16, as `linear` rounds the result.
    """
    return jnp.matmul(rows, weight.astype(rows.dtype), preferred_element_type=jnp.float32)


def _narrow_forward(rows: Any, weight: Any) -> tuple[Array, tuple[Array | None, Array]]:
    kept = rows.value if weight.perturbed else None  # a frozen weight has no gradient
    return _narrow_matmul(rows.value, weight.value), (kept, weight.value)


def _narrow_backward(kept: tuple[Array | None, Array], change: Array) -> tuple[Array, Array | None]:
    rows, weight = kept
    change = change.astype(jnp.bfloat16)
    multiply = functools.partial(jnp.einsum, preferred_element_type=jnp.float32)
    narrow = row_major(weight.astype(change.dtype))
    to_rows = multiply("ro,io->ri", change, narrow).astype(change.dtype)
    if rows is None:
        return to_rows, None
    return to_rows, multiply("ir,ro->io", row_major(rows.T), change).astype(weight.dtype)


_narrow_matmul.defvjp(_narrow_forward, _narrow_backward, symbolic_zeros=True)


def convolve(
    images: Float[Array, "image height width d_in"],
    weight: Float[Array, "k k d_in d_out"],
    *,
    stride: int,
    margin: int,
) -> Float[Array, "image rows columns d_out"]:
    """Convolve images, padded with `margin` zeros per side, with a weight cast to their type."""
    convolution = functools.partial(
        jax.lax.conv_general_dilated, precision=product_precision(images.dtype)
    )

    def product(images: Array, weight: Array) -> Array:
        return convolution(
            images,
            weight.astype(images.dtype),
            window_strides=(stride, stride),
            # Not "SAME", which pads less before the image than after it if the stride is 2.
            padding=((margin, margin), (margin, margin)),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )

    def weight_gradient(images: Array, change: Array, weight: Array) -> Array:
        # Convolve with the cotangent, whose pixels are `stride` apart, and the images as channels.
        # Pixels that no window reached are cut off at the end.
        sides = zip(weight.shape, change.shape[1:3], images.shape[1:3], strict=False)
        ends = [size + stride * (rows - 1) - length - margin for size, rows, length in sides]
        return convolution(
            images,
            change,
            window_strides=(1, 1),
            padding=[(margin, end) for end in ends],
            rhs_dilation=(stride, stride),
            dimension_numbers=("CHWN", "IHWO", "HWNC"),
            preferred_element_type=weight.dtype,
        )

    return _with_wide_gradient(product, weight_gradient, images, weight)


def _with_wide_gradient(
    product: Callable[[Array, Array], Array],
    weight_gradient: Callable[[Array, Array, Array], Array],
    x: Array,
    weight: Array,
) -> Array:
    """Compute product(x, weight); on accelerators, sum a wider weight's gradient in its type.

    JAX's rule rounds it to bfloat16 before the sum over devices. A CPU's devices are virtual, so
    its program does without this.
    """
    if x.dtype != jnp.bfloat16 or weight.dtype == x.dtype or target().platform == "cpu":
        return product(x, weight)

    def forward(x: Array, weight: Array) -> tuple[Array, tuple[Array, Array]]:
        return product(x, weight), (x, weight)

    def backward(kept: tuple[Array, Array], change: Array) -> tuple[Array, Array]:
        x, weight = kept
        (to_x,) = jax.linear_transpose(lambda x: product(x, weight), x)(change)
        return to_x, weight_gradient(x, change.astype(x.dtype), weight)

    multiply = jax.custom_vjp(product)
    multiply.defvjp(forward, backward)
    return multiply(x, weight)
