"""Pairs of images as hloc reads them: which image is to be matched with which."""

import os
from collections.abc import Sequence

from crisalad_jax.retrieval.chunks import Descriptors
from crisalad_jax.retrieval.search import search
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path


def check_names(path: str | os.PathLike[str], names: Sequence[str]) -> None:
    """Check that names fit in a file of pairs, where a space separates them.

    Raises:
        InputError: a name has a space in it, or is no line of its own.
    """
    wrong = [name for name in names if name.split() != [name]]
    if wrong:
        raise InputError(
            f"{path}: found the image name {wrong[0]!r} ({len(wrong)} such of {len(names)}), "
            "expected names without spaces, which hloc's pairs cannot have"
        )


def nearest_pairs(
    query_names: Sequence[str],
    queries: Descriptors,
    database_names: Sequence[str],
    database: Descriptors,
    *,
    k: int,
) -> list[tuple[str, str]]:
    """Pair each query with its k most similar database images, best first, never itself.

    Raises:
        InputError: what `search` raises.
    """
    # One more than k, because the query itself may be among them.
    neighbours = search(database, queries, k + 1).indices
    pairs = []
    for query, indices in zip(query_names, neighbours, strict=True):
        others = [name for name in (database_names[i] for i in indices) if name != query]
        pairs += [(query, name) for name in others[:k]]
    return pairs


def write_pairs(path: str | os.PathLike[str], pairs: Sequence[tuple[str, str]]) -> None:
    """Write a line for each pair: the query, one space, the database image.

    Args:
        path: the file.
        pairs: of names that `check_names` takes.

    Raises:
        InputError: the file cannot be made.
    """
    with atomic_path(path) as temporary:
        text = "".join(f"{query} {other}\n" for query, other in pairs)
        temporary.write_text(text, encoding="utf-8")
