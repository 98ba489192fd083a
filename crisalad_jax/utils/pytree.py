"""Dataclasses that are pytrees, with dotted names for their leaves."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

from crisalad_jax.utils.errors import InputError

_T = TypeVar("_T")


def static_field(**options: Any) -> Any:
    """Return a dataclass field that is part of the pytree's structure, and no leaf."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static_field))
def pytree_dataclass(cls: type[_T]) -> type[_T]:
    """Make a class a frozen dataclass and register it as a pytree whose children are its fields.

    Unflattening bypasses `__init__`. JAX also builds trees of shapes, labels or masks from the same
    structure, which must not be checked against the annotations of arrays.

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
        Line(slope=2.0, offset=6.0)
    """
    cls = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    names = tuple(field.name for field in fields if not field.metadata.get("static"))
    statics = tuple(field.name for field in fields if field.metadata.get("static"))

    def flatten_with_keys(tree: _T) -> tuple[tuple[tuple[Any, Any], ...], tuple[Any, ...]]:
        children = tuple((jax.tree_util.GetAttrKey(n), getattr(tree, n)) for n in names)
        return children, tuple(getattr(tree, n) for n in statics)

    def flatten(tree: _T) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(tree, n) for n in names), tuple(getattr(tree, n) for n in statics)

    def unflatten(values: tuple[Any, ...], children: Any) -> _T:
        tree = object.__new__(cls)
        for name, value in (*zip(names, children, strict=True), *zip(statics, values, strict=True)):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def check_drawn(tree: Any, where: str) -> None:
    """Check that new parameters are arrays of numbers that can train, in float32 at least.

    Raises:
        InputError: naming `where` and the first leaf that is not.
    """
    for name, leaf in named_leaves(tree).items():
        dtype = getattr(leaf, "dtype", type(leaf).__name__)
        if dtype not in (jnp.float32, jnp.float64):
            path = f" {name}" if name else ""
            raise InputError(f"{where}: found parameter{path} of type {dtype}, expected float32")


def named_leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves by dotted path, as in `backbone.blocks.mlp.fc1.weight`, in tree order."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
