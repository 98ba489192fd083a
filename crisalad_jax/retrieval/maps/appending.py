"""Append to maps and change them; every addition and every change is atomic.

An addition is a segment: its descriptors go to the store, then the record of its images is renamed
into place. That single rename commits the addition. A change, which removes, moves and adds images,
is a record too. If the writer is killed at any moment, the map is as it was before or after the
addition or change. docs/maps.md describes the format.
"""

import contextlib
import dataclasses
import datetime
import os
import pathlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from crisalad_jax.data.positions import Positions
from crisalad_jax.retrieval.bits import sign_vectors
from crisalad_jax.retrieval.chunks import Descriptors
from crisalad_jax.retrieval.maps.images import NewImages
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import (
    COMPONENTS,
    METADATA,
    SEGMENTS,
    MapMetadata,
    has_images,
    read_metadata,
)
from crisalad_jax.retrieval.maps.recovery import remove_unrecorded
from crisalad_jax.retrieval.pca import Pca, save_pca
from crisalad_jax.retrieval.segments import write_record
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.shapes import Float32
from crisalad_jax.utils.temporaries import made_folder, remove_temporaries

MOST_CHANGED = 10**6
"""Maximum number of images that one change, a single JSON record, may remove or move."""


class AppendableMap(Map):
    """A map that only this process may append to and change; see `open_for_appending`."""

    def fitted(self, names: Iterable[str], positions: Positions | None) -> Positions | None:
        """Return the positions of new images in the map's axes; None if none of them has one.

        Raises:
            InputError: they don't fit the map's axes or zone, see `Positions.fitted`.
        """
        if positions is None:
            return None
        of = {name: positions.of[name] for name in names if name in positions.of}
        return positions._replace(of=of).fitted(self.folder, self.axes, self.zone) if of else None

    def append(
        self,
        names: Sequence[str],
        sizes: Sequence[int],
        descriptors: Descriptors,
        *,
        root: str,
        positions: Positions | None = None,
    ) -> None:
        """Append images atomically: once this returns, all of them are stored; before, none are.

        Args:
            names: paths of the images relative to `root`, none of them in the map yet.
            sizes: sizes of their files, in bytes.
            descriptors: unit vectors, or anything else `search` takes; stored in the map's type.
            root: the folder of these images.
            positions: where they were taken, as far as known; converted to the map's UTM zone.

        Raises:
            InputError: a name is in the map already or given twice, descriptors are not unit
                vectors, positions don't fit the map's axes or zone, the store cannot be written to,
                or the map is no longer where it was opened.
        """
        self._check_there()
        part = NewImages(names, sizes, descriptors, root, self.fitted(names, positions))
        self._segments.append(*self._addition(part))

    def change(
        self,
        verb: Literal["remove", "replace", "move", "merge"],
        *,
        removed: Iterable[int] = (),
        moved: Positions | None = None,
        added: Iterable[NewImages] = (),
    ) -> None:
        """Remove, move and append images in one atomic change.

        The remaining images are renumbered from 0, in order.

        Args:
            verb: the reason, which is recorded. "replace" also removes images named in `added`.
            removed: indices of the images to remove.
            moved: new positions by image name, as `fitted_anew` returns them; None moves no image.
            added: new images.

        Raises:
            InputError: no image is left, more than `MOST_CHANGED` change, or `append` would fail.
        """
        self._check_there()
        gone = set(removed)
        axes, new, zone = moved or (self.axes, {}, self.zone)
        record = {
            "verb": verb,
            "changed": _now(),
            "removed": [],
            "moved": self._rows_of(map(self._number, new)),
            "positions": list(new.values()),
            "axes": axes,
            "zone": zone,
        }

        def parts() -> Iterator[tuple[Mapping[str, Any], Descriptors]]:
            taken = set[str]()
            for part in added:
                if verb == "replace":
                    gone.update(map(self._number, part.names))
                if part.positions is not None:
                    positions = part.positions.fitted(
                        part.source or part.root, record["axes"], record["zone"]
                    )
                    part = part._replace(positions=positions)
                    record["axes"] = positions.axes
                    record["zone"] = positions.zone or record["zone"]
                yield self._addition(part, gone, taken)
                taken.update(part.names)
            if not taken and len(gone) == len(self):
                raise InputError(
                    f"{self.folder}: found all its {len(self)} images to be removed, expected at "
                    "least one to stay (to delete the map, remove its folder)"
                )
            if len(gone) + len(new) > MOST_CHANGED:
                raise InputError(
                    f"{self.folder}: found a change of {len(gone) + len(new)} images, expected at "
                    f"most {MOST_CHANGED} at a time"
                )
            record["removed"] = self._rows_of(sorted(gone))

        self._segments.change(record, parts())

    def fitted_anew(self, positions: Positions) -> Positions:
        """Convert new positions of images to the map's axes and zone.

        Positions in other axes stay as they are if no other image of the map has a position.

        Raises:
            InputError: they don't fit the map's axes or zone, see `Positions.fitted`.
        """
        axes, zone = self.axes, self.zone
        if positions.axes != axes and not any(
            image.position is not None and image.name not in positions.of for image in self.images
        ):
            axes = zone = None
        found = positions.fitted(self.folder, axes, zone)
        return found._replace(zone=found.zone or zone)

    def _check_there(self) -> None:
        if not self.exists:
            raise InputError(f"{self.folder}: found the opened map gone, expected it to be here")

    def _rows_of(self, numbers: Iterable[int]) -> list[int]:
        return self.removed.rows_of(np.fromiter(numbers, np.int64)).tolist()

    def _addition(
        self, part: NewImages, gone: Collection[int] = (), taken: Collection[str] = ()
    ) -> tuple[dict[str, Any], Descriptors]:
        """Return the record of new images, and their descriptors.

        Args:
            part: the images.
            gone: indices of removed images, whose names may be used again.
            taken: names that may not be used, in addition to those in the map.

        Raises:
            InputError: a name is in the map already or given twice; or what `_rows` raises.
        """
        descriptors = self._rows("descriptors", part.descriptors)
        there = map(self.images.find, part.names)
        pairs = zip(part.names, there, strict=True)
        free = {name for name, number in pairs if number is None or number in gone}
        if twice := len(part.names) - len(free.difference(taken)):
            raise InputError(
                f"{self.folder}: found {twice} of {len(part.names)} names twice, or in the map "
                "already, expected new ones"
            )
        axes, known, zone = part.positions or (None, {}, None)
        record = {
            "root": part.root,
            "added": part.added or _now(),
            "axes": axes,
            "zone": zone,
            "names": list(part.names),
            "bytes": list(part.sizes),
            "positions": [known.get(name) for name in part.names],
        }
        return record, descriptors

    def as_stored(self, descriptors: Descriptors) -> Float32[np.ndarray, "n d"]:
        """Round descriptors as the map stores them; for bits, return unit vectors of the signs."""
        rows = self._rows("descriptors", descriptors).astype(self.metadata.row[1], copy=False)
        return sign_vectors(rows) if self.metadata.is_bits else rows.astype(np.float32, copy=False)


