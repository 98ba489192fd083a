"""Maps: a folder of descriptors with a description of itself, which grows by appending.

Each addition is a segment: its descriptors go to the store, then the record of its images appears
under its name. That single rename commits the addition. A change, which removes, moves and adds
images, is a record too. A map whose writer is killed at any moment is as it was before the addition
or change, or after it. docs/maps.md has the format.
"""

import bisect
import collections
import contextlib
import dataclasses
import datetime
import functools
import itertools
import operator
import os
import pathlib
import weakref
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, cast

import numpy as np

from crisalad_jax.checkpoints.engines import EngineName
from crisalad_jax.checkpoints.runtime import Runtime, open_runtime
from crisalad_jax.config.checks import PATH, check_count, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import AXES, Positions
from crisalad_jax.retrieval.bits import sign_vectors, to_bits
from crisalad_jax.retrieval.chunks import Descriptors, Queries, as_unit_rows
from crisalad_jax.retrieval.describer import Describer, describer_of
from crisalad_jax.retrieval.maps.approximate import (
    Approximate,
    build_approximate,
    check_search,
    choose_search,
    open_approximate,
    stale_kind,
)
from crisalad_jax.retrieval.maps.calibration import Calibration, read_calibration
from crisalad_jax.retrieval.maps.contents import MapAddition, additions_of, contents
from crisalad_jax.retrieval.maps.metadata import (
    COMPONENTS,
    METADATA,
    SEGMENTS,
    MapMetadata,
    check_model,
    existing_metadata,
    has_images,
    model_config,
    read_components,
    read_metadata,
    weights_of,
)
from crisalad_jax.retrieval.maps.recovery import remove_unrecorded
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.maps.store import open_store
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.pca import Pca, save_pca
from crisalad_jax.retrieval.segments import Segments, write_record
from crisalad_jax.retrieval.verification.results import Verification
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.shapes import Float32, Int64
from crisalad_jax.utils.temporaries import made_folder, remove_temporaries

if TYPE_CHECKING:  # a map is searched without JAX
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model


@brief
class MapImage(NamedTuple):
    """An image of a map: everything but its descriptor."""

    name: str
    """Its posix path relative to `root`; no two images of a map share one."""
    bytes: int
    """Size of the described file in bytes; a file of another size is another picture."""
    position: tuple[float, float] | None
    root: str


class NewImages(NamedTuple):
    """Images to be appended, all from one folder; see `Map.append`."""

    names: Sequence[str]
    sizes: Sequence[int]
    descriptors: Descriptors
    root: str
    positions: Positions | None = None
    added: str | None = None
    """The time when they were described; None is now."""
    source: object = None
    """What messages call them; None is their root."""

    def only(self, chosen: Sequence[bool]) -> "NewImages":
        """Return those of the images that are chosen."""
        names, sizes = (
            list(itertools.compress(column, chosen)) for column in (self.names, self.sizes)
        )
        return self._replace(
            names=names, sizes=sizes, descriptors=self.descriptors[np.array(chosen)]
        )


MOST_CHANGED = 10**6
"""Number of images that one change removes or moves at most, whose record JSON has room for."""


@brief
class Answer(NamedTuple):
    """One image of a map, as an answer to a query."""

    rank: int
    """Rank from 1, the most similar."""
    similarity: float
    """Cosine of the two descriptors; of bits 1 - 2 h / d, where h of the d bits differ."""
    image: MapImage
    """The image: its name, and where it was taken."""
    probability: float | None = None
    """Probability that the camera is there; None without a filter."""
    verification: Verification | None = None
    """What local features show; None where the answer was not verified."""


def ranked(
    images: Sequence[MapImage],
    numbers: Int64[np.ndarray, " k"],
    similarities: Float32[np.ndarray, " k"],
) -> list[Answer]:
    """Return the answers to one query, of images by number."""
    pairs = zip(numbers, similarities, strict=True)
    return [Answer(rank, float(value), images[i]) for rank, (i, value) in enumerate(pairs, 1)]


