"""Build maps from folders of images: each image is described independently, in bounded memory."""

import contextlib
import dataclasses
import os
import pathlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import choose
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.positions import AXES, Positions, exif_positions, positions_of, utm_positions
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import ImageSource, check_rate_used, open_source
from crisalad_jax.data.video import file_of, frame_time
from crisalad_jax.retrieval.describe import Described, described
from crisalad_jax.retrieval.describer import Describer, describer_of
from crisalad_jax.retrieval.maps.approximate import SEARCHES
from crisalad_jax.retrieval.maps.map import Map, MapImage, open_for_appending
from crisalad_jax.retrieval.maps.metadata import (
    SHARES,
    MapMetadata,
    check_model,
    has_images,
    model_config,
    new_metadata,
    read_components,
    read_metadata,
)
from crisalad_jax.retrieval.maps.recovery import check_no_record_lost
from crisalad_jax.retrieval.maps.store import store_name
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash
from crisalad_jax.retrieval.segments import SEGMENT, Share, Shares, digest_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar

if TYPE_CHECKING:
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model

_TOGETHER = 4096
"""Number of images of a share that are joined as one addition: a search opens fewer files."""


@brief
class Indexed(NamedTuple):
    """Counts and names of a folder's images after indexing it."""

    added: int
    there: int
    """Number of images that the map had already."""
    positions: int
    """Number of added images whose position is known."""
    stay: int
    """Number of given positions of images that the map had already; it keeps its own."""
    unreadable: list[str]
    """Names of the images that could not be read."""
    unmatched: list[str]
    """Names in the given positions that no image in the folder has."""
    images: int
    """Number of images that the map has now."""
    metadata: MapMetadata
    recall: float | None = None
    """What the approximate search recalls, see `Map.build_search`; None where none was asked."""
    shares_left: int = 0
    """Number of shares that are not there yet; until then these are counts of one share."""
    joined_elsewhere: bool = False
    """Whether another process joins the shares, so that these are counts of one share."""


def index_images(
    target: Map,
    describer: Describer,
    source: ImageSource,
    positions: Positions,
    reading: Reading = Reading(),
) -> Indexed:
    """Describe images as the map's are, and append them, `SEGMENT` at a time.

    Images whose names the map has are left out, so that the same call resumes after a kill.

    Args:
        target: the map, open for appending.
        describer: the map's model.
        source: the images.
        positions: positions by name, as far as known.
        reading: how images are read.

    Raises:
        InputError: an image cannot be read; a name in the map is of another image here; or what
            `Map.append` raises.
    """
    names, sizes, new = _new_images(target, source)
    target.fitted(names, positions)  # checks them before any work
    stay = sum(target.image(name) is not None for name in positions.of)
    waiting: list[Described] = []
    unreadable: list[str] = []
    known, there = len(target), len(source.paths) - len(new)

    def append() -> None:
        chosen = [int(i) for part in waiting for i in part.indices]
        if chosen:
            target.append(
                [names[i] for i in chosen],
                [sizes[i] for i in chosen],
                np.concatenate([part.descriptors for part in waiting]),
                root=real_path(source.root).as_posix(),
                positions=positions,
            )
        waiting.clear()

    with progress_bar(
        "images", len(source.paths), "images", quiet=reading.quiet, done=there
    ) as bar:
        for part in described(describer, new, reading, components=target.components):
            waiting.append(part)
            unreadable += [names[i] for i in part.unreadable]
            bar.advance(len(part.indices) + len(part.unreadable))
            if sum(len(each.indices) for each in waiting) >= SEGMENT:
                append()
        append()
    added = target.images[known:]
    return Indexed(
        added=len(added),
        there=there,
        positions=sum(image.position is not None for image in added),
        stay=stay,
        unreadable=unreadable,
        unmatched=sorted(positions.of.keys() - set(source.names), key=list(positions.of).index),
        images=len(target),
        metadata=target.metadata,
    )


def _new_images(
    target: Map, source: ImageSource
) -> tuple[list[str], list[int], list[pathlib.Path]]:
    """List names, sizes and paths of the images that a map does not have.

    Raises:
        InputError: a name in the map is of another image here.
    """
    names, sizes, new = [], [], []
    for name, path in zip(source.names, source.paths, strict=True):
        file = file_of(path)
        size = file.stat().st_size if file.is_file() else None  # missing: to be skipped
        if (known := target.image(name)) is None:
            names.append(name)
            sizes.append(size or 0)
            new.append(path)
        elif size not in (None, known.bytes):
            raise InputError(
                f"{path}: found {size} bytes, but the map has {name!r} of {known.bytes} bytes from "
                f"{known.root}, expected new names for new images"
            )
    return names, sizes, new


