"""The conversion of each JAX primitive to ONNX nodes."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.onnx_format.graph import (
    Graph,
    Shape,
    Value,
    common_shape,
    is_known,
    is_one,
)

Converter = Callable[[Graph, Sequence[Value], Any], list[Value]]
"""A function that appends the nodes of a JAX equation to a graph, and returns the outputs."""
CONVERTERS: dict[str, Converter] = {}
"""Converters by the name of their primitive."""


class Unsupported(Exception):
    """A primitive, or a use of one, that cannot be converted; the message names it."""


def converts(*names: str) -> Callable[[Converter], Converter]:
    """Return a decorator that registers a converter for primitives of these names."""

    def register(converter: Converter) -> Converter:
        CONVERTERS.update(dict.fromkeys(names, converter))
        return converter

    return register


# Elementwise operations, which nodes broadcast as numpy does.

_SAME_NAMES = (
    *("abs", "add", "and", "ceil", "cos", "div", "erf", "exp", "floor", "log", "max", "min"),
    *("mul", "neg", "not", "or", "pow", "sign", "sin", "sqrt", "sub", "tanh", "xor"),
)
"""Primitives that have the operators' names, except for the capital letter."""
_PLAIN = {name: name.capitalize() for name in _SAME_NAMES} | {
    "add_any": "Add",
    "eq": "Equal",
    "ge": "GreaterOrEqual",
    "gt": "Greater",
    "le": "LessOrEqual",
    "logistic": "Sigmoid",
    "lt": "Less",
}
"""Operators by the equivalent primitive."""
_COMPOSED: Mapping[str, Callable[..., Value]] = {
    "clamp": lambda add, params, least, x, most: add("Min", add("Max", x, least), most),
    "exp2": lambda add, params, x: add("Pow", 2, x),
    "expm1": lambda add, params, x: add("Sub", add("Exp", x), 1),
    "integer_pow": lambda add, params, x: (
        add("Mul", x, x) if params["y"] == 2 else add("Pow", x, params["y"])
    ),
    # Only finite numbers times 0 are 0, and all engines have these two operators.
    "is_finite": lambda add, params, x: add("Equal", add("Mul", x, 0), 0),
    "log1p": lambda add, params, x: add("Log", add("Add", x, 1)),
    "ne": lambda add, params, x, y: add("Not", add("Equal", x, y)),
    # `Round` rounds halves to even, as jnp.round does; lax.round rounds them away from 0.
    "round": lambda add, params, x: (
        add("Round", x)
        if params["rounding_method"].name == "TO_NEAREST_EVEN"
        else add("Mul", add("Sign", x), add("Floor", add("Add", add("Abs", x), 0.5)))
    ),
    "rsqrt": lambda add, params, x: add("Div", 1, add("Sqrt", x)),
    "select_n": lambda add, params, which, no, yes: add("Where", which, yes, no),
    "square": lambda add, params, x: add("Mul", x, x),
}
"""Functions that build a primitive from several operators, by primitive."""


