"""Rebuild a map with another model, and replace the old map once the new one is complete."""

import dataclasses
import os
import pathlib
import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import address_of, for_each, size_of
from crisalad_jax.data.sources import ImageSource, join_sources
from crisalad_jax.retrieval.describe import described
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.approximate import FOLDER
from crisalad_jax.retrieval.maps.images import NewImages
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import (
    METADATA,
    SEGMENTS,
    MapMetadata,
    existing_metadata,
    new_metadata,
)
from crisalad_jax.utils.files import exchange, real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.temporaries import LOCK, in_use, is_temporary

if TYPE_CHECKING:
    from crisalad_jax.nn.model import Model


def source_of_map(places: Map) -> ImageSource:
    """Find the image files of an open map in the folders from which they were indexed.

    Returns:
        The files, their names, and the positions where the images were taken.

    Raises:
        InputError: a file is missing, or its size differs from the one that the map records; or the
            map was indexed from several folders, and one of them is remote.
    """
    check_images(places)
    roots: dict[str, list[str]] = {}
    for image in places.images:
        roots.setdefault(image.root, []).append(image.name)
    sources = [
        ImageSource(
            pathlib.Path(root),
            [pathlib.Path(root) / name for name in names],
            names,
            places.positions_of(names),
        )
        for root, names in roots.items()
    ]
    return join_sources(sources)


def check_images(places: Map) -> None:
    """Check that a map's image files are still in the folders from which they were indexed.

    Raises:
        InputError: a file is missing, or its size differs from the one that the map records.
    """
    paths = [pathlib.Path(image.root) / image.name for image in places.images]
    for path, size, image in zip(paths, for_each(size_of, paths), places.images, strict=True):
        found = "it gone" if size is None else f"{size} bytes"
        require(
            size == image.bytes,
            f"{address_of(path)}: found {found}, expected the image of {image.bytes} bytes that "
            f"{places.folder} describes",
        )


def check_remakeable(folder: str | os.PathLike[str]) -> MapMetadata:
    """Check that `remake_map` can rebuild the map in a folder, and return its metadata.

    Raises:
        InputError: there is no map; its descriptors are in Milvus or reduced by PCA; or the folder
            also holds files that would be lost, such as pictures sent to `serve_map`.
    """
    folder, metadata = pathlib.Path(folder), existing_metadata(folder)
    advice = "`crisalad index` makes another map"
    require(
        metadata.store == "files",
        f"{folder}: found descriptors in {metadata.store}, expected files ({advice})",
    )
    require(
        not metadata.pca,
        f"{folder}: found components, which were fitted to its descriptors, expected none "
        f"({advice})",
    )
    own = {METADATA, SEGMENTS, LOCK, FOLDER, *(path.name for path in folder.glob("calibration*"))}
    found = {path.name for path in folder.iterdir() if not is_temporary(path)}
    others = sorted(found - own)
    require(
        not others,
        f"{folder}: found {', '.join(others)} in the folder, expected only the map ({advice})",
    )
    return metadata


def remake_map(
    folder: str | os.PathLike[str],
    model: "Model",
    *,
    weights: str | os.PathLike[str],
    reading: Reading = Reading(),
) -> int:
    """Rebuild a map by describing its images with another model.

    The complete new map replaces the old one in a single step, so a call that is killed leaves
    either the old map or the new one. The new map has the positions, folders, dates and kind of
    search of the old one, but neither its calibration nor its record of removed images. Restart a
    running service (`serve_map`), as it does not load the new map.

    Args:
        folder: the map's folder.
        model: the model that describes the images from now on.
        weights: file of the model's weights, which later queries load by default.
        reading: how images are read; an unreadable image is always an error.

    Returns:
        The number of images.

    Raises:
        InputError: an image file is missing, changed or unreadable; another process writes into the
            map; the file system cannot swap two folders; or `check_remakeable` refuses the map.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, Reading, index, init_crisalad
        >>> from crisalad_jax import save_weights
        >>> config, quiet = PRESETS["tiny"], Reading(quiet=True)
        >>> models = [Model(init_crisalad(jax.random.key(seed), config), config) for seed in (0, 1)]
        >>> for number, model in enumerate(models):
        ...     save_weights(folder / f"{number}.safetensors", model)
        >>> first = {"weights": folder / "0.safetensors", "reading": quiet}
        >>> _ = index(models[0], pictures, folder / "map", **first)
        >>> second = {"weights": folder / "1.safetensors", "reading": quiet}
        >>> remake_map(folder / "map", models[1], **second)
        4
    """
    folder = real_path(folder)
    existing = check_remakeable(folder)
    describer = describer_of(model)
    metadata = new_metadata(describer, weights, folder, dtype=existing.dtype)
    reading = dataclasses.replace(reading, on_bad_image="stop")
    with Map.open(folder, calibrated=False) as places:
        check_images(places)
        kind = places.stale_search or places.search_kind
    calibrated = any(folder.glob("calibration*"))
    new = folder.with_name(f".{folder.name}.remake")
    with open_for_appending(folder, existing) as places, in_use(new):
        shutil.rmtree(new, ignore_errors=True)  # left by a killed call
        with (
            open_for_appending(new, metadata) as target,
            progress_bar("images", len(places), "images", quiet=reading.quiet) as bar,
        ):

            def parts() -> Iterator[NewImages]:
                for part in places.parts():
                    paths = [pathlib.Path(part.root) / name for name in part.names]
                    rows = np.zeros((len(paths), metadata.descriptor_length), np.float32)
                    for batch in described(describer, paths, reading):
                        rows[batch.indices] = batch.descriptors
                        bar.advance(len(batch.indices))
                    yield part._replace(descriptors=rows)

            target.change("merge", added=parts())
            count = len(target)
            if kind != "exact":
                target.build_search(kind, quiet=reading.quiet)
        exchange(new, folder)  # the old map, now called `new`, is removed
    if calibrated:
        warn(f"{folder}: its threshold is no longer known; `crisalad calibrate` measures it")
    return count
