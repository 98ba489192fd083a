"""Parameters as frozen dataclasses that are pytrees, with dotted names for their leaves."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

_T = TypeVar("_T")


@dataclass_transform(frozen_default=True)
def params(cls: type[_T]) -> type[_T]:
    """Make `cls` a frozen dataclass and register it as a pytree whose children are its fields.

    Unflattening goes around `__init__`, so that trees of shapes, labels or masks, which JAX builds
    from the same structure, are not checked against the annotations of arrays.
    """
    cls = dataclasses.dataclass(frozen=True)(cls)
    names = tuple(field.name for field in dataclasses.fields(cls))  # pyright: ignore[reportArgumentType]

    def flatten_with_keys(tree: _T) -> tuple[tuple[tuple[Any, Any], ...], None]:
        return tuple((jax.tree_util.GetAttrKey(n), getattr(tree, n)) for n in names), None

    def flatten(tree: _T) -> tuple[tuple[Any, ...], None]:
        return tuple(getattr(tree, n) for n in names), None

    def unflatten(_: None, children: Any) -> _T:
        tree = object.__new__(cls)
        for name, child in zip(names, children, strict=True):
            object.__setattr__(tree, name, child)
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by dotted path, as in `backbone.blocks.mlp.fc1.weight`, in tree order."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
