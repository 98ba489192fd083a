"""Build maps from folders of images: each image is described independently, in bounded memory."""

import itertools
import os
import pathlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import frame_time
from crisalad_jax.data.positions import AXES, Positions, exif_positions, positions_of, utm_positions
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import for_each, size_of, whole_name
from crisalad_jax.data.sources import ImageSource, open_sources
from crisalad_jax.data.tracks import Track
from crisalad_jax.retrieval.describe import check_readable, readable, shown
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.maps.appending import AppendableMap, open_for_appending
from crisalad_jax.retrieval.maps.approximate import check_search
from crisalad_jax.retrieval.maps.calibration import check_min_similarity
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import (
    MapMetadata,
    check_model,
    model_config,
    new_metadata,
    read_components,
    read_metadata,
)
from crisalad_jax.retrieval.maps.novelty import Novelty
from crisalad_jax.retrieval.maps.store import check_store, store_name
from crisalad_jax.retrieval.on_cluster import Describing
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash
from crisalad_jax.retrieval.segments import SEGMENT
from crisalad_jax.utils.cluster import check_cluster
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

if TYPE_CHECKING:
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model


@brief
class Indexed(NamedTuple):
    """Counts and names of images after indexing a folder."""

    added: int
    there: int
    """Number of images that the map had already."""
    positions: int
    """Number of added images whose position is known."""
    stay: int
    """Number of given positions that were not used, as the map had their images already."""
    unreadable: list[str]
    """Names of the images that could not be read."""
    unmatched: list[str]
    """Names in the given positions that no image in the folder has."""
    images: int
    """Number of images that the map has now."""
    metadata: MapMetadata
    recall: float | None = None
    """Recall of the approximate search, see `Map.build_search`; None without one."""
    removed: int = 0
    """Number of images that were removed from the map before, and were not added again."""
    near: int = 0
    """Number of images left out by `every_metres`."""
    similar: int = 0
    """Number of images left out by `novelty`."""


def _new_images(
    target: Map, source: ImageSource, left_out: Mapping[str, int], *, again: bool
) -> tuple[dict[str, int], list[pathlib.Path]]:
    """List the images that the map lacks: their sizes by name, and their paths.

    Those that were removed from it are left out, unless their size changed or `again` is set.

    Args:
        target: the map.
        source: the images.
        left_out: sizes in bytes of images that were left out of the map before, by name.
        again: whether to include removed images.

    Raises:
        InputError: a name in the map belongs to another image here.
    """
    sizes, new = {}, []
    all_sizes = for_each(size_of, source.paths)
    # A size of None means a missing file, which is skipped.
    for name, path, size in zip(source.names, source.paths, all_sizes, strict=True):
        known = target.image(name)
        if known is None:
            if size is not None and left_out.get(name) == size:
                continue
            if not again and target.was_removed(name, size):
                continue
            sizes[name] = size or 0
            new.append(path)
        elif size not in (None, known.bytes):
            raise InputError(
                f"{path}: found {size} bytes, but the map has {name!r} of {known.bytes} bytes from "
                f"{known.root}, expected new names for new images"
            )
    return sizes, new


