"""Maps: self-describing folders of image descriptors that you open to search."""

import bisect
import contextlib
import functools
import itertools
import os
import pathlib
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, cast

import numpy as np

from crisalad_jax.checkpoints.engines import EngineName
from crisalad_jax.checkpoints.runtime import Runtime, fastest_engine, open_runtime
from crisalad_jax.config.checks import PATH, check_count, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import Positions
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
from crisalad_jax.retrieval.maps.images import Images, MapImage, NewImages
from crisalad_jax.retrieval.maps.metadata import (
    METADATA,
    SEGMENTS,
    MapMetadata,
    check_model,
    existing_metadata,
    has_images,
    model_config,
    read_components,
    weights_of,
)
from crisalad_jax.retrieval.maps.removed import Removed
from crisalad_jax.retrieval.maps.store import Store, open_store
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.segments import Segments, Take
from crisalad_jax.retrieval.verification.results import Verification
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float32

if TYPE_CHECKING:  # a map is searched without JAX
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model


@brief
class Answer(NamedTuple):
    """One image of a map, as an answer to a query."""

    rank: int
    """Rank from 1, the most similar."""
    similarity: float
    """Cosine of the two descriptors; for bits 1 - 2 h / d, where h of the d bits differ."""
    image: MapImage
    """The image: its name, and where it was taken."""
    probability: float | None = None
    """Probability that the camera is there; None without `sequence` in `query`."""
    verification: Verification | None = None
    """Result of matching local features; None if the answer was not verified."""


