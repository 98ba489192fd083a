"""Keyframes by similarity: leave out images that look like the last one that was selected.

Left-out images are recorded next to the map's images, so that they are not described again. The
records only save work: without them the same images are left out.
"""

from collections.abc import Sequence

import numpy as np

from crisalad_jax.data.sources import ImageSource, sequence_of
from crisalad_jax.retrieval.maps.appending import AppendableMap
from crisalad_jax.retrieval.segments import write_record
from crisalad_jax.utils.files import read_json
from crisalad_jax.utils.shapes import Bool, Float32
from crisalad_jax.utils.temporaries import remove_temporaries

SIMILAR = "similar"
"""Folder in a map with the records of left-out images."""


class Novelty:
    """Choice of the images that a map takes from a source, in order, as they are described."""

    def __init__(self, target: AppendableMap, source: ImageSource, root: str, most: float) -> None:
        """Read which images were left out before.

        Args:
            target: the map, open for appending.
            source: the images.
            root: the folder of these images, as the map names it.
            most: maximum similarity to the last selected image.

        Raises:
            InputError: a record is damaged.
        """
        self._map, self._paths = target, dict(zip(source.names, source.paths, strict=True))
        self._settings = {"root": root, "novelty": most}
        self._order = iter(source.names)
        self._last: dict[object, str | Float32[np.ndarray, " d"]] = {}
        """By sequence, the name or the descriptor of the last image that the map took."""
        self.left_out: dict[str, int] = {}
        """Sizes in bytes of the images that were left out, by name."""
        self._folder = target.folder / SIMILAR
        remove_temporaries(self._folder)
        self._records = sorted(self._folder.glob("[0-9]*.json"))
        for path in self._records:
            record = read_json(path, "a record of images that were left out")
            if {key: record.get(key) for key in self._settings} == self._settings:
                self.left_out |= dict(zip(record["names"], record["bytes"], strict=True))

    def choose(
        self, names: Sequence[str], descriptors: Float32[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Return which of the next images differ enough from the last selected one."""
        rows = self._map.as_stored(descriptors)
        return np.array([self._is_new(*each) for each in zip(names, rows, strict=True)], bool)

    def _is_new(self, name: str, row: Float32[np.ndarray, " d"]) -> bool:
        for before in self._order:
            if before == name:
                break
            if self._map.image(before) is not None:
                self._last[sequence_of(self._paths[before])] = before
        sequence = sequence_of(self._paths[name])
        last = self._last.get(sequence)
        if isinstance(last, str):
            last = self._map.descriptors_of([last])[0]
        if last is not None and last @ row > self._settings["novelty"]:
            return False
        self._last[sequence] = row
        return True

    def leave_out(self, names: Sequence[str], sizes: Sequence[int]) -> None:
        """Record that images were left out, with the sizes of their files in bytes."""
        path = self._folder / f"{len(self._records):010d}.json"
        write_record(path, {**self._settings, "names": list(names), "bytes": list(sizes)})
        self._records.append(path)
