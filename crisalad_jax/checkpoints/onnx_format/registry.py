"""The functions that convert primitives, by the primitives' names."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from crisalad_jax.checkpoints.onnx_format.graph import Graph, Value


class Unsupported(Exception):
    """A primitive, or a use of one, that has no operator; the message names it."""


class Converter(Protocol):
    """A function of the graph, the inputs and JAX's equation to its outputs."""

    def __call__(self, graph: Graph, inputs: Sequence[Value], eqn: Any) -> list[Value]:
        """Append the nodes."""
        ...


CONVERTERS: dict[str, Converter] = {}
"""Converters by primitive."""


def converts(*names: str) -> Callable[[Converter], Converter]:
    """Register a converter of primitives."""

    def register(converter: Converter) -> Converter:
        CONVERTERS.update(dict.fromkeys(names, converter))
        return converter

    return register
