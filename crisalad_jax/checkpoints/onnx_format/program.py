"""Write a function of images as an ONNX program."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from crisalad_jax.checkpoints.engines import DESCRIPTORS, IMAGES
from crisalad_jax.checkpoints.onnx_format.convert import convert
from crisalad_jax.checkpoints.onnx_format.graph import OPSET as OPSET
from crisalad_jax.checkpoints.onnx_format.graph import Graph, Value, is_known, place_constants
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import told_of


def onnx_graph(
    run: Callable[..., Any],
    weights: Mapping[str, Any],
    images: jax.ShapeDtypeStruct,
) -> tuple[Graph, Value, Value]:
    """Convert a function of weights and images, with the weights as constants.

    Args:
        run: the function, of a dictionary of arrays and images.
        weights: the arrays.
        images: shape and type of the images; the number of them may be symbolic.

    Returns:
        (graph, images, descriptors).

    Raises:
        InputError: the function has an operation that no operator of ONNX is made of; named.
    """
    traced = jax.make_jaxpr(run)(weights, images)
    graph = Graph()
    value = Value(images.shape, np.dtype(images.dtype), IMAGES)
    count = images.shape[0]
    if not is_known(count):
        (name,) = graph.node("Shape", [IMAGES], start=0, end=1)
        graph.symbolic[count] = name
    arguments = [Value.of(leaf) for leaf in jax.tree.leaves(weights)]
    (descriptors,) = convert(graph, traced, [*arguments, value])
    if descriptors.missing:
        raise InputError(
            f"format onnx: found the operation {descriptors.missing}, expected a model of "
            "operations that ONNX has (docs/export.md)"
        )
    return graph, value, graph.full(descriptors, traced.out_avals[0].shape)


def write_onnx(
    path: pathlib.Path,
    run: Callable[..., Any],
    weights: Mapping[str, Any],
    images: jax.ShapeDtypeStruct,
    *,
    words: str,
    beside: bool,
) -> None:
    """Write a function of weights and images as an ONNX program.

    Args:
        path: the file.
        run: as `onnx_graph`.
        weights: as `onnx_graph`.
        images: as `onnx_graph`.
        words: what the file says of itself.
        beside: whether large weights go to a file of its own, `path` with .data appended.

    Raises:
        InputError: as `onnx_graph`, or the disk is full.
    """
    graph, value, descriptors = onnx_graph(run, weights, images)
    model = graph.model([value], [(DESCRIPTORS, descriptors)], words)
    data = path.with_name(f"{path.name}.data")
    places = place_constants(model, graph.constants, data.name if beside else None)
    with told_of(path):
        if beside:
            write_constants(data, places)
        path.write_bytes(model.SerializeToString(deterministic=True))


def write_constants(path: pathlib.Path, places: Sequence[tuple[int, np.ndarray]]) -> None:
    """Write arrays to a file, each at its place."""
    with path.open("wb") as file:
        for start, array in places:
            file.seek(start)
            file.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
