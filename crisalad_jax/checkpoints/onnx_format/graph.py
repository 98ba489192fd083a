"""The nodes of an ONNX graph under construction, and the values that pass between them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper

from crisalad_jax.utils.version import VERSION

OPSET = 17
"""Version of ONNX's operator set: all recent engines support it, TensorRT since 8.5."""
_IR_VERSION = 8
"""Version of the file format that came with these operators."""
Size = Any
"""Size of an axis: an integer, or JAX's expression in the symbolic number of images."""
Shape = tuple[Size, ...]


def is_known(size: Size) -> bool:
    """Return whether the size of an axis is a number rather than symbolic."""
    return isinstance(size, int | np.integer)


def is_one(size: Size) -> bool:
    """Return whether the size of an axis is 1, so that a node broadcasts it by itself."""
    return is_known(size) and size == 1


def common_shape(*shapes: Shape) -> Shape:
    """Return the shape to which numpy would broadcast `shapes`, which must be compatible."""
    rank = max(map(len, shapes))
    padded = [(1,) * (rank - len(shape)) + tuple(shape) for shape in shapes]
    columns = zip(*padded, strict=True)
    return tuple(next((size for size in sides if not is_one(size)), 1) for sides in columns)


def _with_side(shape: Shape, axis: int, size: Size) -> Shape:
    return (*shape[:axis], size, *shape[axis + 1 :])


@dataclasses.dataclass(frozen=True)
class Value:
    """An array of the program: a constant, or an output of a node.

    It is broadcast lazily: an axis of `shape` may have size 1 although it is longer in JAX's
    program, if all values along it are the same.
    """

    shape: Shape
    dtype: np.dtype
    name: str = ""
    constant: np.ndarray | None = None
    missing: str = ""
    """Name of the unsupported operation that the value depends on; empty if there is none."""

    @classmethod
    def of(cls, array: Any) -> "Value":
        """Return an array as a constant value."""
        array = np.asarray(array)
        return cls(array.shape, array.dtype, constant=array)


