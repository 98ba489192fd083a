"""Maps: a folder of descriptors with a description of itself, which grows by appending.

Each addition is a segment: its descriptors go to the store, then the record of its images appears
under its name. That single rename commits the addition. A map whose writer is killed at any moment
is as it was before the addition or after it. docs/maps.md has the format.
"""

import contextlib
import datetime
import functools
import hashlib
import os
import pathlib
import weakref
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from crisalad_jax.checkpoints.engines import EngineName
from crisalad_jax.checkpoints.runtime import Runtime, open_runtime
from crisalad_jax.config.checks import PATH, check_count, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import Positions
from crisalad_jax.retrieval.chunks import check_rows
from crisalad_jax.retrieval.maps.approximate import (
    Approximate,
    build_approximate,
    open_approximate,
    stale_kind,
    tell_stale,
)
from crisalad_jax.retrieval.maps.calibration import Calibration, read_calibration
from crisalad_jax.retrieval.maps.contents import MapAddition, contents, with_addition
from crisalad_jax.retrieval.maps.file_store import FileStore
from crisalad_jax.retrieval.maps.head import (
    COMPONENTS,
    SEGMENTS,
    MapHead,
    check_model,
    has_images,
    read_components,
    read_head,
    read_value,
    weights_of,
    write_record,
)
from crisalad_jax.retrieval.maps.store import Store, open_store
from crisalad_jax.retrieval.maps.unrecorded import check_no_record_lost, remove_unrecorded
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.pca import Pca, save_pca
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.shapes import Float, Float32
from crisalad_jax.utils.temporaries import made_folder, remove_temporaries

if TYPE_CHECKING:  # a map is searched without JAX
    from crisalad_jax.nn.model import Crisalad
    from crisalad_jax.retrieval.maps.manifest import MapDescription


@brief
class MapImage(NamedTuple):
    """An image of a map: everything but its descriptor."""

    name: str
    """Its posix path relative to `root`; no two images of a map share one."""
    bytes: int
    """Size of the described file in bytes; a file of another size is another picture."""
    position: tuple[float, float] | None
    root: str


@brief
class Answer(NamedTuple):
    """One image of a map, as an answer to a query."""

    rank: int
    """Rank from 1, the most similar."""
    similarity: float
    """Cosine of the two descriptors."""
    image: MapImage
    """The image: its name, and where it was taken."""
    probability: float | None = None
    """Probability that the camera is there; None without a filter."""


class _Segment(NamedTuple):
    first: int
    count: int
    sha256: str


