"""Scalar fields that Milvus stores for an image, and filters over them.

A filter selects images by number, or by conditions on images as they were added.
"""

import os
import sys
import urllib.parse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.positions import AXES
from crisalad_jax.data.tracks import time_of
from crisalad_jax.retrieval.maps.removed import Removed
from crisalad_jax.retrieval.maps.where import ALWAYS, Where
from crisalad_jax.utils.shapes import Int64

_RANGES = 16
"""Maximum ranges in a filter; Milvus 2.3 takes 0.1 s to parse 16, and 2 s to parse 100."""
_NOWHERE = sys.float_info.max
"""Value of an unknown position or time; Milvus before 2.5 has no null."""


def columns_of(record: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the scalar fields of a record's images, by name; search conditions refer to them."""
    names = record["names"]
    added = record.get("added")
    moments = [moment_of(name) for name in names]
    reverse = -1 if record.get("axes") == AXES[1] else 1
    positions = record.get("positions") or [None] * len(names)
    at = [each[::reverse] if each else (_NOWHERE, _NOWHERE) for each in positions]
    return {
        "name": [_encoded(name) for name in names],
        "added": [time_of(added) if added else _NOWHERE] * len(names),
        "taken": [each.seconds if each and not each.clock else _NOWHERE for each in moments],
        "x": [x for x, _ in at],
        "y": [y for _, y in at],
    }


def _encoded(name: str) -> str:
    """Encode a name in ASCII; common prefixes are preserved."""
    return urllib.parse.quote(os.fsencode(name), safe="/#")


def condition_of(where: Where) -> list[str]:
    """Return the terms of Milvus' filter for conditions on images as they were added."""
    parts = []
    if where.folder.rstrip("*"):
        begins = map(_encoded, where.prefixes)
        ends = [(begin, begin[:-1] + chr(ord(begin[-1]) + 1)) for begin in begins]
        parts.append(_any([f'(name >= "{begin}" and name < "{end}")' for begin, end in ends]))
    for name, (first, end) in (("added", where.added), ("taken", where.time)):
        if (first, end) != ALWAYS:
            parts.append(f"{name} >= {max(first, -_NOWHERE)!r} and {name} < {min(end, _NOWHERE)!r}")
    if where.box is not None:
        west, south, east, north = where.box
        between = "and" if west <= east else "or"
        parts.append(f"(x >= {west!r} {between} x <= {east!r})")
        parts.append(f"y >= {south!r} and y <= {north!r}")
    return parts


def left_in(count: int, removed: Removed) -> str:
    """Return Milvus' filter for the numbers below `count` that were not removed."""
    if removed.asked is not None:
        where, gone = removed.asked
        return " and ".join([*condition_of(where), left_in(count, Removed(gone))])
    if not len(removed.rows):
        return f"id < {count}"
    if 2 * len(removed.rows) > count:
        return among(np.delete(np.arange(count), removed.rows))
    return f"id < {count} and not ({among(removed.rows)})"


def among(numbers: Int64[np.ndarray, " n"]) -> str:
    """Return Milvus' filter for numbers in ascending order: the longest runs as ranges."""
    ends = np.append(np.flatnonzero(np.diff(numbers) != 1) + 1, len(numbers))
    starts = np.append(0, ends[:-1])
    longest = np.argsort(starts - ends, kind="stable")[:_RANGES]
    longest = longest[ends[longest] - starts[longest] > 2]
    parts = [f"(id >= {numbers[starts[i]]} and id <= {numbers[ends[i] - 1]})" for i in longest]
    is_rest = np.ones(len(numbers), bool)
    for i in longest:
        is_rest[starts[i] : ends[i]] = False
    if is_rest.any():
        parts.append(f"id in {numbers[is_rest].tolist()}")
    return _any(parts)


def _any(parts: Sequence[str]) -> str:
    """Join alternatives in pairs: Milvus is slow to parse a long chain of them."""
    if len(parts) == 1:
        return parts[0]
    middle = len(parts) // 2
    return f"({_any(parts[:middle])} or {_any(parts[middle:])})"