@converts(*_PLAIN, *_COMPOSED)
def _elementwise(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    """Convert to one operator or several. JAX itself computes constants."""
    name, dtype = eqn.primitive.name, np.dtype(eqn.outvars[0].aval.dtype)
    shape = common_shape(*(value.shape for value in inputs))
    if all(value.constant is not None for value in inputs):
        arrays = [np.broadcast_to(value.constant, shape) for value in inputs]  # type: ignore
        return [Value.of(eqn.primitive.bind(*map(np.asarray, arrays), **eqn.params))]
    if len(inputs) > 3 or (name in ("and", "or", "not", "xor") and dtype != np.bool_):
        raise Unsupported(f"{name} of {len(inputs)} arrays of {dtype}")
    add = functools.partial(_node, graph, shape)
    if name in _PLAIN:
        value = add(_PLAIN[name], *inputs)
    else:
        value = _COMPOSED[name](add, eqn.params, *inputs)
    return [dataclasses.replace(value, dtype=dtype)]


def _node(graph: Graph, shape: Shape, operator: str, *inputs: Value | float) -> Value:
    """Append a node; plain numbers among the inputs get the type of the other inputs.

    The type of the result may differ: the caller sets that of an equation's last node.
    """
    dtype = next(each.dtype for each in reversed(inputs) if isinstance(each, Value))
    values = [x if isinstance(x, Value) else Value.of(np.array(x, dtype)) for x in inputs]
    return graph.add(operator, values, shape, dtype)


# Operations that move values and compute none.


@converts("stop_gradient", "name", "copy", "copy_p", "optimization_barrier", "reduce_precision")
def _same(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    return list(inputs)


@converts("convert_element_type")
def _cast(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    return [graph.cast(inputs[0], eqn.params["new_dtype"])]


@converts("broadcast_in_dim")
def _broadcast(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    own: list[Any] = [1] * len(eqn.params["shape"])
    for axis, size in zip(eqn.params["broadcast_dimensions"], inputs[0].shape, strict=True):
        own[axis] = size
    return [graph.reshape(inputs[0], tuple(own))]


@converts("reshape", "squeeze", "expand_dims")
def _reshape(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (x,) = inputs
    before, after = eqn.invars[0].aval.shape, eqn.outvars[0].aval.shape
    own = _with_other_ones(x.shape, before, after)
    return [graph.reshape(x, own) if own else graph.reshape(graph.full(x, before), after)]


def _with_other_ones(own: Shape, before: Shape, after: Shape) -> Shape | None:
    """Return the lazy shape of an array that only gains or loses sides of 1; else None."""
    kept = [axis for axis, size in enumerate(before) if not is_one(size)]
    places = [axis for axis, size in enumerate(after) if not is_one(size)]
    if [before[axis] for axis in kept] != [after[axis] for axis in places]:
        return None
    shape: list[Any] = [1] * len(after)
    for axis, place in zip(kept, places, strict=True):
        shape[place] = own[axis]
    return tuple(shape)


@converts("transpose")
def _transpose(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    return [graph.transpose(inputs[0], eqn.params["permutation"])]


@converts("slice")
def _slice(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    starts, ends = eqn.params["start_indices"], eqn.params["limit_indices"]
    steps = eqn.params["strides"] or (1,) * len(starts)
    cuts = zip(starts, ends, steps, strict=True)
    return [_cut(graph, inputs[0], eqn.invars[0].aval.shape, cuts)]


def _cut(graph: Graph, x: Value, whole: Shape, parts: Iterable[tuple[Any, Any, int]]) -> Value:
    """Take a part of each axis, from a start to an end, where the array is not broadcast."""
    cuts = {}
    for axis, cut in enumerate(parts):
        if cut == (0, whole[axis], 1) or is_one(x.shape[axis]):
            continue
        if not all(map(is_known, cut)):
            raise Unsupported("slice of some of the images")
        cuts[axis] = tuple(map(int, cut))
    return graph.slice(x, cuts)


@converts("split")
def _split(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (x,), axis, sizes = inputs, eqn.params["axis"], eqn.params["sizes"]
    if is_one(x.shape[axis]):
        return [x] * len(sizes)
    ends = itertools.accumulate(sizes)
    return [
        graph.slice(x, {axis: (end - size, end, 1)}) for size, end in zip(sizes, ends, strict=True)
    ]


@converts("concatenate")
def _concatenate(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    axis = eqn.params["dimension"]
    wholes = [
        graph.full(x, var.aval.shape, [axis]) for x, var in zip(inputs, eqn.invars, strict=True)
    ]
    return [graph.concatenate(wholes, axis)]


@converts("stack")
def _stack(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    return [stacked(graph, inputs, eqn.params["axis"])]


def stacked(graph: Graph, values: Sequence[Value], axis: int) -> Value:
    """Join values of one shape along a new axis, as `np.stack` does."""
    parts = [graph.reshape(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in values]
    return graph.concatenate(parts, axis)


@converts("pad")
def _pad(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    x, filling = inputs
    config = eqn.params["padding_config"]
    if any(inside or low < 0 or high < 0 for low, high, inside in config):
        raise Unsupported("pad between values, or by a negative width")
    axes = [axis for axis, sides in enumerate(config) if any(sides)]
    x = graph.full(x, eqn.invars[0].aval.shape, axes)
    shape = [low + size + high for size, (low, high, _) in zip(x.shape, config, strict=True)]
    widths = graph.ints(*(low for low, _, _ in config), *(high for _, high, _ in config))
    filling = graph.reshape(filling, ())
    return [graph.add("Pad", [x, widths, filling], tuple(shape), x.dtype)]


@converts("iota")
def _iota(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    shape, axis, dtype = (eqn.params[name] for name in ("shape", "dimension", "dtype"))
    own = tuple(size if each == axis else 1 for each, size in enumerate(shape))
    if is_known(shape[axis]):
        return [Value.of(np.arange(shape[axis], dtype=dtype).reshape(own))]
    zero, one = (Value.of(np.array(number, np.int64)) for number in (0, 1))
    count = graph.add("Squeeze", [graph.side(shape[axis])], (), np.int64)
    numbers = graph.add("Range", [zero, count, one], (shape[axis],), np.int64)
    return [graph.cast(graph.reshape(numbers, own), dtype)]


@converts("gather")
def _gather(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    """Convert a gather of one slice at a known place, as in `x[:, 0]`."""
    x, places = inputs
    whole, shape = eqn.invars[0].aval.shape, eqn.invars[1].aval.shape
    how, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    if how.operand_batching_dims or places.constant is None or len(shape) > 1:
        raise Unsupported("gather at several places, or at computed ones")
    numbers = np.broadcast_to(places.constant, shape)
    parts = [(0, size, 1) for size in sizes]
    for axis, number in zip(how.start_index_map, numbers.tolist(), strict=True):
        if sizes[axis] != whole[axis]:
            start = min(max(number, 0), whole[axis] - sizes[axis])
            parts[axis] = (start, start + sizes[axis], 1)
    part = _cut(graph, x, whole, parts)
    kept = [axis for axis in range(len(whole)) if axis not in how.collapsed_slice_dims]
    return [graph.reshape(part, tuple(part.shape[axis] for axis in kept))]


# Reductions over axes, and over windows of images.


_REDUCTIONS = {
    "reduce_and": "ReduceMin",
    "reduce_max": "ReduceMax",
    "reduce_min": "ReduceMin",
    "reduce_or": "ReduceMax",
    "reduce_prod": "ReduceProd",
    "reduce_sum": "ReduceSum",
}


@converts(*_REDUCTIONS)
def _reduce(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (x,), axes = inputs, eqn.params["axes"]
    if x.dtype == np.bool_:  # repeating rows does not change extremes
        x = graph.cast(x, np.float32)  # which TensorRT accepts, unlike integers
    else:
        x = graph.full(x, eqn.invars[0].aval.shape, axes)
    name = _REDUCTIONS[eqn.primitive.name]
    shape = tuple(size for axis, size in enumerate(x.shape) if axis not in axes)
    # Only the sum takes its axes as an input, since opset 13.
    is_sum = name == "ReduceSum"
    given, fields = ([x, graph.ints(*axes)], {}) if is_sum else ([x], {"axes": list(axes)})
    reduced = graph.add(name, given, shape, x.dtype, keepdims=0, **fields)
    return [graph.cast(reduced, eqn.outvars[0].aval.dtype)]


@converts("argmax")
def _place(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (axis,) = eqn.params["axes"]
    x = graph.full(inputs[0], eqn.invars[0].aval.shape, [axis])
    shape = (*x.shape[:axis], *x.shape[axis + 1 :])
    place = graph.add("ArgMax", [x], shape, np.int64, axis=axis, keepdims=0)
    return [graph.cast(place, eqn.params["index_dtype"])]


@converts("reduce_window_max")
def _largest_of_windows(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    window, padding = eqn.params["window_dimensions"], eqn.params["padding"]
    axes = [axis for axis, size in enumerate(window) if not is_one(size)]
    others = [axis for axis in range(len(window)) if axis not in axes]
    dilated = (*eqn.params["base_dilation"], *eqn.params["window_dilation"])
    if len(others) != 2 or any(map(any, (padding[axis] for axis in others))) or set(dilated) != {1}:
        raise Unsupported("reduce_window_max of other axes than those of an image")
    strides = eqn.params["window_strides"]
    x = graph.full(inputs[0], eqn.invars[0].aval.shape)
    order = [*others, *axes]
    result = eqn.outvars[0].aval.shape
    pooled = graph.add(
        "MaxPool",
        [graph.transpose(x, order)],
        tuple(result[axis] for axis in order),
        x.dtype,
        kernel_shape=[window[axis] for axis in axes],
        strides=[strides[axis] for axis in axes],
        pads=[padding[axis][end] for end in (0, 1) for axis in axes],
    )
    return [graph.transpose(pooled, np.argsort(order).tolist())]


# Matrix products, and convolutions.


@converts("dot_general")
def _product(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (summed_a, summed_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    (shape_a, shape_b), dtype = (var.aval.shape for var in eqn.invars), eqn.outvars[0].aval.dtype
    free_a = [axis for axis in range(len(shape_a)) if axis not in (*summed_a, *batch_a)]
    free_b = [axis for axis in range(len(shape_b)) if axis not in (*summed_b, *batch_b)]
    # MatMul broadcasts the batch; all other axes are needed in full.
    a = graph.cast(graph.full(inputs[0], shape_a, [*free_a, *summed_a]), dtype)
    b = graph.cast(graph.full(inputs[1], shape_b, [*free_b, *summed_b]), dtype)
    a = graph.transpose(a, [*batch_a, *free_a, *summed_a])
    b = graph.transpose(b, [*batch_b, *summed_b, *free_b])
    count = len(batch_a)
    rows, columns = [shape_a[axis] for axis in free_a], [shape_b[axis] for axis in free_b]
    sums = [shape_a[axis] for axis in summed_a]
    a_batch, b_batch = a.shape[:count], b.shape[:count]
    # Rows over several axes are not flattened if they all share one matrix.
    if count or len(columns) != 1 or not rows:
        a = graph.reshape(a, (*a_batch, math.prod(rows), math.prod(sums)))
    elif len(sums) != 1:
        a = graph.reshape(a, (*rows, math.prod(sums)))
    b = graph.reshape(b, (*b_batch, math.prod(sums), math.prod(columns)))
    together: Shape = (*common_shape(a_batch, b_batch), *a.shape[count:-1], b.shape[-1])
    product = graph.add("MatMul", [a, b], together, dtype)
    return [graph.reshape(product, (*together[:count], *rows, *columns))]


@converts("conv_general_dilated")
def _convolution(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    x, kernel = (graph.full(x, var.aval.shape) for x, var in zip(inputs, eqn.invars, strict=True))
    params, order = eqn.params, eqn.params["dimension_numbers"]
    if set(params["lhs_dilation"]) != {1} or params["batch_group_count"] != 1:
        raise Unsupported("conv_general_dilated between pixels, or in groups of images")
    dtype = eqn.outvars[0].aval.dtype
    result = tuple(eqn.outvars[0].aval.shape[axis] for axis in order.out_spec)
    pads = params["padding"]
    convolved = graph.add(
        "Conv",
        [graph.transpose(x, order.lhs_spec), graph.transpose(kernel, order.rhs_spec)],
        result,
        dtype,
        strides=list(params["window_strides"]),
        dilations=list(params["rhs_dilation"]),
        group=params["feature_group_count"],
        pads=[pad[end] for end in (0, 1) for pad in pads],
    )
    return [graph.transpose(convolved, np.argsort(order.out_spec).tolist())]