class Map:
    """An open map: made by `Map.open` to search it, or by `open_for_appending`.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, index, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, params, config)
        >>> _ = index(params, config, pictures, folder / "map", weights=weights, quiet=True)
        >>> places = Map.open(folder / "map")
        >>> len(places)
        4
        >>> places.locate(pictures / "2.png", k=1)[0].image.name
        '2.png'
    """

    def __init__(self, folder: pathlib.Path, head: MapHead, store: Store) -> None:
        """Read all records, and check that the store has all of their descriptors."""
        self.folder = folder
        self.head = head
        """All of map.json but the model's configuration."""
        self.images: list[MapImage] = []
        """The images by number."""
        self.additions: list[MapAddition] = []
        """What was appended, in order: from which folder, on which day, and how many images."""
        self._numbers: dict[str, int] = {}
        self.axes: tuple[str, str] | None = None
        """Axes of the positions, see `positions.AXES`; None where no image has a position."""
        self.zone: Zone | None = None
        """Zone of UTM of all positions in metres east and north; None where it is unknown."""
        self._store = store
        self._close = weakref.finalize(self, store.close)
        self.calibration: Calibration | None = None
        """What `calibrate` measured; None where it did not, or the map is open for appending."""
        self.components = read_components(folder, head)
        """The components that shorten descriptors, and those of queries; None is none."""
        self._approximate: Approximate | None = None
        self._tells_stale = True
        """Whether the next search that is not asked to be exact tells why it is."""
        self._checked: Crisalad | Runtime | None = None
        """Parameters that are known to be of the model that made the map."""
        self._segments: list[_Segment] = []
        # A writer adds records in order, so those that are listed now have all before them. It may
        # add more while they are read.
        listed = set((folder / SEGMENTS).glob("[0-9]*.json"))
        while (path := self._record(len(self))).exists():
            self._read_record(path)
            listed.discard(path)
        if listed:
            raise InputError(f"{min(listed)}: expected {path.name} before it, found no such file")
        store.check([(first, count) for first, count, _ in self._segments])

    @classmethod
    @takes(folder=PATH)
    def open(
        cls, folder: str | os.PathLike[str], *, verify: bool = True, calibrated: bool = True
    ) -> Self:
        """Open a map to search it as it is now; images appended meanwhile are not seen.

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
        head = read_head(folder)
        if head is None:
            raise InputError(
                f"{folder}: found no map, expected a folder that `crisalad index` wrote"
            )
        if not has_images(folder):
            raise InputError(f"{folder}: found a map without images, expected at least one")
        opened = cls._opened(folder, head)
        try:
            if calibrated:
                opened.calibration = read_calibration(folder, head.model)
            if verify and head.store == "files":
                opened.verify()
            opened._approximate = open_approximate(folder, opened._segments, verify=verify)
        except BaseException:
            opened.close()
            raise
        return opened

    @classmethod
    def _opened(cls, folder: pathlib.Path, head: MapHead) -> Self:
        store = open_store(
            head.store,
            folder,
            collection=head.collection,
            length=head.descriptor_length,
            dtype=head.dtype,
            new=not has_images(folder),
        )
        try:
            return cls(folder, head, store)
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
        length = self.head.descriptor_length
        return f"Map({str(self.folder)!r}: {len(self)} images, {length} numbers each)"

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)

    @functools.cached_property
    def description(self) -> "MapDescription":
        """The map's description: its `head`, and the model's configuration.

        Raises:
            InputError: the configuration is not one that this package knows.
        """
        from crisalad_jax.retrieval.maps.manifest import read_description

        found = read_description(self.folder)
        if found is None:
            raise InputError(f"{self.folder}: found no map any more, expected the one that is open")
        return found

    def image(self, name: str) -> MapImage | None:
        """Return what the map knows of the image of this name; None if it has none."""
        number = self._numbers.get(name)
        return None if number is None else self.images[number]

    def _record(self, first: int) -> pathlib.Path:
        return self.folder / SEGMENTS / f"{first:010d}.json"

    def _read_record(self, path: pathlib.Path) -> None:
        record = read_json(path, "a record of images")
        try:
            columns = (record["names"], record["bytes"], record["positions"])
            images = [
                MapImage(
                    _inside(name),
                    int(size),
                    at and (float(at[0]), float(at[1])),
                    record["root"],
                )
                for name, size, at in zip(*columns, strict=True)
            ]
            if not isinstance(record["root"], str):
                raise ValueError(f"found root {record['root']!r}, expected text")
            axes = record["axes"] and (record["axes"][0], record["axes"][1])
            added = record["added"]
            if not isinstance(added, str | None):
                raise ValueError(f"found added {added!r}, expected a time")
            zone = record["zone"] and Zone(int(record["zone"][0]), bool(record["zone"][1]))
            segment = _Segment(len(self), len(images), str(record["sha256"]))
            if not images:
                raise ValueError("no images")
        except (ValueError, LookupError, TypeError, OverflowError) as error:
            raise InputError(f"{path}: not a whole record of images: {error!r}") from error
        self._take(images, axes, zone, segment, added)

    def _take(
        self,
        images: list[MapImage],
        axes: tuple[str, str] | None,
        zone: Zone | None,
        segment: _Segment,
        added: str | None,
    ) -> None:
        self.additions = with_addition(self.additions, added, images[0].root, len(images))
        self._numbers |= {image.name: segment.first + i for i, image in enumerate(images)}
        self.images += images
        self.axes = self.axes or axes
        self.zone = self.zone or zone
        self._segments.append(segment)

    def search(
        self, queries: Float32[np.ndarray, "q d"], k: int, *, exact: bool = False
    ) -> Neighbours:
        """Find the k most similar images of each query, best first; all where there are fewer.

        Search is exact, by inner product; of equal similarities the earlier image stands first.
        A map with an approximate search finds nearly all of them. Their similarities are exact.
        A note tells, once, of an approximate search that is not of all images, and is not used.

        Args:
            queries: unit descriptors, of the map's model, shortened by its `components`.
            k: neighbours per query.
            exact: whether to search exactly although the map has an approximate search.

        Raises:
            InputError: no queries, none in the map, descriptors that are no unit vectors of the
                map's length, k below 1; or the store is damaged or gone.
        """
        check_count("k", k)
        if not len(self):
            raise InputError(f"{self.folder}: found a map without images, expected at least one")
        self._check_descriptors("queries", queries)
        k = min(k, len(self))
        if self._approximate is not None and isinstance(self._store, FileStore) and not exact:
            return self._approximate.search(self._store, queries, k, len(self))
        if self._tells_stale and not exact:
            tell_stale(self.folder, self._segments)
            self._tells_stale = False
        return self._store.search(queries, k, len(self))

    @property
    def search_kind(self) -> str:
        """How `search` searches: "exact", "hnsw" or "ivf-pq"."""
        return "exact" if self._approximate is None else self._approximate.kind

    @property
    def stale_search(self) -> str | None:
        """Kind of an approximate search that is not used, as it is of fewer or other images."""
        return stale_kind(self.folder, self._segments) if self._approximate is None else None

    def shorten(self, descriptors: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n short"]:
        """Shorten a model's descriptors by the map's `components`; without any they stay."""
        return descriptors if self.components is None else self.components.apply(descriptors)

    def build_search(self, kind: str, *, quiet: bool = True) -> float | None:
        """Build the map's approximate search from its descriptors, where it is not there yet.

        Args:
            kind: "hnsw" or "ivf-pq"; "exact" removes what there is.
            quiet: whether to show no progress bar.

        Returns:
            The share of the exact 10 nearest others that are found of 100 of its images; None of
            an exact search.

        Raises:
            InputError: an unknown kind, too few images, or a map in Milvus.
        """
        self._approximate = build_approximate(
            self.folder,
            kind,
            self._segments,
            self._store,
            lambda: self.descriptors,
            self.head.descriptor_length,
            quiet=quiet,
        )
        return None if self._approximate is None else self._approximate.recall

    def locate(
        self,
        image: np.ndarray | str | os.PathLike[str],
        k: int = 5,
        *,
        params: "Crisalad | Runtime | None" = None,
    ) -> list[Answer]:
        """Find the images of the map that are most similar to one picture.

        The first call loads the model that made the map, and compiles it; later ones do neither.
        `query` asks for many images at once.

        Args:
            image: a picture of 8-bit RGB, as `read_image` returns it, or of grey (height, width) or
                (height, width, 1), such as ROS's mono8; or its file.
            k: number of answers; all where the map has fewer.
            params: parameters of the model that made the map; None loads them from where they were.

        Returns:
            The answers, best first. Positions are in `axes`.

        Raises:
            InputError: a file that cannot be read, an array that `prepare_image` does not take, k
                below 1; what `load_params`, `check_params` and `search` raise.

        Example:
            >>> import jax
            >>> from crisalad_jax import PRESETS, index, init_crisalad, read_image, save_weights
            >>> config = PRESETS["tiny"]
            >>> params = init_crisalad(jax.random.key(0), config)
            >>> weights = folder / "weights.safetensors"
            >>> save_weights(weights, params, config)
            >>> _ = index(params, config, pictures, folder / "map", weights=weights, quiet=True)
            >>> answers = Map.open(folder / "map").locate(read_image(pictures / "3.png"), k=2)
            >>> [(answer.rank, answer.image.name) for answer in answers][0]
            (1, '3.png')
        """
        from crisalad_jax.retrieval.alone import describe_images

        check_count("k", k)
        picture = read_pixels(image) if isinstance(image, str | os.PathLike) else image
        if params is None:
            params = self._checked or self.load_params()
        self.check_params(params)
        descriptor = describe_images(params, self.description.config, [picture])
        found = self.search(self.shorten(descriptor), k)
        pairs = zip(found.indices[0], found.similarities[0], strict=True)
        return [
            Answer(rank, float(similarity), self.images[number])
            for rank, (number, similarity) in enumerate(pairs, 1)
        ]

    def similarities(self, queries: Float32[np.ndarray, "q d"]) -> Float32[np.ndarray, "q n"]:
        """Compute the similarities of queries to all images, in the order of the images.

        Args:
            queries: unit descriptors, of the map's model.

        Raises:
            InputError: as `search`.
        """
        self._check_descriptors("queries", queries)
        parts = [queries @ part.astype(np.float32, copy=False).T for part in self.descriptors]
        return np.concatenate(parts, axis=1)

    def _check_descriptors(self, name: str, descriptors: Float[np.ndarray, "n d"]) -> None:
        length = self.head.descriptor_length
        if descriptors.ndim != 2 or not len(descriptors) or descriptors.shape[1] != length:
            raise InputError(
                f"{name}: found shape {descriptors.shape}, expected (images, {length})"
            )
        check_rows(descriptors, name, range(len(descriptors)), unit=True)

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
        descriptors: Float[np.ndarray, "n d"],
        *,
        root: str,
        positions: Positions | None = None,
    ) -> None:
        """Append images: all of them are there for good once this returns, and none before.

        Args:
            names: relative to `root`, none of which the map has.
            sizes: of their files, in bytes.
            descriptors: unit vectors; kept as the map's type.
            root: the folder of these images.
            positions: where they were taken, as far as that is known; those of another zone of UTM
                become the map's.

        Raises:
            InputError: a name that is there already or twice, descriptors that are no unit vectors,
                positions that have no place among the map's, or a store that cannot be written to.
        """
        self._check_descriptors("descriptors", descriptors)
        if twice := len(names) - len(set(names) - self._numbers.keys()):
            raise InputError(
                f"{self.folder}: found {twice} of {len(names)} names twice, or in the map already, "
                "expected new ones"
            )
        positions = self.fitted(names, positions)
        axes, known, zone = positions or (None, {}, None)
        images = [
            MapImage(name, size, known.get(name), root)
            for name, size in zip(names, sizes, strict=True)
        ]
        rows = np.ascontiguousarray(descriptors, self.head.dtype)
        segment = _Segment(len(self), len(images), hashlib.sha256(rows.data).hexdigest())
        self._store.add(segment.first, rows)
        record = {
            "root": root,
            "added": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "axes": axes,
            "zone": zone,
            "sha256": segment.sha256,
            "names": list(names),
            "bytes": list(sizes),
            "positions": [image.position for image in images],
        }
        write_record(self._record(segment.first), record)
        self._take(images, axes, zone, segment, record["added"])

    @property
    def descriptors(self) -> Iterator[Float[np.ndarray, "n d"]]:
        """Descriptors in order, one array for each addition."""
        for first, count, _ in self._segments:
            yield self._store.read(first, count)

    def verify(self) -> None:
        """Read all descriptors, and compare them with the digests in the records.

        Raises:
            InputError: one has changed; the message says of which images.
        """
        for segment, descriptors in zip(self._segments, self.descriptors, strict=True):
            rows = np.ascontiguousarray(descriptors, self.head.dtype)
            if hashlib.sha256(rows.data).hexdigest() != segment.sha256:
                raise InputError(
                    f"{self._record(segment.first).with_suffix('')}: descriptors {segment.first} "
                    f"to {segment.first + segment.count - 1} have changed since they were written"
                )

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
        description = self.description
        return {
            "images": len(self),
            "positions": sum(image.position is not None for image in self.images),
            "axes": self.axes,
            **contents(self),
            "zone": self.zone and str(self.zone),
            "descriptor": f"{description.descriptor_length} numbers, {description.dtype}",
            "image_size": list(description.config.image_size),
            "resize": description.config.images_in_words,
            "grouping": description.grouping,
            "store": description.store,
            "search": self.search_kind,
            "stale_search": self.stale_search or "none",
            "components": description.pca or "none",
            "model": description.model,
            "weights": description.weights,
            "created": description.created,
            "calibration": None if self.calibration is None else to_plain(self.calibration),
            **({"verified": True} if verify else {}),
        }

    def load_params(self, weights: str | os.PathLike[str] | None = None) -> "Crisalad":
        """Load the parameters of the model that made the map.

        Args:
            weights: the file; None is where it was then.

        Returns:
            The parameters, which go with `description.config`.

        Raises:
            InputError: there is no such file, or it is of another model.
        """
        from crisalad_jax.checkpoints.weights import load_with_hash

        file = self._weights(weights)
        params, _, digest = load_with_hash(file)
        check_model(self.head, self.folder, digest, file)
        self._checked = params
        return params

    def load_runtime(
        self,
        engine: EngineName,
        weights: str | os.PathLike[str] | None = None,
        *,
        any_grouping: bool = False,
        verify: bool = True,
    ) -> Runtime:
        """Open the model that made the map in another engine; JAX is not imported for it.

        Args:
            engine: "onnxruntime" or "openvino".
            weights: an exported folder or the file; None is where it was then.
            any_grouping: whether queries look at each other.
            verify: whether to compare the exported files with their checksums.

        Returns:
            The model, in the place of parameters.

        Raises:
            InputError: what `open_runtime` raises, or it is of another model.
        """
        file = self._weights(weights)
        config = read_value(self.folder)["config"]  # pyright: ignore[reportOptionalSubscript]
        runtime = open_runtime(
            file,
            engine,
            image_size=tuple(config["image_size"]),
            preprocessing=config["preprocessing"],
            precision=config["compute_dtype"],
            any_grouping=any_grouping,
            verify=verify,
        )
        self._check_runtime(runtime, file)
        return runtime

    def _weights(self, weights: str | os.PathLike[str] | None) -> str | os.PathLike[str]:
        """Return a model's file, by default where it was when the map was made."""
        return weights_of(self.head, self.folder) if weights is None else weights

    def check_params(self, params: "Crisalad | Runtime") -> None:
        """Check that parameters are of the model that made the map; the same ones only once.

        Raises:
            InputError: they are not.
        """
        if params is not self._checked:
            if isinstance(params, Runtime):
                self._check_runtime(params, "the given parameters")
                return
            from crisalad_jax.checkpoints.weights import model_hash

            digest = model_hash(params, self.description.config)
            check_model(self.head, self.folder, digest, "the given parameters")
            self._checked = params

    def _check_runtime(self, runtime: Runtime, given: object) -> None:
        check_model(
            self.head, self.folder, runtime.digest, given, quantised_from=runtime.quantised_from
        )
        self._checked = runtime

    def close(self) -> None:
        """Close the store; a map that nothing refers to any more closes itself."""
        self._close()


