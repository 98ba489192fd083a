"""Correct maps: remove, replace and move images, and merge maps, each in one change."""

import collections
import contextlib
import dataclasses
import datetime
import difflib
import fnmatch
import itertools
import os
import pathlib
import re
import uuid
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import require
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import file_of, stored_bytes
from crisalad_jax.data.positions import Positions, positions_of
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import open_sources
from crisalad_jax.data.tracks import Track
from crisalad_jax.retrieval.describe import check_readable, described, readable, shown
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.maps.appending import AppendableMap, open_for_appending
from crisalad_jax.retrieval.maps.build import check_settings
from crisalad_jax.retrieval.maps.images import MapImage, NewImages
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import (
    MapMetadata,
    check_model,
    existing_metadata,
    read_metadata,
)
from crisalad_jax.retrieval.maps.store import store_name
from crisalad_jax.retrieval.segments import SEGMENT
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_folder, real_path
from crisalad_jax.utils.progress import progress_bar

if TYPE_CHECKING:
    from crisalad_jax.nn.model import Model

_SAME = 0.99
"""Minimum similarity of two descriptors of one picture: batches, float16 and bits round them."""
_NEAR = 10_000
"""Number of names among which to look for one similar to a missing name."""


@brief
class MapChange(NamedTuple):
    """The result of a change to a map."""

    names: list[str]
    """Names of the images that were removed, replaced, moved or merged into the map."""
    there: int
    """Number of images that needed no change: removed before, unchanged, or in the map already."""
    images: int
    """Number of images that the map has now."""
    unmatched: Sequence[str] = ()
    """Given names that no image of the map has."""
    unreadable: Sequence[str] = ()
    """Names of images that could not be read, and stay as they were."""
    stay_out: int = 0
    """Number of images that were removed from the map before, and are not merged into it."""
    stale_search: str | None = None
    """Kind of the approximate search, if it is unused because its index lacks images; else None."""


def find_images(
    places: Map, patterns: Sequence[str], addition: int | None = None, day: str | None = None
) -> tuple[list[int], int]:
    """Find images by name or pattern, as in `remove_images`; without patterns, find all.

    Returns:
        Their numbers in order, and how many of the named images had been removed before.

    Raises:
        InputError: the map has no such addition or day, or a name or pattern matches no image.
    """
    additions = places.additions
    ends = [0, *itertools.accumulate(each.images for each in additions)]
    if addition is not None and not 1 <= addition <= len(additions):
        raise InputError(f"addition: found {addition}, expected 1 to {len(additions)}")
    days = list(dict.fromkeys(each.day for each in additions))
    if day is not None and day not in days:
        known = ", ".join(each or "unknown" for each in days[-8:])
        raise InputError(f"day: found {day}, expected one of {known}")
    among = [
        number
        for index, each in enumerate(additions)
        if addition in (None, index + 1) and day in (None, each.day)
        for number in range(ends[index], ends[index + 1])
    ]
    if not patterns:
        return among, 0
    numbers = {places.images[number].name: number for number in among}
    found, before = set[int](), set[str]()
    for pattern in patterns:
        if pattern in numbers:
            found.add(numbers[pattern])
            continue
        matches = re.compile(fnmatch.translate(pattern)).match
        some = {number for name, number in numbers.items() if matches(name)}
        gone = {name for name in places.images.removed_names if matches(name) or name == pattern}
        if not some and not gone:
            near = difflib.get_close_matches(pattern, list(numbers)[:_NEAR])
            words = f"did you mean {' or '.join(near)}?" if near else "see `crisalad map list`"
            raise InputError(f"{places.folder}: found no image {pattern!r}; {words}")
        found |= some
        before |= set() if some else gone
    return sorted(found), len(before)


