"""Primitives that reduce axes, and windows of images."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.onnx_format.graph import Graph, Value, is_one
from crisalad_jax.checkpoints.onnx_format.registry import Unsupported, converts

_BY_ATTRIBUTE = {"reduce_max": "ReduceMax", "reduce_min": "ReduceMin", "reduce_prod": "ReduceProd"}


def _whole(graph: Graph, inputs: Sequence[Value], eqn: Any, axes: Sequence[int]) -> Value:
    return graph.full(inputs[0], eqn.invars[0].aval.shape, axes)


@converts("reduce_sum")
def _sum(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    axes = eqn.params["axes"]
    x = _whole(graph, inputs, eqn, axes)
    shape = tuple(size for axis, size in enumerate(x.shape) if axis not in axes)
    return [graph.add("ReduceSum", [x, graph.ints(*axes)], shape, x.dtype, keepdims=0)]


def _extreme(graph: Graph, x: Value, name: str, axes: Sequence[int]) -> Value:
    shape = tuple(size for axis, size in enumerate(x.shape) if axis not in axes)
    # Repeated rows have their own extremes.
    return graph.add(_BY_ATTRIBUTE[name], [x], shape, x.dtype, axes=list(axes), keepdims=0)


@converts(*_BY_ATTRIBUTE)
def _reduce(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    axes = eqn.params["axes"]
    return [_extreme(graph, _whole(graph, inputs, eqn, axes), eqn.primitive.name, axes)]


@converts("reduce_and", "reduce_or")
def _logic(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    name = {"reduce_and": "reduce_min", "reduce_or": "reduce_max"}[eqn.primitive.name]
    x = graph.cast(inputs[0], np.float32)  # which TensorRT takes, unlike whole numbers
    return [graph.cast(_extreme(graph, x, name, eqn.params["axes"]), np.bool_)]


@converts("argmax", "argmin")
def _place(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (axis,) = eqn.params["axes"]
    x = _whole(graph, inputs, eqn, [axis])
    shape = (*x.shape[:axis], *x.shape[axis + 1 :])
    operator = {"argmax": "ArgMax", "argmin": "ArgMin"}[eqn.primitive.name]
    place = graph.add(operator, [x], shape, np.int64, axis=axis, keepdims=0)
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
    x = _whole(graph, inputs, eqn, range(len(window)))
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
