"""Describe a map's images anew by another model, and put that map in the old one's place."""

import os
import pathlib
import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import for_each, size_of
from crisalad_jax.data.sources import ImageSource, join_sources
from crisalad_jax.retrieval.describe import described
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.calibration import CALIBRATION
from crisalad_jax.retrieval.maps.images import NewImages
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import MapMetadata, existing_metadata, new_metadata
from crisalad_jax.utils.files import wrap_os_errors
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.temporaries import in_use, temporary_beside

if TYPE_CHECKING:
    from crisalad_jax.nn.model import Model


def source_of_map(places: Map) -> ImageSource:
    """Find the files of a map's images, where they were indexed.

    Args:
        places: the map.

    Returns:
        The images, and where they were taken.

    Raises:
        InputError: a file is gone or has another size; or folders of which one is at an address.
    """
    paths = [pathlib.Path(image.root) / image.name for image in places.images]
    for path, size, image in zip(paths, for_each(size_of, paths), places.images, strict=True):
        require(
            size == image.bytes,
            f"{places.folder}: found {path} {'gone' if size is None else f'of {size} bytes'}, "
            f"expected the image of {image.bytes} bytes that was indexed",
        )
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


def check_remakeable(metadata: MapMetadata, folder: str | os.PathLike[str]) -> None:
    """Check that `remake_map` can make a map anew.

    Raises:
        InputError: its descriptors are in Milvus, or components shorten them.
    """
    for name, found, expected in (
        ("store", metadata.store, "files"),
        ("components", metadata.pca[:12] or "none", "none: they were fitted to its descriptors"),
    ):
        require(
            found == expected.partition(":")[0],
            f"{folder}: found a map of {name} {found}, expected {expected} (`crisalad index` makes "
            "another map)",
        )


def remake_map(
    folder: str | os.PathLike[str],
    model: "Model",
    *,
    weights: str | os.PathLike[str],
    reading: Reading = Reading(),
) -> int:
    """Describe a map's images anew by another model, and put that map in the old one's place.

    The old map stays until the new one is whole, so a call that is killed leaves one of the two,
    and the same call goes on. Positions, folders, days and the kind of search stay. A calibration
    does not, nor what the map knows of images that were removed.

    Args:
        folder: the map's.
        model: what describes the images.
        weights: the file of the model, which queries load by default.
        reading: how images are read.

    Returns:
        The number of images.

    Raises:
        InputError: what `check_remakeable`, `source_of_map`, `extract` and `Map.open` raise.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Map, Model, Reading, index, init_crisalad
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
    folder = pathlib.Path(os.path.abspath(folder))
    old = folder.with_name(f".{folder.name}.before-remake")
    with wrap_os_errors(folder):
        if old.exists() and not folder.exists():  # killed between the two names
            old.rename(folder)
    existing = existing_metadata(folder)
    check_remakeable(existing, folder)
    describer = describer_of(model)
    metadata = new_metadata(describer, weights, folder, dtype=existing.dtype)
    with Map.open(folder, calibrated=False) as places:
        source_of_map(places)
        kind = places.stale_search or places.search_kind
    with open_for_appending(folder, existing) as places, in_use(temporary_beside(folder)) as new:
        with (
            open_for_appending(new, metadata) as target,
            progress_bar("images", len(places), "images", quiet=reading.quiet) as bar,
        ):

            def parts() -> Iterator[NewImages]:
                for part in places.parts():
                    paths = [pathlib.Path(part.root) / name for name in part.names]
                    valid = np.zeros(len(paths), bool)
                    rows = np.zeros((len(paths), metadata.descriptor_length), np.float32)
                    for batch in described(describer, paths, reading):
                        rows[batch.indices] = batch.descriptors
                        valid[batch.indices] = True
                        bar.advance(len(batch.indices))
                    yield part._replace(descriptors=rows).only(valid.tolist())

            target.change("merge", added=parts())
            count = len(target)
            if kind != "exact":
                target.build_search(kind, quiet=reading.quiet)
        with wrap_os_errors(folder):
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
            new.rename(folder)
    if (old / CALIBRATION).exists():
        warn(f"{folder}: its least similarity is no longer known; `crisalad calibrate` measures it")
    shutil.rmtree(old, ignore_errors=True)
    return count