def remove_images(
    folder: str | os.PathLike[str],
    names: Sequence[str] = (),
    *,
    addition: int | None = None,
    day: str | None = None,
) -> MapChange:
    """Remove images from a map; their descriptors stay in its files but are no longer found.

    `index` does not add them again, unless their file sizes change or `again` is set.

    Args:
        folder: the map's folder.
        names: names of images, or patterns such as "monday/*", where * matches any characters, ?
            matches one, and [ab] matches a or b. Optional with `addition` or `day`.
        addition: only images of this addition, counted from 1 in `Map.additions`.
        day: only images that were added on this day, as YYYY-MM-DD in UTC.

    Returns:
        What was removed.

    Raises:
        InputError: no name, addition or day is given; one of these matches no image; no image would
            be left; or the map cannot be opened for changes.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, Reading, index, init_crisalad, save_weights
        >>> model = Model(init_crisalad(jax.random.key(0), PRESETS["tiny"]), PRESETS["tiny"])
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=Reading(quiet=True))
        >>> remove_images(folder / "map", ["[12].png"]).names
        ['1.png', '2.png']
    """
    names = [names] if isinstance(names, str) else list(names)
    if not names and addition is None and day is None:
        raise InputError("names: found none, expected names or patterns, an addition or a day")
    with open_for_appending(folder, existing_metadata(folder)) as places:
        numbers, there = find_images(places, names, addition, day)
        found = [places.images[number].name for number in numbers]
        if numbers:
            places.change("remove", removed=numbers)
        return MapChange(found, there, len(places), stale_search=places.stale_search)


def replace_images(
    model: "Model | Runtime",
    images: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    weights: str | os.PathLike[str],
    fps: float | None = None,
    reading: Reading = Reading(),
) -> MapChange:
    """Re-describe the images of a map whose files have changed, in a single change.

    A file has changed if its size differs, or if it was written after the image was described. The
    images keep their positions, and become the last ones of the map.

    Args:
        model: the model that made the map.
        images: where the files are, as in `index`.
        folder: the map's folder.
        weights: the file that the parameters come from, for messages.
        fps: frames per second to take from videos; None is 1.
        reading: how images are read.

    Returns:
        What was replaced; `unmatched` lists names in `images` that the map does not have.

    Raises:
        InputError: `model` did not make the map; no image's name is in the map; none is readable,
            or an unreadable one is not skipped; or the map cannot be opened for changes.

    Example:
        >>> import cv2, jax
        >>> from crisalad_jax import PRESETS, Model, Reading, index, init_crisalad, save_weights
        >>> model = Model(init_crisalad(jax.random.key(0), PRESETS["tiny"]), PRESETS["tiny"])
        >>> weights, quiet = folder / "weights.safetensors", Reading(quiet=True)
        >>> save_weights(weights, model)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
        >>> (folder / "new").mkdir()
        >>> changed = cv2.imread(str(pictures / "1.png"))[::2]
        >>> _ = cv2.imwrite(str(folder / "new" / "3.png"), changed)
        >>> new = folder / "new"
        >>> replace_images(model, new, folder / "map", weights=weights, reading=quiet).names
        ['3.png']
    """
    describer = describer_of(model)
    metadata = existing_metadata(folder)
    check_model(metadata, folder, describer.digest, weights)
    check_settings(metadata, pathlib.Path(folder), describer.config)
    (source,) = open_sources(images, fps=fps, on_bad_image=reading.on_bad_image)
    with open_for_appending(folder, metadata) as places:
        files = dict(zip(source.names, source.paths, strict=True))
        known = {name: image for name in files if (image := places.image(name))}
        if not known:
            raise InputError(
                f"{images}: found none of the {len(places)} images of {folder}, expected names "
                f"such as {places.images[0].name!r}"
            )
        changed = [
            name
            for name, image in known.items()
            if _has_changed(image, places.added(name), files[name])
        ]
        unreadable, root = list[str](), real_path(source.root).as_posix()
        paths = [files[name] for name in changed]
        stream = described(
            describer, paths, reading.fitted(len(paths)), components=places.components
        )
        stream = shown(stream, "images", len(paths), quiet=reading.quiet)

        def parts() -> Iterator[NewImages]:
            for names, descriptors in readable(stream, SEGMENT, changed, unreadable):
                sizes = [stored_bytes(files[name]) or 0 for name in names]
                yield NewImages(names, sizes, descriptors, root, places.positions_of(names))
            check_readable(images, len(paths), len(paths) - len(unreadable))

        if changed:
            places.change("replace", added=parts())
        lost = set(unreadable)
        replaced = [name for name in changed if name not in lost]
        unmatched = [name for name in files if places.image(name) is None]
        counts = len(known) - len(changed), len(places)
        return MapChange(replaced, *counts, unmatched, unreadable, 0, places.stale_search)