class Graph:
    """An ONNX graph under construction."""

    def __init__(self) -> None:
        """Start without nodes."""
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}
        self.symbolic: dict[Any, str] = {}
        """Names of one-element int64 vectors by the symbolic size that each holds."""
        self._names: dict[Any, str] = {}

    def constant(self, array: np.ndarray) -> str:
        """Add a constant array, and return its name; equal small arrays share a name."""
        small = array.nbytes <= 1024
        key = (str(array.dtype), array.shape, array.tobytes()) if small else id(array)
        if key not in self._names:
            self._names[key] = f"c{len(self.constants)}"
            self.constants[self._names[key]] = array
        return self._names[key]

    def name(self, value: Value) -> str:
        """Return the name of a value; a constant is added to the graph."""
        return value.name if value.constant is None else self.constant(value.constant)

    def ints(self, *numbers: int) -> str:
        """Return the name of a constant int64 vector; nodes take sizes and axes in this form."""
        return self.constant(np.array(numbers, np.int64))

    def node(self, operator: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Append a node with one output, and return the name of its output."""
        name = f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [name], name=name, **attributes))
        return name

    def add(
        self, operator: str, inputs: Sequence[Value | str], shape: Shape, dtype: Any, **fields: Any
    ) -> Value:
        """Append a node with one output, and return the output as a `Value`."""
        names = [each if isinstance(each, str) else self.name(each) for each in inputs]
        return Value(tuple(shape), np.dtype(dtype), self.node(operator, names, **fields))

    def side(self, size: Size) -> str:
        """Return the name of a one-element int64 vector with a size, computed if symbolic."""
        if is_known(size):
            return self.ints(int(size))
        if size not in self.symbolic:  # a multiple of one that exists
            unit = next(unit for unit in self.symbolic if size // unit * unit == size)
            factor = self.side(size // unit)
            self.symbolic[size] = self.node("Mul", [self.symbolic[unit], factor])
        return self.symbolic[size]

    def sides(self, shape: Shape) -> str:
        """Return the name of an int64 vector with the sizes of a shape."""
        if all(map(is_known, shape)):
            return self.ints(*map(int, shape))
        return self.node("Concat", [self.side(size) for size in shape], axis=0)

    def full(self, value: Value, shape: Shape, axes: Sequence[int] | None = None) -> Value:
        """Broadcast a value to `shape`, along all axes or only along `axes`."""
        axes = range(len(shape)) if axes is None else axes
        wanted = tuple(
            size if axis in axes else own
            for axis, (own, size) in enumerate(zip(value.shape, shape, strict=True))
        )
        if wanted == value.shape:
            return value
        if value.constant is not None and all(map(is_known, wanted)):
            return Value.of(np.broadcast_to(value.constant, wanted))
        # A side of 1 in Expand changes nothing: only sides that grow need their size at run time.
        grown = [s if is_one(o) else 1 for o, s in zip(value.shape, wanted, strict=True)]
        return self.add("Expand", [value, self.sides(tuple(grown))], wanted, value.dtype)

    def reshape(self, value: Value, shape: Shape) -> Value:
        """Reshape a value that is not lazily broadcast along any axis that changes."""
        if tuple(value.shape) == tuple(shape):
            return value
        if value.constant is not None:
            return Value.of(value.constant.reshape(shape))
        if sum(not is_known(size) for size in shape) > 1:
            numbers = self.sides(shape)
        else:
            numbers = self.ints(*(int(size) if is_known(size) else -1 for size in shape))
        return self.add("Reshape", [value, numbers], shape, value.dtype)

    def transpose(self, value: Value, axes: Sequence[int]) -> Value:
        """Reorder the axes of a value, as `np.transpose` does."""
        if list(axes) == list(range(len(axes))):
            return value
        if value.constant is not None:
            return Value.of(value.constant.transpose(axes))
        shape = tuple(value.shape[axis] for axis in axes)
        return self.add("Transpose", [value], shape, value.dtype, perm=list(axes))

    def cast(self, value: Value, dtype: Any) -> Value:
        """Convert a value to another type."""
        if value.dtype == np.dtype(dtype):
            return value
        if value.constant is not None:
            return Value.of(value.constant.astype(dtype))
        return self.add("Cast", [value], value.shape, dtype, to=tensor_type(dtype))

    def slice(self, value: Value, ranges: Mapping[int, tuple[int, int, int]]) -> Value:
        """Slice a value; `ranges` has (start, end, step) for each axis to slice."""
        ranges = {axis: cut for axis, cut in ranges.items() if cut != (0, value.shape[axis], 1)}
        if not ranges:
            return value
        if value.constant is not None:
            cuts = [slice(*ranges.get(axis, (None,))) for axis in range(value.constant.ndim)]
            return Value.of(value.constant[tuple(cuts)])
        shape = list(value.shape)
        for axis, cut in ranges.items():
            shape[axis] = len(range(*cut))
        starts, ends, steps = zip(*ranges.values(), strict=True)
        vectors = [self.ints(*each) for each in (starts, ends, tuple(ranges), steps)]
        return self.add("Slice", [value, *vectors], tuple(shape), value.dtype)

    def concatenate(self, values: Sequence[Value], axis: int) -> Value:
        """Join values along an axis on which none is lazily broadcast; other axes are broadcast."""
        values = [value for value in values if value.shape[axis] != 0] or values[:1]
        shape = common_shape(*(_with_side(v.shape, axis, 1) for v in values))
        parts = [self.full(v, _with_side(shape, axis, v.shape[axis])) for v in values]
        shape = _with_side(shape, axis, sum(v.shape[axis] for v in values))
        if all(part.constant is not None for part in parts):
            return Value.of(np.concatenate([part.constant for part in parts], axis))  # type: ignore
        return self.add("Concat", parts, shape, parts[0].dtype, axis=axis)

    def model(
        self, inputs: Sequence[Value], outputs: Sequence[tuple[str, Value]], words: str
    ) -> onnx.ModelProto:
        """Return the ONNX model of the graph, with only the nodes that the named outputs need.

        `words` is the model's description. `write_onnx` adds the arrays of `constants`.
        """
        for name, value in outputs:
            self.nodes.append(helper.make_node("Identity", [self.name(value)], [name]))
        needed, nodes = {name for name, _ in outputs}, []
        for node in reversed(self.nodes):
            if not needed.isdisjoint(node.output):
                nodes.append(node)
                needed.update(node.input)
        self.constants = {name: each for name, each in self.constants.items() if name in needed}
        graph = helper.make_graph(
            nodes[::-1],
            "describe",
            [_info(value.name, value) for value in inputs],
            [_info(name, value) for name, value in outputs],
            doc_string=words,
        )
        opset = helper.make_opsetid("", OPSET)
        return helper.make_model(
            graph,
            opset_imports=[opset],
            ir_version=_IR_VERSION,
            producer_name="crisalad-jax",
            producer_version=VERSION,
        )


def tensor_type(dtype: Any) -> int:
    """Return the number that ONNX has for a numpy type."""
    return helper.np_dtype_to_tensor_dtype(np.dtype(dtype))


def _info(name: str, value: Value) -> onnx.ValueInfoProto:
    shape = [int(size) if is_known(size) else str(size) for size in value.shape]
    return helper.make_tensor_value_info(name, tensor_type(value.dtype), shape)