@contextlib.contextmanager
def open_for_appending(
    folder: str | os.PathLike[str],
    description: "MapDescription",
    components: Pca | None = None,
) -> Iterator[Map]:
    """Open the map with this description to append to it, or make it, with its components.

    One process at a time may append; others may search meanwhile. A map that a kill left without
    images is made anew; one that an exception leaves without images is removed. A note tells of
    descriptors without a record, which are removed.

    Raises:
        InputError: another process appends, the map there is another one or has lost a record of
            images, what `Map.open` raises, or the folder cannot be written to.
    """
    from crisalad_jax.retrieval.maps.manifest import (
        read_description,
        undone_without_images,
        write_description,
    )

    folder = pathlib.Path(folder)
    read_description(folder)  # raises where something else is there, before anything is made
    with contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder / SEGMENTS))
        stack.enter_context(lock(folder))
        existing = read_description(folder)
        for each in (folder, folder / SEGMENTS):
            remove_temporaries(each)
        check_no_record_lost(folder)  # first: what follows removes a map without images
        stack.enter_context(undone_without_images(folder))
        if existing != description:
            if has_images(folder):
                raise InputError(f"{folder}: found another map than was expected here")
            if components is not None:
                save_pca(folder / COMPONENTS, components)
            write_description(folder, description)
        opened = stack.enter_context(Map._opened(folder, description))
        remove_unrecorded(folder, len(opened))
        yield opened


def _inside(name: object) -> str:
    """Return the name of an image, which is below its root; raise ValueError where it is not."""
    name = str(name)
    path = pathlib.PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"found name {name!r}, expected one below the folder of images")
    return name
