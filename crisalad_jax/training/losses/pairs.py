"""Find the pairs of a batch, from places or mined tuples, and choose the hard ones."""

import enum

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from crisalad_jax.training.losses.base import Pairs, Similarities


def all_pairs(labels: Int[Array, " image"], *, valid: Bool[Array, " image"] | None = None) -> Pairs:
    """Find all positive (same place) and negative (two places) pairs of valid images.

    Args:
        labels: the place of each image.
        valid: images that take part; None means all.

    Returns:
        The positive and the negative pairs; an image is not paired with itself.

    Example:
        >>> import jax.numpy as jnp
        >>> all_pairs(jnp.array([0, 0, 1])).positives.tolist()
        [[False, True, False], [True, False, False], [False, False, False]]
    """
    same = labels[:, None] == labels[None, :]
    usable = jnp.ones_like(same) if valid is None else valid[:, None] & valid[None, :]
    return Pairs(same & usable & ~jnp.eye(len(labels), dtype=bool), ~same & usable)


def mine(similarities: Similarities, pairs: Pairs, *, margin: float) -> Pairs:
    """Choose each anchor's hard pairs, as in the multi-similarity loss (Wang et al., CVPR 2019).

    A positive is chosen if its similarity to the anchor is strictly below that of the most similar
    negative plus the margin; a negative, if its similarity is strictly above that of the least
    similar positive minus the margin. An anchor without positives or without negatives gets no
    pairs.

    Args:
        similarities: similarity of every anchor (row) and image (column).
        pairs: the pairs to choose from.
        margin: similarity margin, epsilon in the paper.

    Returns:
        The chosen pairs.

    Example:
        >>> import jax.numpy as jnp
        >>> pairs = all_pairs(jnp.array([0, 0, 1]))
        >>> similarities = jnp.array([[1.0, 0.9, 0.1], [0.9, 1.0, 0.85], [0.1, 0.85, 1.0]])
        >>> mine(similarities, pairs, margin=0.1).positives.any(axis=1).tolist()
        [False, True, False]
    """
    positives, negatives = pairs
    hardest_negative = jnp.where(negatives, similarities, -jnp.inf).max(axis=1, keepdims=True)
    hardest_positive = jnp.where(positives, similarities, jnp.inf).min(axis=1, keepdims=True)
    return Pairs(
        positives & (similarities - margin < hardest_negative),
        negatives & (similarities + margin > hardest_positive),
    )


class Role(enum.IntEnum):
    """The role of an image in its tuple."""

    QUERY = 0
    POSITIVE = 1
    NEGATIVE = 2
    SPARE = 3
    """In no pair: fills a tuple whose query has too few hard negatives."""


def tuple_labels(roles: Int[np.ndarray, "tuple image"]) -> Int[np.ndarray, "tuple image"]:
    """Make the labels that `tuple_pairs` reads: each encodes a tuple's number and an image's role.

    Args:
        roles: a `Role` for each image of each tuple.

    Returns:
        The labels, in the same shape: 4 times the number of the tuple, plus the role.

    Example:
        >>> import numpy as np
        >>> tuple_labels(np.array([[0, 1, 2], [0, 1, 3]])).tolist()
        [[0, 1, 2], [4, 5, 7]]
    """
    return (np.arange(len(roles))[:, None] * len(Role) + roles).astype(np.int32)


def tuple_pairs(
    labels: Int[Array, " image"], *, valid: Bool[Array, " image"] | None = None
) -> Pairs:
    """Find the pairs of each mined tuple, whose only anchor is its query.

    Args:
        labels: the labels from `tuple_labels`.
        valid: images that take part; None means all.

    Returns:
        The positive and the negative pairs; only the rows of queries have any.

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
