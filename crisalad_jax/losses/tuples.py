"""Pairs of mined tuples: a query with its positive, and with each of its negatives."""

import enum

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from crisalad_jax.losses.base import Pairs


class Role(enum.IntEnum):
    """What an image is in its tuple."""

    QUERY = 0
    POSITIVE = 1
    NEGATIVE = 2
    SPARE = 3
    """Of no pair: it fills a tuple whose query has too few hard negatives."""


def tuple_labels(roles: Int[np.ndarray, "tuple image"]) -> Int[np.ndarray, "tuple image"]:
    """Make the labels that `tuple_pairs` reads: the tuple's number and the image's role in one.

    Args:
        roles: a `Role` for each image of each tuple.

    Returns:
        The labels.

    Example:
        >>> import numpy as np
        >>> tuple_labels(np.array([[0, 1, 2], [0, 1, 3]])).tolist()
        [[0, 1, 2], [4, 5, 7]]
    """
    return (np.arange(len(roles))[:, None] * len(Role) + roles).astype(np.int32)


def tuple_pairs(
    labels: Int[Array, " image"], *, valid: Bool[Array, " image"] | None = None
) -> Pairs:
    """Find the pairs of each tuple, whose anchor is its query.

    Args:
        labels: those of `tuple_labels`.
        valid: images that take part; None means all.

    Returns:
        The positive and the negative pairs; their rows are those of queries alone.

    Example:
        >>> import jax.numpy as jnp
        >>> tuple_pairs(jnp.array([0, 1, 2])).negatives.tolist()
        [[False, False, True], [False, False, False], [False, False, False]]
    """
    number, role = jnp.divmod(labels, len(Role))
    usable = (number[:, None] == number) & (role == Role.QUERY)[:, None]
    if valid is not None:
        usable &= valid[:, None] & valid
    return Pairs(usable & (role == Role.POSITIVE), usable & (role == Role.NEGATIVE))
