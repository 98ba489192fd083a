"""Write a function of weights and images as an ONNX program."""

import math
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import onnx
from onnx import external_data_helper, numpy_helper

from crisalad_jax.checkpoints.engines import NotExportableError
from crisalad_jax.checkpoints.onnx_format.convert import convert
from crisalad_jax.checkpoints.onnx_format.graph import OPSET as OPSET
from crisalad_jax.checkpoints.onnx_format.graph import Graph, Value, is_known
from crisalad_jax.utils.files import wrap_os_errors

_PAGE = 4096
"""Alignment in bytes of the arrays next to a program, so that they can be memory-mapped."""


def write_onnx(
    path: pathlib.Path,
    run: Callable[..., Any],
    weights: Mapping[str, Any],
    inputs: Mapping[str, jax.ShapeDtypeStruct],
    output: str,
    *,
    words: str,
    external: bool,
) -> list[str]:
    """Write a function of weights and other arrays as an ONNX program.

    The weights are constants of the program.

    Args:
        path: the .onnx file.
        run: the function, whose arguments are `weights` and then the inputs in order.
        weights: the weights by name.
        inputs: shapes and types of the inputs by name. The first axis is that of the images, whose
            number may be symbolic.
        output: name of the output.
        words: description to store in the file.
        external: whether large weights go to a separate file, `path` with .data appended.

    Returns:
        Names of the nodes (matrix products and convolutions) that multiply by weights.

    Raises:
        InputError: the function has an operation that cannot be converted, which the message names;
            or the file cannot be written.
    """
    traced: Any = jax.make_jaxpr(run)(weights, *inputs.values())
    graph = Graph()
    values = [Value(each.shape, np.dtype(each.dtype), name) for name, each in inputs.items()]
    count = values[0].shape[0]
    if not is_known(count):
        graph.symbolic[count] = graph.node("Shape", [values[0].name], start=0, end=1)
    arguments = [Value.of(leaf) for leaf in jax.tree.leaves(weights)]
    (result,) = convert(graph, traced, [*arguments, *values])
    if result.missing:
        raise NotExportableError(
            f"format onnx or openvino: found the operation {result.missing}, which is not "
            "converted, expected format stablehlo or a model without it (docs/export.md)"
        )
    result = graph.full(result, traced.out_avals[0].shape)
    model = graph.model(values, [(output, result)], words)
    end = 0
    for name, array in graph.constants.items():
        # A transposed view is written in the order of its axes.
        tensor = numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        if external and array.nbytes >= _PAGE:
            external_data_helper.set_external_data(tensor, f"{path.name}.data", offset=end)
            end += math.ceil(array.nbytes / _PAGE) * _PAGE
        model.graph.initializer.append(tensor)
    products = _products(model, graph.constants, [np.asarray(each) for each in weights.values()])
    with wrap_os_errors(path):
        if external:  # even if all arrays are small
            path.with_name(f"{path.name}.data").touch()
        onnx.save_model(model, path)
    return products


def _products(
    model: onnx.ModelProto, constants: Mapping[str, np.ndarray], weights: Sequence[np.ndarray]
) -> list[str]:
    """List the products whose second factor is part of a weight, not a computed array."""
    return [
        node.name
        for node in model.graph.node
        if node.op_type in ("MatMul", "Conv")
        and node.input[1] in constants
        and any(np.may_share_memory(constants[node.input[1]], weight) for weight in weights)
    ]
