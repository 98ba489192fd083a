"""Words for what a tree of parameters has that its configuration's does not, and the reverse."""

from collections.abc import Collection, Iterator
from typing import Any

import jax
import numpy as np

from crisalad_jax.utils.pytree import named_leaves


def misfits(found: Any, expected: Any, dtypes: Collection[Any] = ()) -> list[str]:
    """List in what a tree of arrays differs from another: names, shapes, types, classes.

    Args:
        found: the tree; its leaves may be of JAX or NumPy, traced, or only shapes.
        expected: a tree of arrays or shapes.
        dtypes: types that a leaf may have in the place of its own.

    Returns:
        A text for each misfit; none where the trees fit.

    Example:
        >>> import numpy as np
        >>> misfits({"a": np.ones(2)}, {"a": np.ones(3), "b": np.ones(1)})
        ['a found float64 (2,), expected float64 (3,)', 'b missing']
    """
    leaves, wanted = named_leaves(found), named_leaves(expected)
    problems = []
    for name, leaf in wanted.items():
        words = f"{leaf.dtype} {leaf.shape}"
        if name not in leaves:
            problems.append(f"{name} missing")
        elif not hasattr(leaves[name], "shape") or not hasattr(leaves[name], "dtype"):
            problems.append(f"{name} found {type(leaves[name]).__name__}, expected {words}")
        elif leaves[name].shape != leaf.shape or (
            leaves[name].dtype != leaf.dtype and leaves[name].dtype not in dtypes
        ):
            array = leaves[name]
            problems.append(f"{name} found {array.dtype} {array.shape}, expected {words}")
    problems += [f"{name} unknown" for name in leaves if name not in wanted]
    if problems:
        return problems
    # Trees of the same names may be of other classes, such as dictionaries of the same keys.
    pairs = zip(_classes(found), _classes(expected), strict=False)
    wrong = [(a, b) for a, b in pairs if _home(a) != _home(b)]
    return [f"found {a.__qualname__}, expected {b.__qualname__}" for a, b in wrong[:1]]


def is_finite(array: np.ndarray) -> bool:
    """Return whether an array holds no NaN and no infinity, which a sum would keep.

    Example:
        >>> import numpy as np
        >>> [is_finite(np.float32(values)) for values in ([1, 2], [1, np.nan], [3e38, 3e38])]
        [True, False, True]
    """
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(array.sum()):
            return True
    return bool(np.isfinite(array).all())


def _classes(tree: Any) -> Iterator[type]:
    """Yield the classes of all nodes of a tree from the top down."""
    nodes = [jax.tree.structure(tree)]
    while nodes:
        node = nodes.pop()
        data = node.node_data()
        if data is not None:
            yield data[0]
        nodes += reversed(node.children())


def _home(kind: type) -> tuple[str, str]:
    """Return where a class is defined: a notebook's cell that runs again makes the class anew."""
    return kind.__module__, kind.__qualname__


def not_finite(tree: Any) -> list[str]:
    """List the leaves that hold NaN or infinity."""
    return [
        f"{name} holds NaN or infinity"
        for name, leaf in named_leaves(tree).items()
        if not is_finite(np.asarray(leaf))
    ]
