"""Products of matrices, and convolutions."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.onnx_format.graph import Graph, Shape, Value, common_shape
from crisalad_jax.checkpoints.onnx_format.registry import Unsupported, converts


@converts("dot_general")
def _product(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (summed_a, summed_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    shapes = [var.aval.shape for var in eqn.invars]
    free_a, free_b = (
        [axis for axis in range(len(shape)) if axis not in (*summed, *batch)]
        for shape, summed, batch in zip(
            shapes, (summed_a, summed_b), (batch_a, batch_b), strict=True
        )
    )
    # MatMul broadcasts the batch; all other axes are needed as they are.
    a, b = (
        graph.full(x, shape, [axis for axis in range(len(shape)) if axis not in batch])
        for x, shape, batch in zip(inputs, shapes, (batch_a, batch_b), strict=True)
    )
    dtype = eqn.outvars[0].aval.dtype
    a, b = graph.cast(a, dtype), graph.cast(b, dtype)
    a = graph.transpose(a, [*batch_a, *free_a, *summed_a])
    b = graph.transpose(b, [*batch_b, *summed_b, *free_b])
    count = len(batch_a)
    rows, columns = ([shapes[i][axis] for axis in free] for i, free in ((0, free_a), (1, free_b)))
    sums = [shapes[0][axis] for axis in summed_a]
    a_batch, b_batch = a.shape[:count], b.shape[:count]
    # Rows in several axes stay so where one matrix is common to all of them.
    if count or len(columns) != 1 or not rows:
        a = graph.reshape(a, (*a_batch, _count(rows), _count(sums)))
    elif len(sums) != 1:
        a = graph.reshape(a, (*rows, _count(sums)))
    b = graph.reshape(b, (*b_batch, _count(sums), _count(columns)))
    together: Shape = (*common_shape(a_batch, b_batch), *a.shape[count:-1], b.shape[-1])
    product = graph.add("MatMul", [a, b], together, dtype)
    return [graph.reshape(product, (*together[:count], *rows, *columns))]


def _count(sides: Sequence[Any]) -> Any:
    return math.prod(sides)


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