def index(
    model: "Model | Runtime",
    images: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    weights: str | os.PathLike[str],
    fps: float | None = None,
    topic: str | None = None,
    position_topic: str | None = None,
    positions: Positions | Track | str | os.PathLike[str] | None = None,
    every_metres: float | None = None,
    novelty: float | None = None,
    store: str | None = None,
    dtype: Literal["float32", "float16", "bits"] | None = None,
    pca: Pca | str | os.PathLike[str] | None = None,
    search: Literal["auto", "exact", "hnsw", "ivf-rabitq", "diskann"] | None = None,
    again: bool = False,
    reading: Reading = Reading(),
    cluster: str | None = None,
) -> Indexed:
    """Build a map from a folder of images, or append the images that an existing map lacks.

    The same call resumes after a kill.

    Args:
        model: a model from `load`, or a `Runtime`. An existing map needs the model that made it,
            with the same image size and compute dtype.
        images: a folder, searched with its subfolders, or another source of images
            (docs/how-to/image-sources.md); the map names images by their paths in it.
        out: the map's folder.
        weights: the file that the parameters come from, which queries load by default.
        fps: frames per second to take from a video or robot log; None is 1.
        topic: the image topic of a robot log; None takes the only one.
        position_topic: the topic of positions in a log; "none" takes none (see `open_source`).
        positions: where images were taken, or a table or track of positions (`read_track`). None
            takes them from `images`, if that is a table or a robot log; else from @UTM names; else
            from the EXIF data of JPEGs. If @UTM names are in several zones, positions become
            degrees, or metres in an existing map's zone.
        every_metres: minimum distance in metres from the last selected image of the same folder or
            video. Nearer images are left out; images without a position are not. None takes all.
        novelty: maximum cosine similarity to the last selected image of the same folder or video;
            more similar images are left out, as from a robot that stands still. None takes all.
        store: "files", or "milvus:URI". None is the existing map's, or "files" for a new map.
        dtype: type of the stored descriptors; "bits" stores their signs (`pack_bits`), which are
            searched by Hamming distance. None is the existing map's, or "float32" for a new map.
        pca: components from `fit_pca` that shorten the descriptors, or their file; the map stores a
            copy. None is the existing map's, or none for a new map.
        search: the approximate search to build, or to extend by new descriptors; see
            `Map.build_search`. "exact" removes an existing one. None leaves it unchanged, and once
            the map has grown it is no longer used.
        again: whether to add removed images again (`remove_images`).
        reading: how images are read.
        cluster: the Ray cluster that describes the images, as in `extract`; None is this process.

    Returns:
        Counts and names of the images, by what was done with them.

    Raises:
        InputError: the parameters do not match the configuration; no image is readable; `positions`
            match no image; a number is out of range; the map has another model or other settings,
            another process is changing it, or it cannot be written to; the name of an image belongs
            to a different image in the map; or descriptors are not unit vectors.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> quiet = Reading(quiet=True)
        >>> index(model, pictures, folder / "map", weights=weights, reading=quiet).added
        4
    """
    describer = describer_of(model)
    check_cluster(cluster)
    if novelty is not None:
        check_min_similarity(novelty, "novelty")
    out = pathlib.Path(out)
    metadata = read_metadata(out)
    if positions is not None and position_topic is None:
        position_topic = "none"  # a log's positions would not be used
    how = {"fps": fps, "topic": topic, "position_topic": position_topic}
    (source,) = open_sources(images, **how, on_bad_image=reading.on_bad_image)
    table = source.positions if positions is None else positions
    if table is None:
        known = utm_positions(source.names)
        if known.axes == AXES[1] and metadata is None:
            warn(f"{images}: the names are of several zones of UTM: positions become lat, lon")
    else:
        known = positions_of(table, source.names, source.paths, images)
    listed = len(source.names)
    if every_metres is not None:
        spaced = source.spaced(known if known.of else source.located(), every_metres)
        near = set(source.names) - set(spaced.names)
        known = known._replace(of={name: at for name, at in known.of.items() if name not in near})
        source = spaced
    components = pca if pca is None or isinstance(pca, Pca) else load_pca(pca)
    if metadata is None:
        options: dict[str, Any] = {"store": store or "files", "dtype": dtype or "float32"}
        metadata = new_metadata(describer, weights, out, pca=components, **options)
    else:
        check_model(metadata, out, describer.digest, weights)
        check_settings(metadata, out, describer.config, dtype, store, components)
        components = read_components(out, metadata)
    if search is not None:
        check_search(search, metadata.store, metadata.dtype)
    if table is None and not known.of:
        known = None
    describing = Describing(describer, reading.fitted(len(source.paths)), components)
    with open_for_appending(out, metadata, components) as target:
        before = len(target)
        given = () if table is None or known is None else known.of.keys()
        there = {name for name in (*source.names, *given) if target.images.find(name) is not None}
        unreadable = _append(target, source, known, describing, cluster, novelty, again=again)
        check_readable(source.root, len(source.paths), len(target))
        recall = None if search is None else target.build_search(search, quiet=reading.quiet)
        added, names = target.images[before:], set(source.names)
        result = Indexed(
            added=len(added),
            there=len(there & names),
            positions=sum(image.position is not None for image in added),
            stay=len(there.intersection(given)),
            unreadable=unreadable,
            unmatched=[name for name in given if name not in names],
            images=len(target),
            metadata=metadata,
            recall=recall,
            removed=sum(map(target.was_removed, source.names)),
            near=listed - len(source.names),
        )
    if novelty is not None:
        rest = len(names) - result.there - result.added - len(unreadable) - result.removed
        result = result._replace(similar=rest)
    if result.added == result.images and describer.config.cross_image.attends:
        warn(
            f"{out}: a map describes images independently, and this model attends across them: "
            "recalls published for batches do not apply to the map (`crisalad evaluate "
            "--grouping single` measures those of single images)"
        )
    return result


