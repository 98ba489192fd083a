"""Primitives that work number by number, which nodes broadcast as numpy does."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.onnx_format.graph import Graph, Shape, Value, common_shape
from crisalad_jax.checkpoints.onnx_format.registry import Unsupported, converts

PLAIN = {
    "abs": "Abs",
    "add": "Add",
    "add_any": "Add",
    "ceil": "Ceil",
    "cos": "Cos",
    "div": "Div",
    "eq": "Equal",
    "erf": "Erf",
    "exp": "Exp",
    "floor": "Floor",
    "ge": "GreaterOrEqual",
    "gt": "Greater",
    "le": "LessOrEqual",
    "log": "Log",
    "logistic": "Sigmoid",
    "lt": "Less",
    "max": "Max",
    "min": "Min",
    "mul": "Mul",
    "neg": "Neg",
    "pow": "Pow",
    "sign": "Sign",
    "sin": "Sin",
    "sqrt": "Sqrt",
    "sub": "Sub",
    "tanh": "Tanh",
}
"""Operators by the primitives that they are the same as."""
_LOGIC = {"and": "And", "or": "Or", "not": "Not", "xor": "Xor"}


def _plain(operator: str) -> Callable[..., Value]:
    def convert(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
        return graph.add(operator, inputs, shape, dtype)

    return convert


def elementwise(*names: str) -> Callable[[Callable[..., Value]], Callable[..., Value]]:
    """Register a function of inputs, the shape that they are broadcast to, and the result's type.

    Constants are computed by JAX itself.
    """

    def register(function: Callable[..., Value]) -> Callable[..., Value]:
        def convert(graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
            shape = common_shape(*(value.shape for value in inputs))
            if all(value.constant is not None for value in inputs):
                arrays = [np.broadcast_to(value.constant, shape) for value in inputs]  # type: ignore
                return [Value.of(eqn.primitive.bind(*map(np.asarray, arrays), **eqn.params))]
            dtype = eqn.outvars[0].aval.dtype
            return [function(graph, inputs, shape, dtype, **_given(function, eqn.params))]

        converts(*names)(convert)
        return function

    return register


def _given(function: Callable[..., Value], params: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters that a function asks for by keyword."""
    wanted = getattr(function, "__kwdefaults__", None) or {}
    return {name: params[name] for name in wanted}


for _primitive, _operator in PLAIN.items():
    elementwise(_primitive)(_plain(_operator))


def _logic(operator: str) -> Callable[..., Value]:
    def convert(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
        if np.dtype(dtype) != np.bool_:
            raise Unsupported(f"{operator.lower()} of {np.dtype(dtype)}")
        return graph.add(operator, inputs, shape, dtype)

    return convert


for _primitive, _operator in _LOGIC.items():
    elementwise(_primitive)(_logic(_operator))


@elementwise("ne")
def _ne(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    return graph.add("Not", [graph.add("Equal", inputs, shape, dtype)], shape, dtype)


@elementwise("square")
def _square(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    return graph.add("Mul", [*inputs, *inputs], shape, dtype)


@elementwise("rsqrt")
def _rsqrt(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    one = Value.of(np.array(1, dtype))
    return graph.add("Div", [one, graph.add("Sqrt", inputs, shape, dtype)], shape, dtype)


@elementwise("integer_pow")
def _integer_pow(
    graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any, *, y: int = 2
) -> Value:
    if y == 2:
        return graph.add("Mul", [*inputs, *inputs], shape, dtype)
    return graph.add("Pow", [*inputs, Value.of(np.array(y, dtype))], shape, dtype)


@elementwise("exp2")
def _exp2(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    return graph.add("Pow", [Value.of(np.array(2, dtype)), *inputs], shape, dtype)


@elementwise("log1p")
def _log1p(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    one = Value.of(np.array(1, dtype))
    return graph.add("Log", [graph.add("Add", [*inputs, one], shape, dtype)], shape, dtype)


@elementwise("expm1")
def _expm1(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    one = Value.of(np.array(1, dtype))
    return graph.add("Sub", [graph.add("Exp", inputs, shape, dtype), one], shape, dtype)


@elementwise("is_finite")
def _is_finite(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    # Only finite numbers are 0 times themselves; and no engine lacks these two.
    zero = Value.of(np.array(0, inputs[0].dtype))
    nothing = graph.add("Mul", [*inputs, zero], shape, inputs[0].dtype)
    return graph.add("Equal", [nothing, zero], shape, dtype)


@elementwise("select_n")
def _select(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    which, *cases = inputs
    if which.dtype != np.bool_ or len(cases) != 2:
        raise Unsupported("select_n of more than two cases")
    return graph.add("Where", [which, cases[1], cases[0]], shape, dtype)


@elementwise("clamp")
def _clamp(graph: Graph, inputs: Sequence[Value], shape: Shape, dtype: Any) -> Value:
    least, x, most = inputs
    return graph.add("Min", [graph.add("Max", [x, least], shape, dtype), most], shape, dtype)
