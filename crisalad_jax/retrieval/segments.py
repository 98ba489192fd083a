"""Append rows to a folder, segment by segment, so that `extract` and `index` can resume.

The rows of a segment go to a store. Then the segment's record, JSON with a checksum, is renamed to
its final name: that single rename commits the segment. A process that is killed at any moment
leaves a segment either complete or without effect.

A change commits any number of segments with a single record of its own. Until then, the names of
the segments' records say which change they wait for.
"""

import collections
import hashlib
import json
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.retrieval.chunks import Descriptors
from crisalad_jax.retrieval.maps.store import Store
from crisalad_jax.utils.checksums import checksummed_json
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, read_json
from crisalad_jax.utils.shapes import Int64

SEGMENT = 256
"""Images per segment, rounded up to whole batches; a kill loses at most one segment of work."""


Take = Callable[[Mapping[str, Any], pathlib.Path], None]
"""A function that is called with a record and the path of its file."""


class Segment(NamedTuple):
    """`count` consecutive rows, from row `first` on, that were appended together."""

    first: int
    count: int
    sha256: str
    """Hexadecimal SHA-256 of the bytes of the rows."""


def write_record(path: pathlib.Path, value: Mapping[str, Any], indent: int | None = None) -> None:
    """Write an object as JSON with its checksum, atomically, and flush it to the disk.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    with atomic_path(path, durable=True) as temporary:
        temporary.write_bytes(checksummed_json(value, indent))


class Segments:
    """Rows in a store, and the records in a folder that say which of them are committed."""

    def __init__(
        self, folder: pathlib.Path, store: Store, dtype: str, take: Take | None = None
    ) -> None:
        """Read all records, and check that the store has their rows.

        Args:
            folder: folder of the records.
            store: store of the rows.
            dtype: type of the rows.
            take: called with each record and its file in order, now and when one is appended.
                The record of a segment has the `names` of its rows, that of a change the number of
                `rows` after it. None appends the records to the attribute `records`.

        Raises:
            InputError: a record or its rows are damaged or missing.
        """
        self.folder, self.store, self._dtype = folder, store, np.dtype(dtype)
        self.spans: list[Segment] = []
        self.records: list[Mapping[str, Any]] = []
        self._give: Take = take or (lambda record, _: self.records.append(record))
        self.paths: list[pathlib.Path] = []
        """Paths of the segments' record files, in order."""
        self.changes = 0
        """Number of committed changes."""
        # A writer adds records in order, so all records before the listed ones exist. It may add
        # more while they are read. The segments of a change exist before its record.
        later = set(folder.glob("change-*.json"))
        changes: collections.deque[tuple[dict[str, Any], pathlib.Path]] = collections.deque()
        while (path := self.change_path(self.changes)).exists():
            changes.append((read_json(path, "a record of a change"), path))
            later.discard(path)
            self.changes += 1
        _check_all_read(later, path)
        listed = {_first_of(each): each for each in folder.glob("[0-9]*.json")}
        for path in self.waiting():
            listed.pop(_first_of(path), None)
        while (path := listed.pop(len(self), self.path(len(self)))).exists():
            record = read_json(path, "a record of images")
            # A change of n rows came before the images of row n.
            while changes and changes[0][0].get("rows") == len(self):
                self._give(*changes.popleft())
            self._take(record, path)
            self._give(record, path)
        if not self.change_path(self.changes).exists():  # else it and others were added meanwhile
            _check_all_read(set(listed.values()), path)
        for change, path in changes:
            if change.get("rows") != len(self):
                raise InputError(
                    f"{path}: found a change of {change.get('rows')} rows, expected at most "
                    f"{len(self)}, of which there are records"
                )
            self._give(change, path)
        store.check([(span.first, span.count) for span in self.spans])

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.spans[-1].first + self.spans[-1].count if self.spans else 0

    def path(self, first: int) -> pathlib.Path:
        """Return the path of the record of the segment that starts at a row."""
        return self.folder / f"{first:010d}.json"

    def change_path(self, number: int) -> pathlib.Path:
        """Return the path of the record of a change, by its number from 0."""
        return self.folder / f"change-{number:010d}.json"

    def waiting(self) -> list[pathlib.Path]:
        """List the record files of segments whose change is not committed yet, in order."""
        numbered = ((path, path.stem.partition(".")[2]) for path in self.folder.glob("[0-9]*.json"))
        count = self.changes
        return sorted(path for path, of in numbered if of.isdecimal() and int(of) >= count)

    @property
    def has_more(self) -> bool:
        """Whether another process has added a segment or a change since these were read."""
        return self.path(len(self)).exists() or self.change_path(self.changes).exists()

    def _take(self, record: dict[str, Any], path: pathlib.Path) -> None:
        names, digest = record.get("names"), record.get("sha256")
        if not isinstance(names, list) or not names or not isinstance(digest, str):
            raise InputError(f"{path}: not a whole record of images: no names, or no sha256")
        self.spans.append(Segment(len(self), len(names), digest))
        self.paths.append(path)

    def append(self, record: Mapping[str, Any], rows: Descriptors) -> None:
        """Append a segment, which is committed once this call returns, and has no effect before.

        Args:
            record: JSON values, including `names`, one for each row.
            rows: the rows.

        Raises:
            InputError: the store or the folder cannot be written to.
        """
        self._give(*self._append(record, rows, self.path(len(self))))

    def _append(
        self, record: Mapping[str, Any], rows: Descriptors, path: pathlib.Path
    ) -> tuple[Mapping[str, Any], pathlib.Path]:
        rows = np.ascontiguousarray(rows, self._dtype)
        whole = {**record, "sha256": _sha256(rows, self._dtype)}
        self.store.add(len(self), rows, whole)
        write_record(path, whole)
        self._take(whole, path)
        return whole, path

    def change(
        self, record: Mapping[str, Any], parts: Iterable[tuple[Mapping[str, Any], Descriptors]] = ()
    ) -> None:
        """Append segments and record a change: all are committed on return, and none before.

        Args:
            record: JSON values of the change, which `parts` may add to while it yields.
            parts: (record, rows) of each segment, as in `append`.

        Raises:
            InputError: the store or the folder cannot be written to.
        """
        first, number = len(self), self.changes
        added = list[tuple[Mapping[str, Any], pathlib.Path]]()
        path = self.change_path(number)
        try:
            for addition, rows in parts:
                waiting = self.path(len(self)).with_suffix(f".{number:010d}.json")
                added.append(self._append(addition, rows, waiting))
            whole = {**record, "rows": len(self)}
            write_record(path, whole)
        except BaseException:
            if not path.exists():
                self.remove_waiting()
                self.store.drop(first)
                kept = sum(span.first < first for span in self.spans)
                del self.spans[kept:], self.paths[kept:]
            raise
        self.changes += 1
        for each in (*added, (whole, path)):
            self._give(*each)

    def remove_waiting(self) -> int:
        """Remove the segments whose change was never committed, and return their number."""
        waiting = self.waiting()
        for record in reversed(waiting):  # so a kill leaves only rows without a record
            record.unlink()
            self.store.drop(_first_of(record))
        return len(waiting)

    def blocks(self) -> Iterator[Descriptors]:
        """Yield the rows of each segment in order."""
        for span in self.spans:
            yield self.store.read(span.first, span.count)

    def __getitem__(self, numbers: Int64[np.ndarray, " n"]) -> Descriptors:
        """Read rows by index, in any order."""
        return self.store.rows(numbers)

    def verify(self) -> None:
        """Read all rows, and compare them with the digests in the records.

        Raises:
            InputError: a row has changed; the message says in which segment.
        """
        for span, rows in zip(self.spans, self.blocks(), strict=True):
            if _sha256(rows, self._dtype) != span.sha256:
                raise InputError(
                    f"{self.path(span.first).with_suffix('')}: descriptors {span.first} to "
                    f"{span.first + span.count - 1} have changed since they were written"
                )


def _first_of(path: pathlib.Path) -> int:
    """Return the index of the first row of the segment recorded at `path`; -1 for other files."""
    first = path.name.partition(".")[0]
    return int(first) if first.isdecimal() else -1


def _check_all_read(listed: set[pathlib.Path], missing: pathlib.Path) -> None:
    if listed:
        raise InputError(f"{min(listed)}: expected {missing.name} before it, found no such file")


def _sha256(rows: np.ndarray, dtype: np.dtype) -> str:
    return hashlib.sha256(np.ascontiguousarray(rows, dtype).data).hexdigest()


def digest_of(names: Sequence[str], settings: Mapping[str, Any]) -> str:
    """Compute the SHA-256 of image names and settings, on which a folder's rows depend."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for name in names:
        digest.update(f"{name}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()