def index(
    model: "Model | Runtime",
    images: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    weights: str | os.PathLike[str],
    fps: float | None = None,
    positions: Positions | str | os.PathLike[str] | None = None,
    store: str | None = None,
    dtype: Literal["float32", "float16"] | None = None,
    pca: Pca | str | os.PathLike[str] | None = None,
    search: Literal["exact", "hnsw", "ivf-pq"] | None = None,
    share: str | None = None,
    reading: Reading = Reading(),
) -> Indexed:
    """Make a map of a folder of images, or append to it those that it lacks.

    The same call resumes after a kill.

    Args:
        model: parameters and configuration, as `load` returns them, or a `Runtime`. Images are
            resized and computed as the configuration of a new map says, and as those that an
            existing map has.
        images: the folder, searched with its subfolders; the map names images by their paths in it.
            Or another source of images (docs/how-to/image-sources.md).
        out: the map's folder.
        weights: the file that the parameters are from, which queries load by default.
        fps: frames a second taken of a video, which is then expected; None is one.
        positions: where images were taken, or a table of it. None is what `images` says, if that
            is a table; else what @UTM names say; else what the EXIF data of JPEGs says. Names of
            several zones of UTM give degrees, or metres of the map's zone.
        store: "files", or "milvus:URI". None is the map's, and of a new map "files".
        dtype: type of the stored descriptors. None is the map's, and of a new map "float32".
        pca: components that shorten the descriptors, or a file of them, of which the map stores a
            copy. None is the map's, and of a new map none.
        search: the approximate search that is built from the map's descriptors; "exact" removes
            one. None leaves what there is, which is of no use once the map has grown.
        share: INDEX/COUNT, to describe one share of the images; processes on any hosts that see the
            same folders take the others, and the last one to end joins all.
        reading: how images are read.

    Returns:
        What became of the images.

    Raises:
        InputError: parameters of another configuration; no image, or none that can be read;
            positions of none of them; a map of another model or of other
            settings; what `index_images`, `new_metadata` and `open_for_appending` raise.

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
    if search is not None:
        choose("search", search, SEARCHES)
    part = None if share is None else Share.parse(share)
    out = pathlib.Path(out)
    metadata = read_metadata(out)
    if not has_images(out):
        check_no_record_lost(out)  # before any work
        metadata = None  # a map that a kill left without images binds nobody
    source = open_source(images, fps=fps, on_bad_image=reading.on_bad_image)
    check_rate_used(fps, source.paths)
    table = source.positions if positions is None else positions
    if table is None:
        known = utm_positions(source.names)
    else:
        known = positions_of(table, source.names, images)
    by_exif = table is None and not known.of
    if table is None and known.axes == AXES[1] and metadata is None:
        warn(f"{images}: the names are of several zones of UTM: positions become lat, lon")
    components = pca if pca is None or isinstance(pca, Pca) else load_pca(pca)
    reading = reading.fitted(len(source.paths))
    if metadata is None:
        options: dict[str, Any] = {"store": store or "files", "dtype": dtype or "float32"}
        metadata = new_metadata(describer, weights, out, pca=components, **options)
    else:
        check_model(metadata, out, describer.digest, weights)
        _check_settings(metadata, out, describer.config, dtype, store, components)
        components = read_components(out, metadata)
    if search not in (None, "exact") and metadata.store != "files":
        raise InputError(
            f"search: found {search}, expected exact, as {metadata.store} is searched by Milvus"
        )

    def describe(target: Map, source: ImageSource, whole: Map | None) -> Indexed:
        here = _by_exif(whole or target, source) if by_exif else known
        return index_images(target, describer, source, here, reading)

    def finish(target: Map) -> float | None:
        if not len(target):
            raise InputError(f"{images}: found {len(source.paths)} images, none of them readable")
        return None if search is None else target.build_search(search, quiet=reading.quiet)

    if part is None:
        with open_for_appending(out, metadata, components) as target:
            result = describe(target, source, None)
            result = result._replace(recall=finish(target))
    else:
        settings = {
            "dtype": metadata.dtype,
            "pca": metadata.pca,
            "batch_size": reading.batch_size,
            "config": metadata.config,
            "digest": describer.digest,
        }
        shares = Shares(out / SHARES, part, digest_of(source.names, settings))
        mine = part.of(len(source.paths), reading.batch_size)
        own = source._replace(paths=source.paths[mine], names=source.names[mine])
        result = _index_share(
            shares, source, own, describe, finish, metadata, components, known, reading.quiet
        )
    return result if table is not None else result._replace(stay=0)


def _index_share(
    shares: Shares,
    source: ImageSource,
    own: ImageSource,
    describe: Callable[[Map, ImageSource, Map | None], Indexed],
    finish: Callable[[Map], float | None],
    metadata: MapMetadata,
    components: Pca | None,
    positions: Positions,
    quiet: bool,
) -> Indexed:
    """Index the images of one share in a map of its own; if it is the last one, join all.

    Raises:
        InputError: a share of other settings is there; what `describe` and `finish` raise.
    """
    out = shares.folder.parent
    listed = set(source.names)
    unmatched = [name for name in positions.of if name not in listed]
    result = Indexed(0, 0, 0, 0, [], unmatched, 0, metadata)
    with contextlib.ExitStack() as stack:
        whole = None
        if has_images(out):
            whole = stack.enter_context(Map.open(out, verify=False, calibrated=False))
            whole.fitted(source.names, positions)
            new = set(_new_images(whole, source)[0])
            stay = sum(whole.image(name) is not None for name in positions.of)
            result = result._replace(there=len(listed - new), stay=stay, images=len(whole))
            if not new and not shares.folder.exists():
                return result
            chosen = [i for i, name in enumerate(own.names) if name in new]
            own = own._replace(
                paths=[own.paths[i] for i in chosen], names=[own.names[i] for i in chosen]
            )
        if shares.result(shares.share.index) is None:
            shares.check_same_count()
            with open_for_appending(shares.own, _of_share(shares, metadata), components) as target:
                unreadable = describe(target, own, whole).unreadable
                located = sum(image.position is not None for image in target.images)
                counts = {"added": len(target), "positions": located, "unreadable": unreadable}
            if not counts["added"]:
                shutil.rmtree(shares.own)
            shares.finish(counts)
            result = result._replace(**counts, images=counts["added"])
    if left := shares.left():
        return result._replace(shares_left=left)
    with shares.joining() as results:
        if results is None:
            return result._replace(joined_elsewhere=True)
        existing = read_metadata(out) if has_images(out) else None
        with open_for_appending(out, existing or metadata, components) as target:
            total = sum(each["added"] for each in results)
            with progress_bar("joining", total, "images", quiet=quiet) as bar:
                for index in range(shares.share.count):
                    _append_share(target, shares.path(index), bar.advance)
            recall, images = finish(target), len(target)
    return result._replace(
        added=total,
        positions=sum(each["positions"] for each in results),
        unreadable=[name for each in results for name in each["unreadable"]],
        images=images,
        recall=recall,
    )


def _of_share(shares: Shares, metadata: MapMetadata) -> MapMetadata:
    """Return the metadata of a share's own map, which a killed process may have made.

    Raises:
        InputError: that map is of another model or of other settings.
    """
    mine = dataclasses.replace(metadata, store="files")
    there = read_metadata(shares.own)
    if there is None or not has_images(shares.own):
        return mine
    changes = {name: getattr(mine, name) for name in ("created", "collection", "weights")}
    if dataclasses.replace(there, **changes) != mine:
        raise InputError(
            f"{shares.own}: found a share of another model or other settings, expected those of "
            "before; remove it to start again"
        )
    return there


def _append_share(target: Map, folder: pathlib.Path, advance: Callable[[int], None]) -> None:
    """Append the images of a share's map that the whole map lacks, and remove the share's."""
    if not folder.exists():
        return  # it is joined, or had no new image
    with Map.open(folder) as part:
        for images, rows in _additions(part):
            advance(len(images))
            new = [i for i, image in enumerate(images) if target.image(image.name) is None]
            of = {images[i].name: images[i].position for i in new}
            of = {name: position for name, position in of.items() if position is not None}
            if new:
                target.append(
                    [images[i].name for i in new],
                    [images[i].bytes for i in new],
                    rows[new],
                    root=images[0].root,
                    positions=None if part.axes is None else Positions(part.axes, of, part.zone),
                )
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


def _by_exif(target: Map, source: ImageSource) -> Positions:
    """Read where JPEGs that the map lacks were taken, if its own positions are in degrees too."""
    new = (
        (name, path)
        for name, path in zip(source.names, source.paths, strict=True)
        if target.image(name) is None and frame_time(path) is None
    )
    found = exif_positions(new)
    if found.of and target.axes not in (None, found.axes):
        warn(
            f"{target.folder}: left out the EXIF positions of {len(found.of)} images, expected "
            f"{', '.join(target.axes or ())} as in the map"
        )
        return utm_positions(())
    return found


def _check_settings(
    metadata: MapMetadata,
    folder: pathlib.Path,
    config: "ModelConfig",
    dtype: str | None,
    store: str | None,
    pca: Pca | None,
) -> None:
    """Check that a model's configuration and the given settings agree with an existing map."""
    there = model_config(metadata, folder)
    for name, found, expected in (
        ("images at", config.images_in_words, there.images_in_words),
        ("compute dtype", config.compute_dtype, there.compute_dtype),
        ("dtype", dtype, metadata.dtype),
        ("store", store and store_name(store, folder, metadata.dtype), metadata.store),
        ("components", pca and pca_hash(pca)[:12], metadata.pca[:12] or "none"),
    ):
        if found is not None and found != expected:
            raise InputError(f"{folder}: found {name} {found}, expected {expected} as in the map")
