"""Write a function of weights and images as an ONNX program."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import onnx

from crisalad_jax.checkpoints.onnx_format.convert import convert
from crisalad_jax.checkpoints.onnx_format.graph import OPSET as OPSET
from crisalad_jax.checkpoints.onnx_format.graph import Graph, Value, is_known, place_constants
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import wrap_os_errors


def onnx_graph(
    run: Callable[..., Any],
    weights: Mapping[str, Any],
    inputs: Mapping[str, jax.ShapeDtypeStruct],
) -> tuple[Graph, list[Value], Value]:
    """Convert a function of weights and other arrays, with the weights as constants.

    Args:
        run: the function, of a dictionary of arrays and the inputs in their order.
        weights: the arrays.
        inputs: shapes and types of the inputs by name. Their first sides are the number of images,
            which may be symbolic.

    Returns:
        (graph, inputs, output).

    Raises:
        InputError: the function has an operation that no operator of ONNX is made of; named.
    """
    traced: Any = jax.make_jaxpr(run)(weights, *inputs.values())
    graph = Graph()
    values = [Value(each.shape, np.dtype(each.dtype), name) for name, each in inputs.items()]
    count = values[0].shape[0]
    if not is_known(count):
        (graph.symbolic[count],) = graph.node("Shape", [values[0].name], start=0, end=1)
    arguments = [Value.of(leaf) for leaf in jax.tree.leaves(weights)]
    (output,) = convert(graph, traced, [*arguments, *values])
    if output.missing:
        raise InputError(
            f"format onnx or openvino: found the operation {output.missing}, which is not "
            "converted, expected format stablehlo or a model without it (docs/export.md)"
        )
    return graph, values, graph.full(output, traced.out_avals[0].shape)


def write_onnx(
    path: pathlib.Path,
    run: Callable[..., Any],
    weights: Mapping[str, Any],
    inputs: Mapping[str, jax.ShapeDtypeStruct],
    output: str,
    *,
    words: str,
    beside: bool,
) -> list[str]:
    """Write a function of weights and other arrays as an ONNX program.

    Args:
        path: the file.
        run: as `onnx_graph`.
        weights: as `onnx_graph`.
        inputs: as `onnx_graph`.
        output: name of the output.
        words: what the file says of itself.
        beside: whether large weights go to a file of its own, `path` with .data appended.

    Returns:
        Names of the nodes that multiply by weights.

    Raises:
        InputError: as `onnx_graph`, or the disk is full.
    """
    graph, values, result = onnx_graph(run, weights, inputs)
    model = graph.model(values, [(output, result)], words)
    data = path.with_name(f"{path.name}.data")
    places = place_constants(model, graph.constants, data.name if beside else None)
    with wrap_os_errors(path):
        if beside:
            write_constants(data, places)
        path.write_bytes(model.SerializeToString(deterministic=True))
    return _products(model, graph.constants, [np.asarray(each) for each in weights.values()])


def _products(
    model: onnx.ModelProto, constants: Mapping[str, np.ndarray], weights: Sequence[np.ndarray]
) -> list[str]:
    """Name the products whose second factor is a part of a weight, and not computed or made."""
    return [
        node.name
        for node in model.graph.node
        if node.op_type in ("MatMul", "Conv")
        and node.input[1] in constants
        and any(np.may_share_memory(constants[node.input[1]], weight) for weight in weights)
    ]


def write_constants(path: pathlib.Path, places: Sequence[tuple[int, np.ndarray]]) -> None:
    """Write arrays to a file, each at its place."""
    with path.open("wb") as file:
        for start, array in places:
            file.seek(start)
            file.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
