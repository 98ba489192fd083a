"""Dataclasses that are pytrees, with dotted names for their leaves."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

from crisalad_jax.utils.errors import InputError

_T = TypeVar("_T")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def pytree_dataclass(cls: type[_T]) -> type[_T]:
    """Make a class a frozen dataclass and register it as a pytree whose children are its fields.

    Unflattening bypasses `__init__`, because JAX also builds trees of shapes, labels or masks from
    the same structure, which must not be checked against the annotations of arrays.

    `repr` shows names, types and shapes, but no values (`summary`), unless overridden.

    Args:
        cls: a class with annotated fields.

    Returns:
        The dataclass.

    Example:
        >>> import jax
        >>> @pytree_dataclass
        ... class Line:
        ...     slope: float
        ...     offset: float
        >>> jax.tree.map(lambda x: 2 * x, Line(1.0, 3.0))
        Line
          slope   float
          offset  float
        2 leaves, 0 parameters, 0 bytes
    """
    own = "__repr__" in vars(cls)
    cls = dataclasses.dataclass(frozen=True, repr=False)(cls)
    if not own:
        cls.__repr__ = summary  # pyright: ignore[reportAttributeAccessIssue]
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    names = tuple(field.name for field in fields)

    def flatten_with_keys(tree: _T) -> tuple[tuple[tuple[Any, Any], ...], None]:
        return tuple((jax.tree_util.GetAttrKey(n), getattr(tree, n)) for n in names), None

    def flatten(tree: _T) -> tuple[tuple[Any, ...], None]:
        return tuple(getattr(tree, n) for n in names), None

    def unflatten(_: None, children: Any) -> _T:
        tree = object.__new__(cls)
        vars(tree).update(zip(names, children, strict=True))
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def check_drawn(tree: Any, where: str) -> None:
    """Check that new parameters are float32 arrays.

    An empty array cannot be a parameter, because optimisers divide by its size: use None instead.

    Raises:
        InputError: a parameter is empty or not float32; the message names it and `where`.
    """
    for name, leaf in named_leaves(tree).items():
        dtype = getattr(leaf, "dtype", type(leaf).__name__)
        if dtype != jnp.float32:
            path = f" {name}" if name else ""
            raise InputError(f"{where}: found parameter{path} of type {dtype}, expected float32")
        if not leaf.size:
            raise InputError(f"{where}: found an empty parameter {name}, expected None")


def expect_like(name: str, found: Any, wanted: Any) -> None:
    """Check that a plug-in's return value has the expected structure, shapes and types.

    Args:
        name: the plug-in's name, which begins the message.
        found: what it returned.
        wanted: a tree of arrays or of their shapes.

    Raises:
        InputError: the two differ.

    Example:
        >>> import numpy as np
        >>> expect_like("step x", (np.ones(2), None), (np.ones(3), None))
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: step x: found to return (float64[2], None), ...
    """
    trees = [jax.tree.map(_Word, tree) for tree in (found, wanted)]
    kinds = [(jax.tree.structure(tree), str(jax.tree.leaves(tree))) for tree in trees]
    if kinds[0] != kinds[1]:
        words = [" ".join(str(tree).split()) for tree in trees]
        raise InputError(f"{name}: found to return {words[0]}, expected {words[1]}")


class _Word:
    """A leaf, which prints as its type and shape, or its class."""

    def __init__(self, leaf: Any) -> None:
        self._words = type(leaf).__name__
        if hasattr(leaf, "dtype"):
            self._words = f"{leaf.dtype}[{','.join(map(str, leaf.shape))}]"

    def __repr__(self) -> str:
        return self._words


def named_leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves by dotted path, as in `backbone.blocks.mlp.fc1.weight`, in tree order.

    Args:
        tree: a pytree, such as a model's parameters.

    Returns:
        The leaves by their names.

    Example:
        >>> named_leaves({"conv": {"weight": 2.0}, "bias": None})
        {'conv.weight': 2.0}
    """
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


_MOST = 24
"""Maximum lines of a printed tree, unless it has more top-level names."""


def summary(tree: Any) -> str:
    """Describe a pytree: a line for each leaf, with its name, shape and type, and the totals.

    In a tree of over 24 leaves, a line counts all leaves whose names have the same prefix, and
    their parameters; `named_leaves` has all. Values are neither read nor computed, so leaves may be
    arrays of any kind, tracers or `jax.ShapeDtypeStruct`. A field that is None has no leaf. For a
    leaf without a shape, the line has its class.

    Args:
        tree: a pytree, such as a model's parameters.

    Returns:
        The lines; the number of parameters counts the elements of all arrays.

    Example:
        >>> import jax
        >>> print(summary({"bias": jax.ShapeDtypeStruct((3,), "float32"), "weight": None}))
        dict
          bias  (3,)  float32
        1 leaf, 3 parameters, 12 bytes
    """
    leaves = named_leaves(tree)
    depth = max((name.count(".") for name in leaves), default=0) + 1
    while len(groups := _by_prefix(leaves, depth)) > _MOST and depth > 1:
        depth -= 1
    rows = [_row(prefix, group) for prefix, group in groups.items()]
    widths = [max((len(row[i]) for row in rows), default=0) for i in (0, 1)]
    lines = [f"  {n:{widths[0]}}  {s:{widths[1]}}  {d}".rstrip() for n, s, d in rows]
    arrays = [leaf for leaf in leaves.values() if hasattr(leaf, "dtype")]
    size = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in arrays)
    plural = "leaf" if len(leaves) == 1 else "leaves"
    totals = f"{len(leaves)} {plural}, {_count(arrays):,} parameters, {_in_bytes(size)}"
    return "\n".join([type(tree).__name__, *lines, totals])


def _by_prefix(leaves: Mapping[str, Any], depth: int) -> dict[str, dict[str, Any]]:
    groups: dict[str, dict[str, Any]] = {}
    for name, leaf in leaves.items():
        groups.setdefault(".".join(name.split(".")[:depth]), {})[name] = leaf
    return groups


def _row(prefix: str, group: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return name, shape and type of one leaf; of several, the counts of leaves and parameters."""
    (name, leaf), *more = group.items()
    if more:
        return prefix, f"{len(group)} leaves", f"{_count(group.values()):,}"
    if not hasattr(leaf, "dtype"):
        return name, type(leaf).__name__, ""
    return name, str(leaf.shape), str(leaf.dtype)


def _count(leaves: Iterable[Any]) -> int:
    return sum(math.prod(leaf.shape) for leaf in leaves if hasattr(leaf, "dtype"))


def _in_bytes(size: int) -> str:
    for unit, bytes_each in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= bytes_each:
            return f"{size / bytes_each:.1f} {unit}"
    return f"{size} bytes"