class Map:
    """An open map, returned by `Map.open` for searching or by `open_for_appending`.

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

    def __init__(self, folder: pathlib.Path, metadata: MapMetadata, store: Store) -> None:
        """Read the records of the images, whose descriptors are in a store."""
        self.folder = folder
        self.metadata = metadata
        """The contents of map.json."""
        self.images = Images()
        """The images by number, as in the indices that `search` returns."""
        self.changed = ""
        """Time (ISO 8601) of the last removal, replacement or merge of images; empty for never."""
        self.axes: tuple[str, str] | None = None
        """Axes of the positions, see `positions.AXES`; None if no image has a position."""
        self.zone: Zone | None = None
        """UTM zone of all positions in metres east and north; None if unknown."""
        self.calibration: Calibration | None = None
        """Result of `calibrate`; None without one, or if the map is open for appending."""
        self.components = read_components(folder, metadata)
        """Components that shorten the descriptors of images and queries, if any."""
        self._calibrated = False
        self._approximate: Approximate | None = None
        self._left_out = Where(), self.images, 0, Removed()
        self._describer: tuple[object, Describer] | None = None
        """A model that was checked to be the one that made the map, and its describer."""
        me = weakref.proxy(self)  # a reference cycle would delay closing
        take: Take = lambda record, path: me._take(record, path)  # noqa: E731
        self._segments = Segments(folder / SEGMENTS, store, metadata.row[1], take)
        if (row := self.images.twice()) is not None:
            firsts = [span.first for span in self._segments.spans]
            path = self._segments.paths[bisect.bisect(firsts, row) - 1]
            raise InputError(f"{path}: not a whole record of images: a name occurs twice")
        self._opened_at = os.stat(self._segments.folder)
        self._close = weakref.finalize(self, store.close)

    @classmethod
    @takes(folder=PATH)
    def open(
        cls, folder: str | os.PathLike[str], *, verify: bool = True, calibrated: bool = True
    ) -> Self:
        """Open a map to search it as it is now; images appended later are not seen.

        An approximate search built for another set of images is not used, and a warning says so.

        Args:
            folder: a folder that `index` made.
            verify: whether to read and check all descriptors in files, as the method `verify` does;
                records are always checked.
            calibrated: whether to read the calibration. If not, the map answers every query, and a
                damaged file does not matter.

        Returns:
            The map. It releases its store when it is closed, at the end of a `with`, or when
            nothing refers to it any more.

        Raises:
            InputError: there is no map, or it has no images yet; or the map or its store is
                damaged, changed, gone, or of another format.

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
                    f"{folder}: its images were changed ({opened.changed[:10]}) since its minimum "
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
        store = open_store(metadata, folder, new=not has_images(folder))
        try:
            return cls(folder, metadata, store)
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
        """Configuration of the model, with the image size and data type of the map's images.

        Raises:
            InputError: the recorded configuration is not one that this package knows.
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
        """Return this map or, if it has changed, close it and return a newly opened one.

        Raises:
            InputError: the changed map cannot be opened; see `open`.
        """
        if not self._segments.has_more or not self.exists:
            return self
        self.close()
        again = type(self).open(self.folder, verify=False, calibrated=self._calibrated)
        again._describer = self._describer
        return again

    @property
    def removed(self) -> Removed:
        """The removed images, by their rows in the store, which no change alters."""
        return self.images.removed

    @property
    def additions(self) -> list[MapAddition]:
        """Additions in order, each with its folder, its day, and the number of images left."""
        return additions_of(self.images)

    def was_removed(self, name: str, size: int | None = None) -> bool:
        """Return whether an image of this name (and size in bytes) was removed and is still out."""
        sizes = self.images.removed_names.get(name, ())
        is_one = bool(sizes) if size is None else size in sizes
        return is_one and self.images.find(name) is None

    def image(self, name: str) -> MapImage | None:
        """Return the image with this name; None if the map has none."""
        number = self.images.find(name)
        return None if number is None else self.images[number]

    def added(self, name: str) -> str | None:
        """Return the ISO 8601 time when the image of this name was described; None if unknown."""
        return self.images.part_of(self._number(name)).added

    def _number(self, name: str) -> int:
        number = self.images.find(name)
        if number is None:
            raise KeyError(name)
        return number

    def _take(self, record: Mapping[str, Any], path: pathlib.Path) -> None:
        """Apply a record: add its images, or make the change that it describes.

        Raises:
            InputError: a value is missing or of another type.
        """
        is_change = "rows" in record
        columns = ("removed", "moved") if is_change else ("root", "added", "names", "bytes")
        try:
            axes = record["axes"] and (record["axes"][0], record["axes"][1])
            zone = record["zone"] and Zone(int(record["zone"][0]), bool(record["zone"][1]))
            given: Any = [record[name] for name in columns]
            if not is_change:
                self.images.extend(*given, positions=record["positions"], axes=axes)
                self.axes, self.zone = self.axes or axes, self.zone or zone
                return
            if not isinstance(record["changed"], str):
                raise TypeError("found no time")
            self.images = self.images.changed(*given, positions=record["positions"], axes=axes)
            self.axes, self.zone = axes, zone
            self.changed = self.changed if record["verb"] == "move" else record["changed"]
        except (ValueError, LookupError, TypeError, OverflowError) as error:
            kind = "a change" if is_change else "images"
            raise InputError(f"{path}: not a whole record of {kind}: {error!r}") from error

    def search(
        self, queries: Queries, k: int, *, exact: bool = False, where: Where | str | None = None
    ) -> Neighbours:
        """Find the k most similar images for each query, best first; all if there are fewer.

        Search is by inner product, or by equal bits in a map of bits; among equal similarities the
        earlier image comes first. An approximate search, if the map has one, finds nearly all of
        the k most similar, with exact similarities. Indices are those of `images`.

        Args:
            queries: unit descriptors of the map's model, shortened by its `components`. A map of
                bits also takes vectors of any norm, and packed bits.
            k: neighbours per query.
            exact: whether to search exactly even if the map has an approximate search.
            where: which images to search, in the syntax of `Where.parse`; None is all.

        Raises:
            InputError: there are no queries, or they are not unit vectors of the map's length; k is
                below 1; `where` cannot be parsed (`Where.parse`), or no image meets it; or the
                store is damaged or gone.
        """
        check_count("k", k)
        queries = self._rows("queries", queries)
        out, count = self.removed if where is None else self.left_out(where), self.images.rows
        k = min(k, count - len(out.rows))
        store = self._segments.store
        found = (store if exact else self._approximate or store).search(queries, k, count, out)
        if where is None:
            return found
        return found._replace(indices=self.removed.numbers_of(out.rows_of(found.indices)))

    def left_out(self, where: Where | str) -> Removed:
        """Return the rows that a search with conditions leaves out; the last result is cached.

        Raises:
            InputError: `where` cannot be parsed (`Where.parse`), or no image meets it.
        """
        conditions = Where.parse(where) if isinstance(where, str) else where
        asked = conditions, self.images, self.images.rows
        if self._left_out[:3] != asked:
            self._left_out = *asked, conditions.left_out(self.images, self.axes)
        return self._left_out[3]

    @property
    def search_kind(self) -> str:
        """How `search` searches: "exact", "hnsw", "ivf-rabitq", or in Milvus "diskann"."""
        return "exact" if self._approximate is None else self._approximate.kind

    @property
    def stale_search(self) -> str | None:
        """Kind of an unused approximate search, built for another set of images; or None."""
        return stale_kind(self.folder, self._segments.spans) if self._approximate is None else None

    def shorten(self, descriptors: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n short"]:
        """Shorten a model's descriptors by the map's `components`, if it has any."""
        return descriptors if self.components is None else self.components.apply(descriptors)

    def build_search(self, kind: str, *, quiet: bool = True) -> float | None:
        """Build the map's approximate search from its descriptors, unless it exists already.

        Args:
            kind: "hnsw" or "ivf-rabitq", with Milvus also "diskann"; "exact" removes an existing
                one; "auto" chooses by the size of the descriptors and the available memory, or by
                what this version of Milvus supports, and reports why.
            quiet: whether to hide the progress bar.

        Returns:
            Its recall: the share of exact neighbours that it finds, among the 10 nearest others to
            each of 100 images of the map. None for an exact search.

        Raises:
            InputError: the kind is unknown, not in Milvus or, for a map of bits, not exact.
        """
        metadata = self.metadata
        check_search(kind, metadata.store, metadata.dtype)
        if kind == "auto" and metadata.store == "files":
            size = len(self._segments), metadata.descriptor_length
            kind, why = choose_search(*size, metadata.dtype)
            warn(f"{self.folder}: --search auto takes {kind}: {why}")
        self._approximate = build_approximate(self.folder, kind, self._segments, quiet=quiet)
        return None if self._approximate is None else self._approximate.recall

    def locate(
        self,
        image: np.ndarray | str | os.PathLike[str],
        k: int = 5,
        *,
        model: "Model | Runtime | None" = None,
        where: Where | str | None = None,
    ) -> list[Answer]:
        """Find the images of the map that are most similar to one image.

        The first call loads the model that made the map, and compiles it; later calls reuse it.
        `query` takes many images at once.

        Args:
            image: a file; or 8-bit RGB, as `read_image` returns it, or grey (height, width) or
                (height, width, 1), such as ROS's mono8.
            k: number of answers; all if the map has fewer.
            model: the model that made the map; None loads it from its recorded path.
            where: which images to search, as in `search`.

        Returns:
            The answers, best first. Positions are in `axes`.

        Raises:
            InputError: the file cannot be read, `prepare_image` does not accept the array, or k is
                below 1; or `load_model`, `describer` or `search` raises it.

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
        found = self.search(self.shorten(descriptor), k, where=where)
        ranked = enumerate(zip(*(part[0].tolist() for part in found), strict=True), 1)
        return [Answer(rank, similarity, self.images[i]) for rank, (i, similarity) in ranked]

    def similarities(self, queries: Queries) -> Float32[np.ndarray, "q n"]:
        """Compute the similarities of queries to all images, in the order of the images.

        Args:
            queries: as `search` takes them.

        Raises:
            InputError: the queries are not as `search` takes them.
        """
        queries = self._rows("queries", queries)
        queries = sign_vectors(queries) if self.metadata.is_bits else queries
        parts = [queries @ part.astype(np.float32, copy=False).T for part in self.descriptors]
        return np.concatenate(parts, axis=1)

    def _rows(self, name: str, rows: Descriptors) -> Any:
        """Check descriptors, and return them as they are compared: unit vectors or packed bits."""
        convert = to_bits if self.metadata.is_bits else as_unit_rows
        return convert(rows, name, self.metadata.descriptor_length)

    def positions_of(self, names: Iterable[str]) -> Positions | None:
        """Return the positions of the images with these names; None if none of them has one."""
        images = map(self.image, names)
        of = {image.name: image.position for image in images if image and image.position}
        return Positions(self.axes, of, self.zone) if self.axes and of else None

    def descriptors_of(self, names: Iterable[str]) -> Queries:
        """Read the descriptors of images by name; for bits, unit vectors of the signs."""
        numbers = np.fromiter(map(self._number, names), np.int64)
        found = self._segments[self.removed.rows_of(numbers)]
        return sign_vectors(found) if self.metadata.is_bits else found.astype(np.float32)

    @property
    def descriptors(self) -> Iterator[Descriptors]:
        """Descriptors in order, one array per addition; for bits, unit vectors of the signs."""
        for span, block in zip(self._segments.spans, self._segments.blocks(), strict=True):
            left = self.removed.left(span.first, span.count)
            rows = block if left is None else block[left]
            if len(rows):
                yield sign_vectors(rows) if self.metadata.is_bits else rows

    def parts(self) -> Iterator[NewImages]:
        """Yield the remaining images of each addition, for appending them to another map."""
        blocks = self.descriptors
        spans = zip(self.images.parts, itertools.pairwise(self.images.starts), strict=True)
        for part, (start, end) in spans:
            if start < end:
                images = self.images[start:end]
                names, sizes = [each.name for each in images], [each.bytes for each in images]
                of = {each.name: each.position for each in images if each.position}
                positions = Positions(self.axes, of, self.zone) if self.axes and of else None
                yield NewImages(
                    names, sizes, next(blocks), part.root, positions, part.added, self.folder
                )

    def verify(self) -> None:
        """Read all descriptors, and compare them with the digests in the records.

        Raises:
            InputError: a descriptor has changed; the message says in which addition.
        """
        self._segments.verify()

    def summary(self, *, verify: bool = False) -> dict[str, Any]:
        """Summarise the map as JSON values by name.

        Args:
            verify: whether to read all descriptors, as the method `verify` does.

        Returns:
            Counts of images and positions, the map's folders, additions and extent, the model and
            its settings, and where descriptors are stored.

        Raises:
            InputError: the method `verify` finds a descriptor that has changed.
        """
        if verify:
            self.verify()
        metadata = self.metadata
        return {
            "images": len(self),
            "removed": len(self.removed.rows),
            "positions": sum(image.position is not None for image in self.images),
            "axes": self.axes,
            **contents(self),
            "zone": self.zone and str(self.zone),
            "descriptor": metadata.length_words
            + ("" if metadata.is_bits else f", {metadata.dtype}"),
            "image_size": list(self.config.image_size),
            "resize": self.config.images_in_words,
            **{name: getattr(metadata, name) for name in ("grouping", "store")},
            "search": self.search_kind,
            "stale_search": self.stale_search or "none",
            "components": metadata.pca or "none",
            **{name: getattr(metadata, name) for name in ("model", "weights", "created")},
            "calibration": None if self.calibration is None else to_plain(self.calibration),
            **({"verified": True} if verify else {}),
        }

    def fastest_engine(
        self,
        weights: str | os.PathLike[str] | None = None,
        *,
        groupings: Sequence[str] = ("single",),
    ) -> EngineName | Literal["jax"]:
        """Choose the engine that describes single images fastest, of those that agree with JAX.

        ONNX Runtime or OpenVINO is chosen if it is installed, supports the model and agrees with
        JAX, and JAX has no accelerator; otherwise "jax". Weights are exported once for each engine.

        Args:
            weights: as in `load_model`, which takes the result as `engine`.
            groupings: groupings of the queries.

        Raises:
            InputError: there is no such file, or no installed engine reads an exported folder.
        """
        file = weights_of(self.metadata, self.folder) if weights is None else weights
        any_grouping = set(groupings) != {"single"}
        return fastest_engine(file, self.metadata.config, any_grouping=any_grouping)

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
            weights: the file, or an exported folder; None is the recorded path.
            engine: "jax", "onnxruntime" or "openvino".
            groupings: groupings of the queries.
            verify: whether to compare exported files with their checksums.

        Returns:
            The model, with the image size and data type of the map's images.

        Raises:
            InputError: there is no such file, it is another model, or the engine cannot open it.
        """
        file = weights_of(self.metadata, self.folder) if weights is None else weights
        if engine == "jax":
            from crisalad_jax.checkpoints.weights import read_weights
            from crisalad_jax.nn.model import Model

            found = read_weights(file)
            assert found.digest is not None  # this package's files contain it
            check_model(self.metadata, self.folder, found.digest, file)
            config = with_non_semantic_fields_of(self.config, found.config)
            model = Model(found.params, config)
        else:
            how = {"any_grouping": set(groupings) != {"single"}, "verify": verify}
            model = open_runtime(file, engine, self.metadata.config, **how)
            self._check_describer(cast(Describer, model), file)
        self._describer = model, describer_of(model, groupings)
        return model

    def describer(
        self, model: "Model | Runtime | None" = None, groupings: Sequence[str] = ("single",)
    ) -> Describer:
        """Return the describer of queries, which uses the model that made the map.

        Args:
            model: the model; None uses the last one, or else loads it. The map's image size and
                data type replace those in the model's configuration.
            groupings: groupings of the queries.

        Raises:
            InputError: `model` did not make the map, or does not support these groupings.
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
        check_model(self.metadata, self.folder, describer.digest, given, quantised_from)

    def close(self) -> None:
        """Close the store; a map that nothing refers to any more closes itself."""
        self._close()
