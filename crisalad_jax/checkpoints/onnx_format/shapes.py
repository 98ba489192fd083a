"""Primitives that move numbers and compute none."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.onnx_format.graph import Graph, Shape, Value, is_known, is_one
from crisalad_jax.checkpoints.onnx_format.registry import Unsupported, converts


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
    if eqn.params.get("dimensions") is not None and eqn.primitive.name == "reshape":
        raise Unsupported("reshape of permuted axes")
    own = _with_other_ones(x.shape, before, after)
    return [graph.reshape(x, own) if own else graph.reshape(graph.full(x, before), after)]


def _with_other_ones(own: Shape, before: Shape, after: Shape) -> Shape | None:
    """Return the lazy shape of an array that gains or loses sides of 1 alone; else None."""
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
    return [_cut(graph, inputs[0], eqn.invars[0].aval.shape, starts, ends, steps)]


def _cut(
    graph: Graph,
    x: Value,
    whole: Shape,
    starts: Sequence[Any],
    ends: Sequence[Any],
    steps: Sequence[int],
) -> Value:
    """Take a part of each axis, where the array is not broadcast along it."""
    cuts = {}
    for axis, cut in enumerate(zip(starts, ends, steps, strict=True)):
        start, end, step = cut
        if (is_known(start) and start == 0 and end == whole[axis] and step == 1) or is_one(
            x.shape[axis]
        ):
            continue
        if not all(map(is_known, cut)):
            raise Unsupported("slice of some of the images")
        cuts[axis] = tuple(map(int, cut))
    return graph.slice(x, cuts)


@converts("split")
def _split(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    (x,), axis, sizes = inputs, eqn.params["axis"], eqn.params["sizes"]
    parts, start = [], 0
    for size in sizes:
        lazy = is_one(x.shape[axis])
        parts.append(x if lazy else graph.slice(x, {axis: (start, start + size, 1)}))
        start += size
    return parts


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
    """Join values along a new axis."""
    parts = [graph.reshape(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in values]
    return graph.concatenate(parts, axis)


@converts("pad")
def _pad(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    x, filling = inputs
    config = eqn.params["padding_config"]
    if any(inside or low < 0 or high < 0 for low, high, inside in config):
        raise Unsupported("pad between numbers, or by less than none")
    axes = [axis for axis, sides in enumerate(config) if any(sides)]
    x = graph.full(x, eqn.invars[0].aval.shape, axes)
    shape = [
        low + size + high if axis in axes else size
        for axis, (size, (low, high, _)) in enumerate(zip(x.shape, config, strict=True))
    ]
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


@converts("dim_as_value")
def _side(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    number = graph.add("Squeeze", [graph.side(eqn.params["dim"])], (), np.int64)
    return [graph.cast(number, eqn.outvars[0].aval.dtype)]


@converts("dynamic_slice")
def _dynamic_slice(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    x, *places = inputs
    whole, sizes = eqn.invars[0].aval.shape, eqn.params["slice_sizes"]
    if any(place.constant is None for place in places):
        raise Unsupported("dynamic_slice at a place that is computed")
    starts = [
        0 if size == side else min(max(int(place.constant.item()), 0), side - size)  # type: ignore
        for place, size, side in zip(places, sizes, whole, strict=True)
    ]
    ends = [start + size for start, size in zip(starts, sizes, strict=True)]
    return [_cut(graph, x, whole, starts, ends, [1] * len(starts))]


@converts("gather")
def _gather(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    x, places = inputs
    whole, shape = eqn.invars[0].aval.shape, eqn.invars[1].aval.shape
    how, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    if how.operand_batching_dims or places.constant is None or len(shape) > 1:
        return [_take(graph, x, places, eqn)]
    numbers = np.broadcast_to(places.constant, shape)
    starts, ends = [0] * len(whole), list(sizes)
    for axis, number in zip(how.start_index_map, numbers.tolist(), strict=True):
        if sizes[axis] != whole[axis]:
            starts[axis] = min(max(number, 0), whole[axis] - sizes[axis])
            ends[axis] = starts[axis] + sizes[axis]
    part = _cut(graph, x, whole, starts, ends, [1] * len(whole))
    kept = [axis for axis in range(len(whole)) if axis not in how.collapsed_slice_dims]
    return [graph.reshape(part, tuple(part.shape[axis] for axis in kept))]


def _take(graph: Graph, x: Value, places: Value, eqn: Any) -> Value:
    """Convert a gather that takes whole slices of one axis."""
    whole, shape = eqn.invars[0].aval.shape, eqn.invars[1].aval.shape
    how, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    axes = how.start_index_map
    others = [size for axis, size in enumerate(sizes) if axis not in axes]
    fits = (
        len(axes) == 1
        and how.collapsed_slice_dims == axes
        and not how.operand_batching_dims
        and others == [size for axis, size in enumerate(whole) if axis not in axes]
        and is_known(whole[axes[0]])
    )
    if not fits:
        raise Unsupported("gather at places that are computed, of several axes")
    (axis,) = axes
    x, places = graph.full(x, whole, [axis]), graph.full(places, shape)
    indices = graph.reshape(places, shape[:-1])
    # A place beyond the ends is the end's, as JAX's programs of indices have it.
    least, most = (Value.of(np.array(each, indices.dtype)) for each in (0, whole[axis] - 1))
    if indices.constant is not None:
        indices = Value.of(np.clip(indices.constant, 0, whole[axis] - 1))
    else:
        indices = graph.add("Max", [indices, least], indices.shape, indices.dtype)
        indices = graph.add("Min", [indices, most], indices.shape, indices.dtype)
    taken_shape = (*x.shape[:axis], *indices.shape, *x.shape[axis + 1 :])
    taken = graph.add("Gather", [x, indices], taken_shape, x.dtype, axis=axis)
    # There the places' axes stand where the axis was; JAX says where the others go.
    count, rank = len(indices.shape), len(taken_shape)
    of_places = iter(range(axis, axis + count))
    of_others = iter([each for each in range(rank) if not axis <= each < axis + count])
    order = [next(of_others if each in how.offset_dims else of_places) for each in range(rank)]
    return graph.transpose(taken, order)
