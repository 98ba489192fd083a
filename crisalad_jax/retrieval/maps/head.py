"""The head of a map: all of map.json but the model's configuration, and the names of its files.

It needs no JAX, so that what describes images by another runtime starts without it.
"""

import dataclasses
import os
import pathlib
from collections.abc import Mapping
from typing import Any, TypeVar

from crisalad_jax.checkpoints.runtime import read_header
from crisalad_jax.checkpoints.starter import FILES, resolved
from crisalad_jax.config.io import from_plain
from crisalad_jax.retrieval.maps.store import store_name
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash
from crisalad_jax.utils.checksums import checksummed_json
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, read_json
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.temporaries import LOCK, is_temporary

FORMAT = 4
"""Version of the format."""
DESCRIPTION, SEGMENTS = "map.json", "segments"
"""Names of the description, and of the folder of additions."""
COMPONENTS, SHARES = "pca.safetensors", "shares"
"""Names of the components that shorten descriptors, and of the folder of shares to be joined."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapHead:
    """The contents of map.json without the model's configuration, which needs JAX."""

    model: str
    """The `model_hash` of the weights that describe its images, and its queries."""
    weights: str
    """Where those weights were: a path, or a name in `starter.FILES`."""
    descriptor_length: int
    store: str = "files"
    """Where descriptors are stored; see `store.store_name`."""
    dtype: str = "float32"
    """Type of the stored descriptors."""
    grouping: str = "single"
    """Every image is described alone, so that no descriptor depends on neighbouring images."""
    collection: str = ""
    """Name of Milvus' collection of the descriptors."""
    created: str = ""
    pca: str = ""
    """The `pca_hash` of the components that shorten its descriptors, and those of queries; "" is
    none."""
    format: int = FORMAT


_Head = TypeVar("_Head", bound=MapHead)


def read_value(folder: str | os.PathLike[str], *, or_new: bool = True) -> dict[str, Any] | None:
    """Read map.json as JSON values; None where a new map can be made.

    Args:
        folder: the map's.
        or_new: whether an empty folder would do, for the message.

    Raises:
        InputError: the folder is a file or holds other things than a map, or the map is damaged or
            of another format.
    """
    folder = pathlib.Path(folder)
    path = folder / DESCRIPTION
    if not path.exists():
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: found a file, expected a map's folder")
        # A process killed before it has made the map leaves its lock and temporary files behind.
        others = sorted(other_files(folder, LOCK, SEGMENTS, COMPONENTS, SHARES))
        if other_files(folder / SEGMENTS):
            others.append(SEGMENTS)
        if others:
            expected = "a map or an empty folder" if or_new else "a map"
            raise InputError(
                f"{folder}: found {others[0]} and no {DESCRIPTION}, expected {expected}"
            )
        return None
    # Who edits the description removes its checksum. A changed key would be an unknown field.
    value = read_json(path, "a map", sealed=False)
    version = value.get("format") if isinstance(value, dict) else None
    if version != FORMAT:
        raise InputError(
            f"{path}: found a map of format {version}, expected {FORMAT}: `crisalad index` into a "
            "new folder makes one"
        )
    return value


def read_head(folder: str | os.PathLike[str]) -> MapHead | None:
    """Read all of a map's description but the model's configuration; None where there is no map.

    Raises:
        InputError: the folder is a file or holds other things than a map, or the map is damaged or
            of another format.
    """
    folder = pathlib.Path(folder)
    value = read_value(folder, or_new=False)
    if value is None:
        return None
    value.pop("config", None)
    return checked(from_plain(MapHead, value, source=str(folder / DESCRIPTION)), folder)


def checked(head: _Head, folder: pathlib.Path) -> _Head:
    """Return a description whose store this package knows.

    Raises:
        InputError: it does not.
    """
    try:
        store_name(head.store, folder, head.dtype)
    except InputError as error:
        raise InputError(f"{folder / DESCRIPTION}: {error}") from error
    return head


def read_components(folder: pathlib.Path, description: MapHead) -> Pca | None:
    """Read the components of a map; None where it has none.

    Raises:
        InputError: the file is gone, damaged, or of other components.
    """
    if not description.pca:
        return None
    pca = load_pca(folder / COMPONENTS)
    if pca_hash(pca) != description.pca:
        raise InputError(
            f"{folder / COMPONENTS}: found other components, expected those that {DESCRIPTION} says"
        )
    return pca


def other_files(folder: pathlib.Path, *names: str) -> list[str]:
    """Return the names in `folder` that are neither temporary nor in `names`."""
    if not folder.is_dir():
        return []
    return [p.name for p in folder.iterdir() if p.name not in names and not is_temporary(p)]


def has_images(folder: pathlib.Path) -> bool:
    """Return whether a folder holds a map with images; a map without any counts as none."""
    return any((folder / SEGMENTS).glob("[0-9]*.json"))


def check_model(
    description: MapHead,
    folder: str | os.PathLike[str],
    digest: str,
    weights: object,
    *,
    quantised_from: str | None = None,
) -> None:
    """Check that a map was made by the model with the hash `digest`.

    A note tells where the model is an int8 program of `quantised_from`, which made the map.

    Raises:
        InputError: the hashes differ; the message has both.
    """
    if quantised_from == description.model:
        warn(
            f"{weights}: an int8 program of the model that made {folder}; similarities are rougher"
        )
    elif digest != description.model:
        file = FILES.get(description.weights)
        is_todays = file is None or read_header(file)["model_sha256"] == description.model
        version = "" if is_todays else " of another version of this package"
        raise InputError(
            f"{folder}: found a map made by model {description.model[:12]} "
            f"({description.weights}{version}), but {weights} is model {digest[:12]}: expected the "
            "same (--weights), or a new map (`crisalad index` into a new folder)"
        )


def weights_of(description: MapHead, folder: str | os.PathLike[str]) -> pathlib.Path:
    """Return the file of the weights that made a map.

    Raises:
        InputError: it is no longer where it was.
    """
    file = resolved(description.weights)
    if not file.exists():
        raise InputError(
            f"{folder}: found no {file}, which made this map, expected it there or as --weights"
        )
    return file


def write_record(path: pathlib.Path, value: Mapping[str, Any], indent: int | None = None) -> None:
    """Write an object as JSON with its checksum, whole or not at all, and flush it to the disk.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    data = checksummed_json(value, indent)
    with atomic_path(path, durable=True) as temporary:
        temporary.write_bytes(data)
