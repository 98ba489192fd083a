"""Maps that several processes make: a map of each share, which the last one to end joins."""

import dataclasses
import pathlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.data.positions import Positions
from crisalad_jax.retrieval.maps.head import SHARES, has_images
from crisalad_jax.retrieval.maps.manifest import MapDescription, read_description
from crisalad_jax.retrieval.maps.map import Map, MapImage, open_for_appending
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.retrieval.shares import Share
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.locks import BusyFolderError, lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar

_TOGETHER = 4096
"""Number of images that are joined as one addition: a search opens fewer files."""


class SharedMap(NamedTuple):
    """A map that several processes make, each of its share of the images."""

    out: pathlib.Path
    """The map's folder."""
    share: Share
    """The share of this process."""
    digest: str
    """Of all that the shares have in common."""
    description: MapDescription
    """Of the map."""
    components: Pca | None

    def folder(self, share: Share) -> pathlib.Path:
        """Return the folder of a share's own map, which is removed when it is joined."""
        return self.out / SHARES / share.name

    def marker(self, share: Share) -> pathlib.Path:
        """Return the file that says that a share is done."""
        return self.out / SHARES / f"{share.name}.json"

    def counts(self, share: Share) -> dict[str, Any] | None:
        """Return what became of a share's images; None while it is not done."""
        path = self.marker(share)
        if not path.exists():
            return None
        value = read_json(path, "a record of a share")
        if value.get("shares") != self.digest:
            warn(
                f"{path}: found a share of other images or settings; its process has to run again, "
                "as the others do"
            )
            return None
        return value

    def left(self) -> int:
        """Count the shares that are not done."""
        return sum(self.counts(share) is None for share in self.share.others())

    def describe(self, work: Callable[[Map], dict[str, Any]]) -> None:
        """Describe this process's share in a map of its own, and say that it is done.

        Raises:
            InputError: a share of other settings is there, or another count of shares; what `work`
                raises.
        """
        folder = self.folder(self.share)
        others = [
            path.name
            for path in sorted((self.out / SHARES).glob("*-of-*"))
            if not path.stem.endswith(f"-of-{self.share.count}")
        ]
        if others:
            raise InputError(
                f"{self.out / SHARES}: found {others[0]}, expected {self.share.count} shares as "
                "before, or none: remove the folder to begin anew"
            )
        there = read_description(folder)
        mine = dataclasses.replace(self.description, store="files")
        if there is not None and has_images(folder):
            same = dataclasses.replace(
                there,
                created=mine.created,
                collection=mine.collection,
                weights=mine.weights,
            )
            if same != mine:
                raise InputError(
                    f"{folder}: found a share of another model or other settings, expected those "
                    "of before; remove it to begin anew"
                )
            mine = there
        with open_for_appending(folder, mine, self.components) as target:
            counts = work(target)
            empty = not len(target)
        if empty:
            shutil.rmtree(folder)
        write_json(self.marker(self.share), {"shares": self.digest, **counts})

    def join(self, then: Callable[[Map], None], *, quiet: bool) -> list[dict[str, Any]] | None:
        """Join all shares in the map, and remove them; None where another process does or did.

        A call after a kill goes on: images that the map has already are left out.

        Args:
            then: what is done with the whole map while its lock is held.
            quiet: no progress bar.

        Raises:
            InputError: a share is damaged or gone; what `Map.append` and `then` raise.
        """
        try:
            with lock(self.out / SHARES):
                found = [self.counts(share) for share in self.share.others()]
                counts = [each for each in found if each is not None]
                if len(counts) < len(found):
                    return None  # another process has joined them
                existing = read_description(self.out) if has_images(self.out) else None
                description = existing or self.description
                with open_for_appending(self.out, description, self.components) as target:
                    self._append(target, sum(each["added"] for each in counts), quiet)
                    then(target)
                for share in self.share.others():
                    self.marker(share).unlink()
        except BusyFolderError:
            warn(f"{self.out}: another process joins the shares")
            return None
        shutil.rmtree(self.out / SHARES, ignore_errors=True)
        return counts

    def _append(self, target: Map, images: int, quiet: bool) -> None:
        with progress_bar("joining", images, "images", quiet=quiet) as bar:
            for share in self.share.others():
                folder = self.folder(share)
                if not folder.exists():
                    continue  # it is joined, or had no new image
                with Map.open(folder) as part:
                    for images_there, rows in _additions(part):
                        bar.advance(len(images_there))
                        new = [
                            i for i, one in enumerate(images_there) if not target.image(one.name)
                        ]
                        if new:
                            _add(target, [images_there[i] for i in new], rows[new], part)
                shutil.rmtree(folder)


def _additions(part: Map) -> Iterator[tuple[Sequence[MapImage], np.ndarray]]:
    """Yield a map's images with their descriptors, some thousand at a time."""
    waiting: list[np.ndarray] = []
    start = end = 0
    for rows in part.descriptors:
        waiting.append(rows)
        end += len(rows)
        if end - start >= _TOGETHER or end == len(part):
            yield part.images[start:end], np.concatenate(waiting)
            waiting.clear()
            start = end


def _add(target: Map, images: Sequence[MapImage], rows: np.ndarray, part: Map) -> None:
    of = {image.name: image.position for image in images if image.position is not None}
    target.append(
        [image.name for image in images],
        [image.bytes for image in images],
        rows,
        root=images[0].root,
        positions=None if part.axes is None else Positions(part.axes, of, part.zone),
    )
