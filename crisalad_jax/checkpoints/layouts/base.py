"""Layouts: a public checkpoint's names of its parts, and how a model is inferred from them."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.layouts.forms import SAME, Absent, Entry, Extra
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves

State = Mapping[str, np.ndarray]
Lines = Iterator[Entry | Extra | Absent]
Stored = Literal["torch", "safetensors", "matlab"]


@dataclasses.dataclass(frozen=True)
class Layout:
    """The names of parts in the checkpoints of one family."""

    name: str
    holds: str
    """Description of the family's files."""
    accepts: Callable[[ModelConfig], str | None]
    """Function that returns None for a model that the layout can hold, else what it expects."""
    lines: Callable[[ModelConfig], Lines]
    """Function that yields the table, in the public order."""
    detects: Callable[[State], bool] = lambda state: False
    """Function that returns whether a state's names are of this family."""
    infer: Callable[[State], ModelConfig] | None = None
    """Function that makes the configuration from names and shapes."""
    module: str = ""
    """Prefix of all names, as torch's DataParallel adds it."""
    under: str | None = None
    """Key of the file's dictionary that holds the state; None: the file is the state."""
    stored: Stored = "torch"
    """Kind of the family's files."""
    bare: bool = False
    """Whether a file is one tensor by itself, which is a part of a model."""
    has_backbone: Callable[[State], bool] = lambda state: False
    """Function that returns whether a state has the family's backbone, with or without a head."""
    has_head: Callable[[State], bool] = lambda state: False
    """Function that returns whether a state has the family's head, with or without a backbone."""


LAYOUTS: dict[str, Layout] = {}
"""Layouts by name, in the order in which they try to detect a state."""
HEADS: dict[str, Callable[[Any], Iterator[Entry]]] = {}
"""Tables of public checkpoints' names, by the name of the aggregator."""


def register_layout(layout: Layout) -> None:
    """Register a layout under its name."""
    LAYOUTS[layout.name] = layout


def register_head(name: str) -> Callable[[Any], Any]:
    """Return a decorator that registers the table of an aggregator's names."""

    def decorate(lines: Callable[[Any], Iterator[Entry]]) -> Any:
        HEADS[name] = lines
        return lines

    return decorate


def head_lines(config: ModelConfig) -> Iterator[Entry]:
    """Yield an aggregator's table, with its own names where no public checkpoint has others."""
    lines = HEADS.get(config.aggregator.part_name)
    if lines is not None:
        yield from lines(config.aggregator)
        return
    for name, leaf in named_leaves(parameter_shapes(config)).items():
        if name.startswith("aggregator") and leaf.size:
            yield Entry((name,), (name,), SAME)


def tells_head(infer_head: Callable[[State], Any]) -> Callable[[State], bool]:
    """Return a function that returns whether a head can be inferred from a state.

    It is never so for a head that is inferred from no name at all.
    """

    def infers(state: State) -> bool:
        try:
            infer_head(state)
        except InputError:
            return False
        return True

    return lambda state: infers(state) and not infers({})


class Reader(NamedTuple):
    """A reader of the shapes of a state under a prefix, with one error for a missing name."""

    state: State
    prefix: str = ""

    def size(self, name: str, axis: int) -> int:
        """Return the size of an axis.

        Raises:
            InputError: there is no such name, or it has no such axis.
        """
        name = self.prefix + name
        if name not in self.state:
            raise InputError(f"found no {name}, expected it beside the others")
        shape = self.state[name].shape
        if len(shape) <= axis or not shape[axis]:
            raise InputError(
                f"{name} found of shape {shape}, expected more than {axis} axes, none of them empty"
            )
        return shape[axis]

    def has(self, name: str) -> bool:
        """Return whether there is an array of this name."""
        return self.prefix + name in self.state

    def count(self, name: str) -> int:
        """Count the consecutive numbers from 0 that follow a name."""
        heads = {key[: key.find(".", len(self.prefix + name))] for key in self.state}
        return next(i for i in range(len(heads) + 1) if f"{self.prefix}{name}{i}" not in heads)
