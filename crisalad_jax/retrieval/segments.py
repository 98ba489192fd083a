"""Rows of numbers that grow in a folder, segment by segment: what `extract` and `index` resume.

A segment's rows go to a store. Then its record, JSON with a checksum, appears under its name: that
single rename commits the segment. Whoever is killed at any moment leaves the rows as they were
before the segment or after it.
"""

import hashlib
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.retrieval.chunks import Descriptors
from crisalad_jax.retrieval.maps.store import Store
from crisalad_jax.utils.checksums import checksummed_json
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, read_json
from crisalad_jax.utils.shapes import Int64

SEGMENT = 256
"""Number of images appended together, and so described again at most after a kill."""


class Segment(NamedTuple):
    """Consecutive rows that were appended together."""

    first: int
    count: int
    sha256: str
    """Digest of the rows' bytes."""


def write_record(path: pathlib.Path, value: Mapping[str, Any], indent: int | None = None) -> None:
    """Write an object as JSON with its checksum, whole or not at all, and flush it to the disk.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    with atomic_path(path, durable=True) as temporary:
        temporary.write_bytes(checksummed_json(value, indent))


class Segments:
    """Rows in a store, and the records in a folder that say which of them count."""

    def __init__(self, folder: pathlib.Path, store: Store, dtype: str) -> None:
        """Read all records, and check that the store has their rows.

        Raises:
            InputError: a record or its rows are damaged or gone.
        """
        self.folder, self.store, self._dtype = folder, store, np.dtype(dtype)
        self.spans: list[Segment] = []
        self.records: list[dict[str, Any]] = []
        """The records in order; each has the `names` of its rows."""
        # A writer adds records in order, so those that are listed now have all before them. It may
        # add more while they are read.
        listed = set(folder.glob("[0-9]*.json"))
        while (path := self.path(len(self))).exists():
            self._take(read_json(path, "a record of images"), path)
            listed.discard(path)
        if listed:
            raise InputError(f"{min(listed)}: expected {path.name} before it, found no such file")
        store.check([(span.first, span.count) for span in self.spans])

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.spans[-1].first + self.spans[-1].count if self.spans else 0

    def path(self, first: int) -> pathlib.Path:
        """Return the file of the record of the segment that begins with a row."""
        return self.folder / f"{first:010d}.json"

    def _take(self, record: dict[str, Any], path: pathlib.Path) -> None:
        names, digest = record.get("names"), record.get("sha256")
        if not isinstance(names, list) or not names or not isinstance(digest, str):
            raise InputError(f"{path}: not a whole record of images: no names, or no sha256")
        self.spans.append(Segment(len(self), len(names), digest))
        self.records.append(record)

    def append(self, record: Mapping[str, Any], rows: Descriptors) -> None:
        """Append a segment: it is there for good once this returns, and not at all before.

        Args:
            record: JSON values, among them `names`, one of each row.
            rows: the rows.

        Raises:
            InputError: the store or the folder cannot be written to.
        """
        rows = np.ascontiguousarray(rows, self._dtype)
        path = self.path(len(self))
        whole = {**record, "sha256": _sha256(rows, self._dtype)}
        self.store.add(len(self), rows)
        write_record(path, whole)
        self._take(whole, path)

    def blocks(self) -> Iterator[Descriptors]:
        """Yield the rows of each segment in order."""
        for span in self.spans:
            yield self.store.read(span.first, span.count)

    def __getitem__(self, numbers: Int64[np.ndarray, " n"]) -> Descriptors:
        """Read rows of files by number, in any order."""
        return self.store.rows(numbers)  # pyright: ignore[reportAttributeAccessIssue]

    def verify(self) -> None:
        """Read all rows, and compare them with the digests in the records.

        Raises:
            InputError: one has changed; the message says in which segment.
        """
        for span, rows in zip(self.spans, self.blocks(), strict=True):
            if _sha256(rows, self._dtype) != span.sha256:
                raise InputError(
                    f"{self.path(span.first).with_suffix('')}: descriptors {span.first} to "
                    f"{span.first + span.count - 1} have changed since they were written"
                )


def _sha256(rows: np.ndarray, dtype: np.dtype) -> str:
    return hashlib.sha256(np.ascontiguousarray(rows, dtype).data).hexdigest()


def digest_of(names: Sequence[str], settings: Mapping[str, Any]) -> str:
    """Compute a digest of what all rows of a collection depend on."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for name in names:
        digest.update(f"{name}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()
