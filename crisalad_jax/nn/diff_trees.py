"""Report how a parameter tree differs from the one that its configuration expects."""

from collections.abc import Collection
from typing import Any

import numpy as np

from crisalad_jax.utils.pytree import named_leaves


def diff_trees(found: Any, expected: Any, dtypes: Collection[Any] = ()) -> list[str]:
    """List how a tree of arrays differs from another: names, shapes and types.

    Args:
        found: the tree; its leaves may be JAX or NumPy arrays, traced, or only shapes.
        expected: a tree of arrays or shapes.
        dtypes: types that a leaf may have instead of the expected one.

    Returns:
        A string for each difference; empty if the trees match.

    Example:
        >>> import numpy as np
        >>> diff_trees({"a": np.ones(2)}, {"a": np.ones(3), "b": np.ones(1)})
        ['a found float64 (2,), expected float64 (3,)', 'b missing']
    """
    leaves, wanted = named_leaves(found), named_leaves(expected)
    problems = []
    for name, leaf in wanted.items():
        if name not in leaves:
            problems.append(f"{name} missing")
            continue
        array = leaves[name]
        shape, dtype = getattr(array, "shape", None), getattr(array, "dtype", None)
        if shape != leaf.shape or dtype not in (leaf.dtype, *dtypes):
            words = type(array).__name__ if dtype is None else f"{dtype} {shape}"
            problems.append(f"{name} found {words}, expected {leaf.dtype} {leaf.shape}")
    return problems + [f"{name} unknown" for name in leaves if name not in wanted]


def not_finite(tree: Any) -> list[str]:
    """List the leaves that hold NaN or infinity."""
    return [
        f"{name} holds NaN or infinity"
        for name, leaf in named_leaves(tree).items()
        if not np.isfinite(np.asarray(leaf)).all()
    ]