@contextlib.contextmanager
def open_for_appending(
    folder: str | os.PathLike[str], metadata: MapMetadata, components: Pca | None = None
) -> Iterator[AppendableMap]:
    """Open the map with this metadata for appending, or create it with these components.

    One process at a time may append, while others search. A map that a kill left without images is
    created again; if an exception leaves it without images, it is removed. Descriptors without a
    record are removed with a warning.

    Raises:
        InputError: another process is appending; the folder holds a different map, or one that has
            lost a record or is damaged otherwise; or the folder cannot be written to.
    """
    folder = pathlib.Path(folder)
    read_metadata(folder)  # raises if something else is there, before anything is created
    with contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder / SEGMENTS))
        stack.enter_context(lock(folder))
        existing = read_metadata(folder)
        if existing is not None and existing != metadata:
            raise InputError(f"{folder}: found a map with other metadata, expected that given")
        for each in (folder, folder / SEGMENTS):
            remove_temporaries(each)
        if existing is None:
            remove_unrecorded(folder, 0)
        try:
            if existing is None:
                if components is not None:
                    save_pca(folder / COMPONENTS, components)
                write_record(folder / METADATA, dataclasses.asdict(metadata), indent=2)
            opened = stack.enter_context(AppendableMap._opened(folder, existing or metadata))
            if existing is not None:
                remove_unrecorded(folder, len(opened._segments))
                if waiting := opened._segments.remove_waiting():
                    warn(
                        f"{folder}: {counted(waiting, 'addition')} of an unfinished change removed"
                    )
            yield opened
        except BaseException:
            if not has_images(folder):
                for name in (METADATA, COMPONENTS):
                    (folder / name).unlink(missing_ok=True)
                for path in (folder / SEGMENTS).glob("[0-9]*.npy"):
                    path.unlink()
            raise


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