def _has_changed(image: MapImage, added: str | None, path: pathlib.Path) -> bool:
    if added is None or stored_bytes(path) != image.bytes:  # a missing file is skipped, or refused
        return True
    written = int(file_of(path).stat().st_mtime)
    return written > datetime.datetime.fromisoformat(added).timestamp()


def move_images(
    folder: str | os.PathLike[str], positions: Positions | Track | str | os.PathLike[str]
) -> MapChange:
    """Give images of a map new positions, such as poses after SLAM.

    Positions are converted to the map's axes and UTM zone. They may have other axes if no other
    image of the map has a position.

    Args:
        folder: the map's folder.
        positions: positions by name, or a table or track of them, as in `index`.

    Returns:
        What was moved.

    Raises:
        InputError: the positions match none of the images, or don't fit the map's axes or zone; or
            the map cannot be opened for changes.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, Reading, index, init_crisalad, save_weights
        >>> model = Model(init_crisalad(jax.random.key(0), PRESETS["tiny"]), PRESETS["tiny"])
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=Reading(quiet=True))
        >>> _ = (folder / "poses.csv").write_text("name,x,y\\n1.png,2,3.5")
        >>> move_images(folder / "map", folder / "poses.csv").names
        ['1.png']
    """
    with open_for_appending(folder, existing_metadata(folder)) as places:
        names = [image.name for image in places.images]
        paths = [pathlib.Path(image.root, image.name) for image in places.images]
        given = positions_of(positions, names, paths, folder)
        of = {name: at for name, at in given.of.items() if places.image(name) is not None}
        unmatched = [name for name in given.of if name not in of]
        moved = places.fitted_anew(given._replace(of=of))
        if (moved.axes, moved.zone) == (places.axes, places.zone):
            now = places.positions_of(of)
            there = {} if now is None else now.of
            of = {name: at for name, at in moved.of.items() if at != there.get(name)}
            moved = moved._replace(of=of)
        same = len(given.of) - len(unmatched) - len(moved.of)
        if moved.of:
            places.change("move", moved=moved)
        return MapChange(list(moved.of), same, len(places), unmatched)


def merge_maps(
    folder: str | os.PathLike[str],
    *others: str | os.PathLike[str],
    store: str | None = None,
    quiet: bool = True,
) -> MapChange:
    """Merge maps of the same model and settings into a map, which is created if it is missing.

    Images removed from their map or from `folder` stay out. The rest keep their folders and dates.

    Args:
        folder: the map's folder.
        others: the folders of the maps whose images are appended.
        store: "files", or "milvus:URI", where float16 descriptors become float32. None is the
            existing map's, or "files" for a new map.
        quiet: whether to hide the progress bar.

    Returns:
        What was appended.

    Raises:
        InputError: models or settings of the maps differ; two different images have the same name;
            positions don't fit the map's axes or zone; `store` is not that of an existing map; or a
            map cannot be opened.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, Reading, index, init_crisalad, save_weights
        >>> model = Model(init_crisalad(jax.random.key(0), PRESETS["tiny"]), PRESETS["tiny"])
        >>> weights, quiet = folder / "weights.safetensors", Reading(quiet=True)
        >>> save_weights(weights, model)
        >>> for number in (1, 2):
        ...     image = pictures / f"{number}.png"
        ...     _ = index(model, image, folder / f"map{number}", weights=weights, reading=quiet)
        >>> merge_maps(folder / "both", folder / "map1", folder / "map2").images
        2
    """
    require(bool(others), "others: found none, expected at least one map")
    folder = pathlib.Path(folder)
    with contextlib.ExitStack() as stack:
        is_other = real_path(folder) not in map(real_path, others)
        require(is_other, f"{folder}: found the map itself, expected others")
        opened = [stack.enter_context(Map.open(each, calibrated=False)) for each in others]
        metadata = read_metadata(folder)
        exists = metadata is not None
        if metadata is not None:
            if store is not None and store_name(store, folder) != metadata.store:
                raise InputError(f"{folder}: found store {store}, expected {metadata.store}")
            target = stack.enter_context(open_for_appending(folder, metadata))
        else:
            first = opened[0].metadata
            is_wider = store not in (None, "files") and first.dtype == "float16"
            metadata = dataclasses.replace(
                first,
                store=store_name(store or "files", folder),
                dtype="float32" if is_wider else first.dtype,
                collection=f"crisalad_{uuid.uuid4().hex}",
                created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            )
            temporary = stack.enter_context(atomic_folder(folder))
            components = opened[0].components
            target = stack.enter_context(open_for_appending(temporary, metadata, components))
        for other in opened:
            _check_alike(other, metadata, target.folder if exists else opened[0].folder)
        return _merge(target, opened, quiet=quiet)