def _append(
    target: AppendableMap,
    source: ImageSource,
    positions: Positions | None,
    describing: Describing,
    cluster: str | None,
    novelty: float | None,
    *,
    again: bool,
) -> list[str]:
    """Describe images the way the map's were, and append them, `SEGMENT` at a time.

    Images whose names the map has are left out, so that the same call resumes after a kill.

    Args:
        target: the map.
        source: the images.
        positions: where they were taken; None reads the images' EXIF data.
        describing: the model, and how images are read.
        cluster: as in `index`, like the rest.
        novelty: maximum similarity to the last selected image.
        again: whether to include removed images.

    Returns:
        The names of the images that cannot be read.

    Raises:
        InputError: an image cannot be read; a name in a map belongs to another image here; or what
            `AppendableMap.append` raises.
    """
    root, total = whole_name(source.root), len(source.paths)
    choice = None if novelty is None else Novelty(target, source, root, novelty)
    left_out = {} if choice is None else choice.left_out
    sizes, new = _new_images(target, source, left_out, again=again)
    if positions is None:
        positions = _by_exif(target, zip(sizes, new, strict=True))
    target.fitted(sizes, positions)  # checks them before any work
    unreadable: list[str] = []
    stream, quiet = describing.stream(new, cluster), describing.reading.quiet
    stream = shown(stream, "images", total, quiet=quiet, done=total - len(new))
    for names, rows in readable(stream, SEGMENT, list(sizes), unreadable):
        is_new = np.ones(len(names), bool) if choice is None else choice.choose(names, rows)
        new, alike = (list(itertools.compress(names, which)) for which in (is_new, ~is_new))
        if new:
            given = new, [sizes[name] for name in new], rows[is_new]
            target.append(*given, root=root, positions=positions)
        if choice is not None and alike:
            choice.leave_out(alike, [sizes[name] for name in alike])
    return unreadable


def _by_exif(target: Map, images: Iterable[tuple[str, pathlib.Path]]) -> Positions:
    """Read where JPEGs were taken, if the map's own positions are in degrees too."""
    found = exif_positions(each for each in images if frame_time(each[1]) is None)
    if found.of and target.axes not in (None, found.axes):
        warn(
            f"{target.folder}: left out the EXIF positions of {len(found.of)} images, expected "
            f"{', '.join(target.axes or ())} as in the map"
        )
        return utm_positions(())
    return found


def check_settings(
    metadata: MapMetadata,
    folder: pathlib.Path,
    config: "ModelConfig",
    dtype: str | None = None,
    store: str | None = None,
    pca: Pca | None = None,
) -> None:
    """Raise InputError if a configuration or given setting differs from that of an existing map."""
    if store is not None:
        check_store(store, metadata.dtype)
    there = model_config(metadata, folder)
    for name, found, expected in (
        ("images at", config.images_in_words, there.images_in_words),
        ("compute dtype", config.compute_dtype, there.compute_dtype),
        ("dtype", dtype, metadata.dtype),
        ("store", store and store_name(store, folder), metadata.store),
        ("components", pca and pca_hash(pca)[:12], metadata.pca[:12] or "none"),
    ):
        if found is not None and found != expected:
            raise InputError(f"{folder}: found {name} {found}, expected {expected} as in the map")
