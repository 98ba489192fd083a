"""Walk through a traced program (a jaxpr), and convert it equation by equation."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import Jaxpr, Literal

from crisalad_jax.checkpoints.onnx_format.graph import Graph, Value, is_known
from crisalad_jax.checkpoints.onnx_format.operators import CONVERTERS, Unsupported, stacked

_CALLED = ("jaxpr", "call_jaxpr")
"""Parameters of primitives that call a program once: `jax.jit`, remat, custom gradients."""


def convert(graph: Graph, traced: Any, inputs: Sequence[Value]) -> list[Value]:
    """Append the ONNX nodes of a traced program to a graph.

    Args:
        graph: the graph to append to.
        traced: the program, from `jax.make_jaxpr`.
        inputs: the program's arguments in order; some may be constants.

    Returns:
        The outputs; `Value.missing` names the unsupported primitive that one depends on, if any.
    """
    return _run(graph, traced.jaxpr, [Value.of(each) for each in traced.consts], inputs)


def _run(
    graph: Graph, program: Jaxpr, constants: Sequence[Value], inputs: Sequence[Value]
) -> list[Value]:
    values = dict(zip((*program.constvars, *program.invars), (*constants, *inputs), strict=True))

    def read(atom: Any) -> Value:
        if isinstance(atom, Literal):
            aval: Any = atom.aval
            return Value.of(np.asarray(atom.val, aval.dtype))
        return values[atom]

    for eqn in program.eqns:
        given = [read(atom) for atom in eqn.invars]
        values.update(zip(eqn.outvars, _equation(graph, given, eqn), strict=True))
    return [read(atom) for atom in program.outvars]


def _equation(graph: Graph, inputs: list[Value], eqn: Any) -> list[Value]:
    """Convert an equation; an unsupported one is recorded, and raised only if it is needed."""
    name = eqn.primitive.name
    called = next((eqn.params[key] for key in _CALLED if key in eqn.params), None)
    try:
        if name == "scan":
            return _unrolled(graph, inputs, eqn)
        if name == "cond" and inputs[0].constant is not None:
            which = int(inputs[0].constant.item())
            branch = eqn.params["branches"][min(max(which, 0), len(eqn.params["branches"]) - 1)]
            return convert(graph, branch, inputs[1:])
        if called is not None and not name.startswith(("while", "custom_linear")):
            constants = [Value.of(each) for each in getattr(called, "consts", ())]
            return _run(graph, getattr(called, "jaxpr", called), constants, inputs)
        if missing := next((value.missing for value in inputs if value.missing), ""):
            raise Unsupported(missing)
        if all(0 in var.aval.shape for var in eqn.outvars):
            return [_nothing(var.aval) for var in eqn.outvars]
        return CONVERTERS.get(name, _folded)(graph, inputs, eqn)
    except Unsupported as error:
        nothing = np.dtype(np.float32)  # a placeholder, as a key's type is not NumPy's
        return [Value(var.aval.shape, nothing, missing=str(error)) for var in eqn.outvars]


def _nothing(aval: Any) -> Value:
    """Return an empty array without symbolic sides, which engines could not infer."""
    return Value.of(np.zeros([s if is_known(s) else 1 for s in aval.shape], aval.dtype))


def _folded(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
    """Compute any primitive whose inputs are all constants."""
    arrays = [value.constant for value in inputs]
    wholes = [var.aval.shape for var in eqn.invars]
    known = all(is_known(size) for shape in wholes for size in shape)
    plain = all(isinstance(var.aval.dtype, np.dtype) for var in eqn.outvars)  # no keys
    if any(array is None for array in arrays) or not (known and plain and inputs):
        raise Unsupported(eqn.primitive.name)
    full = [np.broadcast_to(a, shape) for a, shape in zip(arrays, wholes, strict=True)]  # type: ignore
    results = eqn.primitive.bind(*map(np.asarray, full), **eqn.params)
    return [Value.of(each) for each in (results if eqn.primitive.multiple_results else [results])]


def _unrolled(graph: Graph, inputs: list[Value], eqn: Any) -> list[Value]:
    """Unroll a loop of known length, so that its slices of weights are constants."""
    params, length = eqn.params, eqn.params["length"]
    body = params["jaxpr"]
    # Count by ranks, because the parameters with the counts differ between versions of JAX: carried
    # values come first, and stacked ones have one axis less inside the loop.
    count = sum(map(operator.eq, _ranks(eqn.outvars), _ranks(body.jaxpr.outvars)))
    stacked = sum(map(operator.gt, _ranks(eqn.invars), _ranks(body.jaxpr.invars)))
    first = len(inputs) - stacked
    fixed, carry, rows = inputs[: first - count], inputs[first - count : first], inputs[first:]
    if not is_known(length):
        raise Unsupported("scan over the images")
    order = range(length)[::-1] if params["reverse"] else range(length)
    results: dict[int, list[Value]] = {}
    for number in order:
        own = [_row(graph, x, number) for x in rows]
        outputs = convert(graph, body, [*fixed, *carry, *own])
        carry, results[number] = outputs[:count], outputs[count:]
    turns = (results[number] for number in range(length))
    return [*carry, *(_stack(graph, each) for each in zip(*turns, strict=True))]


def _ranks(variables: Sequence[Any]) -> list[int]:
    return [each.aval.ndim for each in variables]


def _row(graph: Graph, x: Value, number: int) -> Value:
    if x.missing:
        return x
    start = 0 if x.shape[0] == 1 else number
    part = graph.slice(x, {0: (start, start + 1, 1)})
    return graph.reshape(part, part.shape[1:])


def _stack(graph: Graph, values: Sequence[Value]) -> Value:
    broken = next((value for value in values if value.missing), None)
    return broken or stacked(graph, values, 0)