def _check_alike(other: Map, metadata: MapMetadata, folder: pathlib.Path) -> None:
    theirs, ours = (
        {"model": each.model, **each.config, "dtype": each.dtype, "pca": each.pca}
        for each in (other.metadata, metadata)
    )
    for name, expected in ours.items():
        found = theirs.get(name)
        if found != expected and not (metadata.store != "files" and found == "float16"):
            most = 12 if name in ("model", "pca") else 60  # digests are shortened as in `query`
            found, expected = (str(each)[:most] or "none" for each in (found, expected))
            words = f"found a map of {name} {found}, expected {expected} as in {folder}"
            raise InputError(f"{other.folder}: {words}")


def _merge(target: AppendableMap, others: Sequence[Map], *, quiet: bool) -> MapChange:
    sources = dict[str, Map]()
    """The map that each merged image comes from, by name."""
    merged, there, stay_out = list[str](), 0, 0
    total = sum(map(len, others))
    with progress_bar("merging", total, "images", quiet=quiet) as bar:

        def parts() -> Iterator[NewImages]:
            nonlocal there, stay_out
            for other in others:
                for part in other.parts():
                    known = [bool(name in sources or target.image(name)) for name in part.names]
                    gone = list(map(target.was_removed, part.names, part.sizes))
                    _check_same(part.only(known), other, sources, target)
                    new = part.only([not any(pair) for pair in zip(known, gone, strict=True)])
                    there += sum(known)
                    stay_out += sum(gone)
                    if new.names:
                        yield new
                    merged.extend(new.names)
                    sources.update(dict.fromkeys(new.names, other))
                    bar.advance(len(part.names))

        found = parts()
        first = next(found, None)
        if first is not None:
            target.change("merge", added=itertools.chain([first], found))
    return MapChange(merged, there, len(target), (), (), stay_out, target.stale_search)


def _check_same(part: NewImages, other: Map, sources: dict[str, Map], target: Map) -> None:
    """Check that names that two maps share are of the same image, by its size and descriptor.

    The other map is the one in `sources`, or else the target.
    """
    by_source = collections.defaultdict[Map, list[int]](list)
    for number, name in enumerate(part.names):
        by_source[sources.get(name, target)].append(number)
    for source, numbers in by_source.items():
        names = [part.names[number] for number in numbers]
        theirs = source.descriptors_of(names)
        similar = np.einsum("nd,nd->n", theirs, other.descriptors_of(names))
        for number, name, similarity in zip(numbers, names, similar, strict=True):
            image = source.image(name)
            if image is None or image.bytes != part.sizes[number] or similarity < _SAME:
                raise InputError(
                    f"{other.folder}: found {name!r}, which is another image in {source.folder}, "
                    "expected other names: remove it from one of the two maps first"
                )