class Map:
    """An open map: made by `Map.open` to search it, or by `open_for_appending`.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, Reading, index, init_crisalad, save_weights
        >>> model = Model(init_crisalad(jax.random.key(0), PRESETS["tiny"]), PRESETS["tiny"])
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=Reading(quiet=True))
        >>> places = Map.open(folder / "map")
        >>> len(places)
        4
        >>> places.locate(pictures / "2.png", k=1)[0].image.name
        '2.png'
    """

    def __init__(self, folder: pathlib.Path, metadata: MapMetadata, segments: Segments) -> None:
        """Read what the records say of the images."""
        self.folder = folder
        self.metadata = metadata
        """The contents of map.json."""
        self.images: list[MapImage] = []
        """The images by number; those that were removed have none."""
        self.removed = NONE
        """What was removed, by the row of each in the store, which no change alters."""
        self.changed = ""
        """When images were last removed, replaced or merged into it; empty for never."""
        self.axes: tuple[str, str] | None = None
        """Axes of the positions, see `positions.AXES`; None where no image has a position."""
        self.zone: Zone | None = None
        """Zone of UTM of all positions in metres east and north; None where it is unknown."""
        self.calibration: Calibration | None = None
        """What `calibrate` measured; None where it did not, or the map is open for appending."""
        self.components = read_components(folder, metadata)
        """The components that shorten descriptors, and those of queries; None is none."""
        self._segments, self._numbers = segments, dict[str, int]()
        self._stored: list[MapImage] = []
        """The images by row, those that were removed included."""
        self._gone = set[int]()
        """Rows that were removed."""
        self._parts: list[tuple[str | None, str, int]] = []
        """Of each record of images the time, the root and the first row."""
        self._calibrated = False
        self._opened_at = os.stat(segments.folder)
        self._close = weakref.finalize(self, segments.store.close)
        self._approximate: Approximate | None = None
        self._describer: tuple[object, Describer] | None = None
        """A model that is known to be the one that made the map, and what describes with it."""
        changes = [
            (record["rows"], self._read_change, record, segments.change_path(number))
            for number, record in enumerate(segments.changes)
        ]
        columns = zip(segments.spans, segments.records, segments.paths, strict=True)
        parts = [(span.first, self._read_record, record, path) for span, record, path in columns]
        # A change of n rows came before the images of row n.
        for _, read, record, path in sorted(changes + parts, key=operator.itemgetter(0)):
            read(record, path)
        self._settle()

    @classmethod
    @takes(folder=PATH)
    def open(
        cls, folder: str | os.PathLike[str], *, verify: bool = True, calibrated: bool = True
    ) -> Self:
        """Open a map to search it as it is now; images appended meanwhile are not seen.

        A note says so of an approximate search that is not of all images, and is not used.

        Args:
            folder: what `index` made.
            verify: whether to read all descriptors that are in files, as `verify` does; records
                are always checked.
            calibrated: whether to read what `calibrate` measured; a map without it answers every
                query, also where that file is damaged.

        Returns:
            The map. It lets go of its store when it is closed, at the end of a `with`, or when
            nothing refers to it any more.

        Raises:
            InputError: there is no map, it has no images yet, or it or its store is damaged,
                changed, gone, or of another format.

        Example:
            >>> with Map.open("no-map") as places:
            ...     len(places)
            Traceback (most recent call last):
            ...
            crisalad_jax.utils.errors.InputError: no-map: found no map, expected a folder that ...
        """
        folder = pathlib.Path(folder)
        metadata = existing_metadata(folder)
        opened = cls._opened(folder, metadata)
        opened._calibrated = calibrated
        if calibrated:
            opened.calibration = read_calibration(folder, metadata.model)
            if opened.calibration is not None and opened.changed > opened.calibration.created:
                warn(
                    f"{folder}: its images were changed ({opened.changed[:10]}) since its least "
                    f"similarity was measured ({opened.calibration.created[:10] or 'unknown'}); "
                    "`crisalad calibrate` measures it again"
                )
        if verify and metadata.store == "files":
            opened.verify()
        opened._approximate = open_approximate(folder, opened._segments, verify=verify)
        if (kind := opened.stale_search) is not None:
            warn(
                f"{folder}: found an approximate search of fewer or other images; the map is "
                f"searched exactly; `crisalad index --search {kind}` builds it again"
            )
        return opened

    @classmethod
    def _opened(cls, folder: pathlib.Path, metadata: MapMetadata) -> Self:
        length, dtype = metadata.row
        store = open_store(
            metadata.store,
            folder,
            collection=metadata.collection,
            length=length,
            dtype=dtype,
            new=not has_images(folder),
        )
        try:
            return cls(folder, metadata, Segments(folder / SEGMENTS, store, dtype))
        except BaseException:
            store.close()
            raise

    def __enter__(self) -> Self:
        """Return the map itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the map."""
        self.close()

    def __repr__(self) -> str:
        """Return one line for a notebook."""
        length = self.metadata.length_words
        return f"Map({str(self.folder)!r}: {len(self)} images, {length} each)"

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)

    @functools.cached_property
    def config(self) -> "ModelConfig":
        """Configuration of the model, at the image size and in the type of the map's images.

        Raises:
            InputError: it is not one that this package knows.
        """
        return model_config(self.metadata, self.folder)

    @property
    def exists(self) -> bool:
        """Whether the map is still where it was opened: it was not moved, removed or replaced."""
        with contextlib.suppress(OSError):
            there = os.stat(self._segments.folder)
            return os.path.samestat(there, self._opened_at) and (self.folder / METADATA).is_file()
        return False

    def refreshed(self) -> Self:
        """Return the map as it is now: this one or, where it was changed, a new one for its place.

        Raises:
            InputError: as `open`.
        """
        if not self._segments.has_more or not self.exists:
            return self
        self.close()
        again = type(self).open(self.folder, verify=False, calibrated=self._calibrated)
        again._describer = self._describer
        return again

    @property
    def additions(self) -> list[MapAddition]:
        """What was appended, in order: from which folder, on which day, and how many are left."""
        ends = np.array([*(first for *_, first in self._parts), len(self._stored)], np.int64)
        counts = np.diff(self.removed.numbers_of(ends)).tolist()
        pairs = zip(self._parts, counts, strict=True)
        return additions_of([(time, root, images) for (time, root, _), images in pairs])

    def was_removed(self, name: str, size: int | None = None) -> bool:
        """Return whether an image of this name, and of this size if that is given, was removed."""
        sizes = self.removed_names.get(name, ())
        return name not in self._numbers and (bool(sizes) if size is None else size in sizes)

    @functools.cached_property
    def removed_names(self) -> dict[str, set[int]]:
        """Names of the images that were removed or replaced, with the sizes of their files."""
        sizes = collections.defaultdict[str, set[int]](set)
        for row in self._gone:
            sizes[self._stored[row].name].add(self._stored[row].bytes)
        return sizes

    def image(self, name: str) -> MapImage | None:
        """Return what the map knows of the image of this name; None if it has none."""
        number = self._numbers.get(name)
        return None if number is None else self.images[number]

    def _read_record(self, record: Mapping[str, Any], path: pathlib.Path) -> None:
        """Take the images of a record.

        Raises:
            InputError: a value is missing or of another type.
        """
        try:
            root, added = record["root"], record["added"]
            columns = (record["names"], record["bytes"], record["positions"])
            images = [
                MapImage(_inside(name), int(size), at and (float(at[0]), float(at[1])), root)
                for name, size, at in zip(*columns, strict=True)
            ]
            axes, zone = _axes_in(record)
            Positions(axes or AXES[2], {i.name: i.position for i in images if i.position}).check()
            if not isinstance(root, str) or not isinstance(added, str | None):
                raise TypeError(f"found root {root!r}, expected text, and added {added!r}, a time")
        except (ValueError, LookupError, TypeError, OverflowError) as error:
            raise InputError(f"{path}: not a whole record of images: {error!r}") from error
        self._parts.append((added, root, len(self._stored)))
        self._stored += images
        self.axes, self.zone = self.axes or axes, self.zone or zone

    def _read_change(self, record: Mapping[str, Any], path: pathlib.Path) -> None:
        """Take what a record of a change says.

        Raises:
            InputError: a value is missing or of another type.
        """
        try:
            rows = [*record["removed"], *record["moved"]]
            if not all(isinstance(row, int) and 0 <= row < len(self._stored) for row in rows):
                raise ValueError(f"found rows beyond {len(self._stored)} or no numbers")
            pairs = zip(record["moved"], record["positions"], strict=True)
            moved = {row: (float(at[0]), float(at[1])) for row, at in pairs}
            self.axes, self.zone = _axes_in(record)
            Positions(self.axes or AXES[2], {str(row): at for row, at in moved.items()}).check()
            if not isinstance(record["changed"], str):
                raise TypeError("found no time")
        except (ValueError, LookupError, TypeError, OverflowError) as error:
            raise InputError(f"{path}: not a whole record of a change: {error!r}") from error
        for row, at in moved.items():
            self._stored[row] = self._stored[row]._replace(position=at)
        self._gone.update(record["removed"])
        if record["verb"] != "move":
            self.changed = record["changed"]

    def _settle(self, first: int = 0) -> None:
        """Number the images from a row on, of which those before it have their numbers.

        Raises:
            InputError: a name stands twice.
        """
        if not first:  # new ones, as answers hold the old
            self.images, self._numbers = [], {}
            self.removed = Removed(np.array(sorted(self._gone), np.int64))
            self.__dict__.pop("removed_names", None)
        rows = (row for row in range(first, len(self._stored)) if row not in self._gone)
        images = [self._stored[row] for row in rows]
        self._numbers |= {image.name: i for i, image in enumerate(images, len(self))}
        self.images += images
        if len(self._numbers) < len(self.images):
            pairs = enumerate(self.images)
            twice = next(image.name for i, image in pairs if self._numbers[image.name] != i)
            row = self.removed.rows_of(np.array(self._numbers[twice]))
            firsts = [span.first for span in self._segments.spans]
            path = self._segments.paths[bisect.bisect(firsts, row) - 1]
            raise InputError(f"{path}: not a whole record of images: a name stands twice")

    def search(self, queries: Queries, k: int, *, exact: bool = False) -> Neighbours:
        """Find the k most similar images of each query, best first; all where there are fewer.

        Search is exact, by inner product, or by equal bits in a map of these; of equal similarities
        the earlier image stands first.
        A map with an approximate search finds nearly all of them. Their similarities are exact.

        Args:
            queries: unit descriptors, of the map's model, shortened by its `components`. A map of
                bits takes those of any length, and packed bits.
            k: neighbours per query.
            exact: whether to search exactly although the map has an approximate search.

        Raises:
            InputError: no queries, descriptors that are no unit vectors of the map's length, k
                below 1; or the store is damaged or gone.
        """
        check_count("k", k)
        queries = self._rows("queries", queries)
        k = min(k, len(self))
        if self._approximate is not None and not exact:
            return self._approximate.search(queries, k, len(self._segments), self.removed)
        return self._segments.store.search(queries, k, len(self._segments), self.removed)

    @property
    def search_kind(self) -> str:
        """How `search` searches: "exact", "hnsw" or "ivf-rabitq"."""
        return "exact" if self._approximate is None else self._approximate.kind

    @property
    def stale_search(self) -> str | None:
        """Kind of an approximate search that is not used, as it is of fewer or other images."""
        return stale_kind(self.folder, self._segments.spans) if self._approximate is None else None

    def shorten(self, descriptors: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n short"]:
        """Shorten a model's descriptors by the map's `components`; without any they stay."""
        return descriptors if self.components is None else self.components.apply(descriptors)

    def build_search(self, kind: str, *, quiet: bool = True) -> float | None:
        """Build the map's approximate search from its descriptors, where it is not there yet.

        Args:
            kind: "hnsw" or "ivf-rabitq"; "exact" removes what there is; "auto" chooses by the
                size of the descriptors and the memory available, and a note says why.
            quiet: whether to show no progress bar.

        Returns:
            The share of the exact 10 nearest others that are found of 100 of its images; None of
            an exact search.

        Raises:
            InputError: an unknown kind, or a map of bits or in Milvus.
        """
        metadata = self.metadata
        check_search(kind, metadata.store, metadata.dtype)
        if kind == "auto":
            size = len(self._segments), metadata.descriptor_length
            kind, why = choose_search(*size, metadata.dtype, metadata.store)
            warn(f"{self.folder}: --search auto takes {kind}: {why}")
        self._approximate = build_approximate(self.folder, kind, self._segments, quiet=quiet)
        return None if self._approximate is None else self._approximate.recall

    def locate(
        self,
        image: np.ndarray | str | os.PathLike[str],
        k: int = 5,
        *,
        model: "Model | Runtime | None" = None,
    ) -> list[Answer]:
        """Find the images of the map that are most similar to one image.

        The first call loads the model that made the map, and compiles it; later ones do neither.
        `query` asks for many images at once.

        Args:
            image: 8-bit RGB, as `read_image` returns it, or grey (height, width) or (height,
                width, 1), such as ROS's mono8; or its file.
            k: number of answers; all where the map has fewer.
            model: the model that made the map; None loads it from where it was.

        Returns:
            The answers, best first. Positions are in `axes`.

        Raises:
            InputError: a file that cannot be read, an array that `prepare_image` does not take, k
                below 1; what `load_model`, `describer` and `search` raise.

        Example:
            >>> import jax
            >>> from crisalad_jax import (
            ...     PRESETS, Model, Reading, index, init_crisalad, read_image, save_weights
            ... )
            >>> config = PRESETS["tiny"]
            >>> model = Model(init_crisalad(jax.random.key(0), config), config)
            >>> weights = folder / "weights.safetensors"
            >>> save_weights(weights, model)
            >>> quiet = Reading(quiet=True)
            >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
            >>> answers = Map.open(folder / "map").locate(read_image(pictures / "3.png"), k=2)
            >>> [(answer.rank, answer.image.name) for answer in answers][0]
            (1, '3.png')
        """
        from crisalad_jax.retrieval.describe import describe_images

        pixels = read_pixels(image) if isinstance(image, str | os.PathLike) else image
        descriptor = describe_images(self.describer(model), [pixels])
        found = self.search(self.shorten(descriptor), k)
        return ranked(self.images, found.indices[0], found.similarities[0])

    def similarities(self, queries: Queries) -> Float32[np.ndarray, "q n"]:
        """Compute the similarities of queries to all images, in the order of the images.

        Args:
            queries: as `search` takes them.

        Raises:
            InputError: as `search`.
        """
        queries = self._rows("queries", queries)
        queries = sign_vectors(queries) if self.metadata.is_bits else queries
        parts = [queries @ part.astype(np.float32, copy=False).T for part in self.descriptors]
        return np.concatenate(parts, axis=1)

    def _rows(self, name: str, rows: Descriptors) -> Any:
        """Check descriptors, and return them as they are compared: unit vectors or packed bits."""
        convert = to_bits if self.metadata.is_bits else as_unit_rows
        return convert(rows, name, self.metadata.descriptor_length)

    def fitted(self, names: Iterable[str], positions: Positions | None) -> Positions | None:
        """Return the positions of new images in the map's axes; None where none of them has one.

        Raises:
            InputError: they have no place there, see `Positions.fitted`.
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
        """Append images: all of them are there for good once this returns, and none before.

        Args:
            names: relative to `root`, none of which the map has.
            sizes: of their files, in bytes.
            descriptors: unit vectors, or what else `search` takes; stored as the map's type.
            root: the folder of these images.
            positions: where they were taken, as far as that is known; those of another zone of UTM
                become the map's.

        Raises:
            InputError: a name that is there already or twice, descriptors that are no unit vectors,
                positions that have no place among the map's, a store that cannot be written to, or
                a map that is no longer where it was opened.
        """
        self._check_there()
        first = len(self._segments)
        part = NewImages(names, sizes, descriptors, root, self.fitted(names, positions))
        self._segments.append(*self._addition(part, self._numbers.keys()))
        self._read_record(self._segments.records[-1], self._segments.paths[-1])
        self._settle(first)

    def change(
        self,
        verb: Literal["remove", "replace", "move", "merge"],
        *,
        removed: Iterable[int] = (),
        moved: Positions | None = None,
        added: Iterable["NewImages"] = (),
    ) -> None:
        """Remove, move and append images: all of it counts once this returns, and none before.

        The images that are left have other numbers then.

        Args:
            verb: why. "replace" also removes the images that have the names of those that are
                added.
            removed: numbers of images.
            moved: new positions, by the names of images; in other axes than the map's only where no
                other image has one.
            added: new images.

        Raises:
            InputError: no image would be left, more than `MOST_CHANGED` of them, or what `append`
                raises.
        """
        self._check_there()
        gone = set(removed)
        stay = [image for number, image in enumerate(self.images) if number not in gone]
        axes, zone, new = self.axes, self.zone, {}
        if moved is not None:
            moved = self.fitted_anew(moved)
            axes, zone, new = moved.axes, moved.zone, moved.of
        record = {
            "verb": verb,
            "changed": _now(),
            "removed": [],
            "moved": self._rows_of(self._numbers[name] for name in new),
            "positions": list(new.values()),
            "axes": axes,
            "zone": zone,
        }

        def parts() -> Iterator[tuple[Mapping[str, Any], Descriptors]]:
            taken = {image.name for image in stay}
            for part in added:
                if verb == "replace":
                    gone.update(self._numbers[name] for name in part.names)
                    taken.difference_update(part.names)
                if part.positions is not None:
                    positions = part.positions.fitted(
                        part.source or part.root, record["axes"], record["zone"]
                    )
                    part = part._replace(positions=positions)
                    record["axes"] = positions.axes
                    record["zone"] = positions.zone or record["zone"]
                yield self._addition(part, taken)
                taken.update(part.names)
            if not taken:
                raise InputError(
                    f"{self.folder}: found all its {len(self)} images to be removed, expected at "
                    "least one to stay: a map without images is none, so remove its folder instead"
                )
            if len(gone) + len(new) > MOST_CHANGED:
                raise InputError(
                    f"{self.folder}: found a change of {len(gone) + len(new)} images, expected at "
                    f"most {MOST_CHANGED} at a time"
                )
            record["removed"] = self._rows_of(sorted(gone))

        known = len(self._segments.spans)
        self._segments.change(record, parts())
        for each in range(known, len(self._segments.spans)):
            self._read_record(self._segments.records[each], self._segments.paths[each])
        number = len(self._segments.changes) - 1
        self._read_change(self._segments.changes[number], self._segments.change_path(number))
        self._settle()

    def fitted_anew(self, positions: Positions) -> Positions:
        """Return new positions of images in the map's axes and zone; in their own if no other has.

        Raises:
            InputError: they have no place there, see `Positions.fitted`.
        """
        axes, zone = self.axes, self.zone
        if positions.axes != axes and not any(
            image.position is not None and image.name not in positions.of for image in self.images
        ):
            axes = zone = None
        found = positions.fitted(self.folder, axes, zone)
        return found._replace(zone=found.zone or zone)

    def _rows_of(self, numbers: Iterable[int]) -> list[int]:
        return self.removed.rows_of(np.fromiter(numbers, np.int64)).tolist()

    def positions_of(self, names: Iterable[str]) -> Positions | None:
        """Return the positions of some images; None where none of them has one."""
        pairs = ((name, self.images[self._numbers[name]].position) for name in names)
        of = {name: at for name, at in pairs if at is not None}
        return Positions(self.axes, of, self.zone) if self.axes and of else None

    def added(self, name: str) -> str | None:
        """Return when the image of this name was described; None where its record does not say."""
        (row,) = self._rows_of([self._numbers[name]])
        after = bisect.bisect(self._parts, row, key=operator.itemgetter(2))
        return self._parts[after - 1][0]

    def descriptors_of(self, names: Iterable[str]) -> Queries:
        """Read the descriptors of some images; of bits, unit vectors of the signs."""
        rows = self._rows_of(self._numbers[name] for name in names)
        found = self._segments[np.array(rows, np.int64)]
        return sign_vectors(found) if self.metadata.is_bits else found.astype(np.float32)

    def _check_there(self) -> None:
        if not self.exists:
            raise InputError(f"{self.folder}: found the opened map gone, expected it in this place")

    def _addition(
        self, part: "NewImages", taken: Collection[str]
    ) -> tuple[dict[str, Any], Descriptors]:
        """Return the record of new images, whose names are not `taken`, and their descriptors."""
        descriptors = self._rows("descriptors", part.descriptors)
        if twice := len(part.names) - len(set(part.names).difference(taken)):
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

    @property
    def descriptors(self) -> Iterator[Descriptors]:
        """Descriptors in order, one array for each addition; of bits, unit vectors of the signs."""
        for span, block in zip(self._segments.spans, self._segments.blocks(), strict=True):
            left = self.removed.left(span.first, span.count)
            rows = block if left is None else block[left]
            if len(rows):
                yield sign_vectors(rows) if self.metadata.is_bits else rows

    def parts(self) -> Iterator["NewImages"]:
        """Yield the images that are left of each addition, to append them to another map."""
        counts = self.removed.numbers_of(np.array([first for *_, first in self._parts], np.int64))
        starts = [*counts.tolist(), len(self)]
        blocks = self.descriptors
        for (added, root, _), start, end in zip(self._parts, starts[:-1], starts[1:], strict=True):
            if start == end:
                continue
            names = [image.name for image in self.images[start:end]]
            sizes = [image.bytes for image in self.images[start:end]]
            positions = self.positions_of(names)
            yield NewImages(names, sizes, next(blocks), root, positions, added, self.folder)

    def as_stored(self, descriptors: Descriptors) -> Float32[np.ndarray, "n d"]:
        """Round descriptors as the map stores them; of bits, unit vectors of the signs."""
        rows = self._rows("descriptors", descriptors).astype(self.metadata.row[1], copy=False)
        return sign_vectors(rows) if self.metadata.is_bits else rows.astype(np.float32, copy=False)

    def verify(self) -> None:
        """Read all descriptors, and compare them with the digests in the records.

        Raises:
            InputError: one has changed; the message says of which images.
        """
        self._segments.verify()

    def summary(self, *, verify: bool = False) -> dict[str, Any]:
        """Summarise the map as JSON values by name.

        Args:
            verify: whether to read all descriptors, as `verify` does.

        Returns:
            Numbers of images and positions, its folders, additions and extent, the model, its
            settings, and where descriptors are.

        Raises:
            InputError: what `verify` raises.
        """
        if verify:
            self.verify()
        metadata = self.metadata
        return {
            "images": len(self),
            "removed": len(self._gone),
            "positions": sum(image.position is not None for image in self.images),
            "axes": self.axes,
            **contents(self),
            "zone": self.zone and str(self.zone),
            "descriptor": metadata.length_words
            + ("" if metadata.is_bits else f", {metadata.dtype}"),
            "image_size": list(self.config.image_size),
            "resize": self.config.images_in_words,
            "grouping": metadata.grouping,
            "store": metadata.store,
            "search": self.search_kind,
            "stale_search": self.stale_search or "none",
            "components": metadata.pca or "none",
            "model": metadata.model,
            "weights": metadata.weights,
            "created": metadata.created,
            "calibration": None if self.calibration is None else to_plain(self.calibration),
            **({"verified": True} if verify else {}),
        }

    def load_model(
        self,
        weights: str | os.PathLike[str] | None = None,
        *,
        engine: EngineName | Literal["jax"] = "jax",
        groupings: Sequence[str] = ("single",),
        verify: bool = True,
    ) -> "Model | Runtime":
        """Load the model that made the map, or open it in another engine, which needs no JAX.

        Args:
            weights: the file, or an exported folder; None is where it was then.
            engine: "jax", "onnxruntime" or "openvino".
            groupings: the groupings that queries will be described in.
            verify: whether to compare exported files with their checksums.

        Returns:
            The model, at the image size and in the type of the map's images.

        Raises:
            InputError: there is no such file, what `open_runtime` raises, or it is another model.
        """
        file = weights_of(self.metadata, self.folder) if weights is None else weights
        if engine == "jax":
            from crisalad_jax.checkpoints.weights import read_weights
            from crisalad_jax.nn.model import Model

            found = read_weights(file)
            assert found.digest is not None  # a file of this package says it
            check_model(self.metadata, self.folder, found.digest, file)
            config = with_non_semantic_fields_of(self.config, found.config)
            model = Model(found.params, config)
        else:
            model = open_runtime(
                file,
                engine,
                self.metadata.config,
                any_grouping=set(groupings) != {"single"},
                verify=verify,
            )
            self._check_describer(cast(Describer, model), file)
        self._describer = model, describer_of(model, groupings)
        return model

    def describer(
        self, model: "Model | Runtime | None" = None, groupings: Sequence[str] = ("single",)
    ) -> Describer:
        """Return what describes queries with the model that made the map.

        Args:
            model: the model; None is the last one, or loads it. The map's image size and types
                are taken in place of those of its configuration.
            groupings: the groupings that queries will be described in.

        Raises:
            InputError: another model, or what `describer_of` raises.
        """
        if model is None and self._describer is None:
            self.load_model(groupings=groupings)
        known = self._describer
        if known is None or (model is not None and model is not known[0]):
            given: Any = model
            if isinstance(model, tuple):
                config = with_non_semantic_fields_of(self.config, model.config)
                given = model._replace(config=config)
            known = model, describer_of(given, groupings)
            self._check_describer(known[1], "the given model")
            self._describer = known
        return describer_of(known[1], groupings)

    def _check_describer(self, describer: Describer, given: object) -> None:
        quantised_from = getattr(describer, "quantised_from", None)
        check_model(
            self.metadata, self.folder, describer.digest, given, quantised_from=quantised_from
        )

    def close(self) -> None:
        """Close the store; a map that nothing refers to any more closes itself."""
        self._close()


@contextlib.contextmanager
def open_for_appending(
    folder: str | os.PathLike[str], metadata: MapMetadata, components: Pca | None = None
) -> Iterator[Map]:
    """Open the map with this metadata to append to it, or make it, with its components.

    One process at a time may append; others may search meanwhile. A map that a kill left without
    images is made anew; one that an exception leaves without images is removed. A note tells of
    descriptors without a record, which are removed.

    Raises:
        InputError: another process appends, the map there is another one or has lost a record of
            images, what `Map.open` raises, or the folder cannot be written to.
    """
    folder = pathlib.Path(folder)
    read_metadata(folder)  # raises where something else is there, before anything is made
    with contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder / SEGMENTS))
        stack.enter_context(lock(folder))
        existing = read_metadata(folder)
        if existing is not None and existing != metadata:
            raise InputError(f"{folder}: found another map than was expected here")
        for each in (folder, folder / SEGMENTS):
            remove_temporaries(each)
        if existing is None:
            remove_unrecorded(folder, 0)
        try:
            if existing is None:
                if components is not None:
                    save_pca(folder / COMPONENTS, components)
                write_record(folder / METADATA, dataclasses.asdict(metadata), indent=2)
            opened = stack.enter_context(Map._opened(folder, existing or metadata))
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


def _axes_in(record: Mapping[str, Any]) -> tuple[tuple[str, str] | None, Zone | None]:
    """Return the axes and the zone that a record states."""
    axes = record["axes"] and (record["axes"][0], record["axes"][1])
    return axes, record["zone"] and Zone(int(record["zone"][0]), bool(record["zone"][1]))


def _inside(name: object) -> str:
    """Return the name of an image, which is below its root; raise ValueError where it is not."""
    name = str(name)
    path = pathlib.PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"found name {name!r}, expected one below the folder of images")
    return name
