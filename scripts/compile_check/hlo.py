"""Read the text of a compiled program (HLO, as `jax.stages.Compiled.as_text` returns it).

The grammar is that of XLA's own printer. Only what `counts` needs is parsed.
"""

import functools
import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from crisalad_jax.utils.errors import InputError

_BITS = {
    **{"pred": 8, "s4": 4, "u4": 4, "s8": 8, "u8": 8, "f8e4m3fn": 8, "f8e5m2": 8},
    **{"s16": 16, "u16": 16, "bf16": 16, "f16": 16, "s32": 32, "u32": 32, "f32": 32},
    **{"s64": 64, "u64": 64, "f64": 64, "c64": 64, "c128": 128},
}
"""Bits per number; other types, such as tokens, use no memory."""
_ARRAY = re.compile(r"(\w+)\[([\d,]*)\](?:\{([^{}]*)\})?")
_HEADER = re.compile(r"(ENTRY )?%?([\w.\-]+) \(.*\) -> .*\{$")
_LINE = re.compile(r"\s+(ROOT )?%?([\w.\-]+) = (.*)$")
_CALL = re.compile(r"([\w\-]+)\(((?:[^()]|\([^()]*\))*)\)")
_CALLED = re.compile(
    r"(calls|to_apply|body|condition|branch_computations|true_computation|false_computation"
    r"|called_computations)=(\{[^}]*\}|%?[\w.\-]+)"
)


class Array(NamedTuple):
    """One array of a result."""

    dtype: str
    dims: tuple[int, ...]
    layout: str = ""
    """Order of the dimensions, tiles and memory space: the text between the braces."""

    @property
    def on_chip(self) -> bool:
        """Whether it is in a TPU's on-chip memory (VMEM or SMEM), not in HBM.

        Memory spaces of other platforms are not on-chip; their layouts have no tiles.
        """
        return "S(" in self.layout and "T(" in self.layout

    @property
    def bytes(self) -> int:
        """Bytes in memory, with the padding of a TPU's tiles."""
        dims = list(self.dims)
        order, _, tiles = self.layout.partition(":")
        tile = re.match(r"T\(([\d,]+)\)", tiles)
        if tile and order:
            minor_to_major = map(int, order.split(","))
            for axis, size in zip(minor_to_major, reversed(tile[1].split(",")), strict=False):
                dims[axis] = -(-dims[axis] // int(size)) * int(size)
        return math.prod(dims) * _BITS.get(self.dtype, 0) // 8

    @property
    def hbm_bytes(self) -> int:
        """Bytes that are not on-chip."""
        return 0 if self.on_chip else self.bytes


class Operation(NamedTuple):
    """One line of a computation."""

    name: str
    kind: str
    """The operation's name in HLO, such as "fusion"."""
    arrays: tuple[Array, ...]
    """Its result; several arrays for a tuple."""
    operands: tuple[str, ...]
    """Names of the operations in the same computation whose results it reads."""
    inside: str
    """The text in parentheses: a constant's value, or a parameter's number."""
    attributes: str
    """The text after the parentheses."""
    is_root: bool

    @property
    def called(self) -> tuple[tuple[str, str], ...]:
        """Computations that it calls, each with the attribute that names it."""
        return _called(self.attributes)

    @property
    def source(self) -> str:
        """The JAX operation that it comes from, with its enclosing functions."""
        found = re.search(r'op_name="([^"]*)"', self.attributes)
        return "" if found is None else found[1]

    @property
    def target(self) -> str:
        """The target of a custom call; otherwise empty."""
        found = re.search(r'custom_call_target="([^"]*)"', self.attributes)
        return "" if found is None else found[1]


class Computation(NamedTuple):
    """The operations of a computation by name, in the order of the text."""

    operations: Mapping[str, Operation]

    @property
    def root(self) -> Operation:
        """The operation that returns the computation's result."""
        return next(each for each in self.operations.values() if each.is_root)

    @property
    def parameters(self) -> dict[int, Operation]:
        """The parameters by number."""
        return {
            int(each.inside): each for each in self.operations.values() if each.kind == "parameter"
        }

    def users(self, name: str) -> list[Operation]:
        """Return the operations that read a result."""
        return [each for each in self.operations.values() if name in each.operands]

    def results(self) -> list[Operation]:
        """Return the operations of the result: one per element for a tuple."""
        root = self.root
        return [self.operations[x] for x in root.operands] if root.kind == "tuple" else [root]


class Module(NamedTuple):
    """A compiled program."""

    computations: Mapping[str, Computation]
    entry: str
    """Name of the computation that runs first."""

    def operations(self) -> list[Operation]:
        """Return all operations, each once, no matter how often it runs."""
        return [each for c in self.computations.values() for each in c.operations.values()]


def parse_hlo(text: str) -> Module:
    """Parse the text of a compiled program.

    Args:
        text: from `jax.stages.Compiled.as_text`.

    Returns:
        Its computations.

    Raises:
        InputError: the text has no entry computation.
    """
    computations: dict[str, dict[str, Operation]] = {}
    current: dict[str, Operation] | None = None
    entry = None
    for line in text.splitlines():
        header = _HEADER.match(line)
        if header:
            current = computations.setdefault(header[2], {})
            entry = header[2] if header[1] else entry
            continue
        found = _LINE.match(line)
        if found and current is not None:
            operation = _operation(found[2], found[3], is_root=bool(found[1]))
            if operation is not None:
                current[operation.name] = operation
    if entry is None:
        raise InputError("HLO: found no ENTRY computation, expected the text of a compiled program")
    return Module({name: Computation(each) for name, each in computations.items()}, entry)


def parse_arrays(text: str) -> tuple[Array, ...]:
    """Parse the arrays of a type, in order.

    Example:
        >>> parse_arrays("(bf16[2,3]{1,0}, s32[])")
        (Array(dtype='bf16', dims=(2, 3), layout='1,0'), Array(dtype='s32', dims=(), layout=''))
    """
    return tuple(
        Array(dtype, tuple(int(n) for n in dims.split(",") if n), layout)
        for dtype, dims, layout in _ARRAY.findall(text)
    )


def _operation(name: str, text: str, *, is_root: bool) -> Operation | None:
    kind, rest = _split_type(text)
    call = _CALL.match(rest)
    if call is None:
        return None
    inside = call[2]
    operands = tuple(re.findall(r"%([\w.\-]+)", inside))
    arrays = parse_arrays(kind)
    return Operation(name, call[1], arrays, operands, inside, rest[call.end() :], is_root)


def _split_type(text: str) -> tuple[str, str]:
    """Split "type operation(...)" into the two."""
    if not text.startswith("("):
        kind, _, rest = text.partition(" ")
        return kind, rest
    depth = 0
    for position, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return text[: position + 1], text[position + 2 :]
    return text, ""


@functools.lru_cache(maxsize=2**16)
def _called(attributes: str) -> tuple[tuple[str, str], ...]:
    # Backend settings come last, and contain no computations.
    head = attributes.partition("backend_config=")[0]
    return tuple(
        (key, name)
        for key, names in _CALLED.findall(head)
        for name in re.findall(r"[\w.\-]+", names)
    )
