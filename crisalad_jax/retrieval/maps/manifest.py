"""A map's description in map.json: the model, its settings, where descriptors are."""

import contextlib
import dataclasses
import datetime
import os
import pathlib
import uuid
from collections.abc import Iterator, Mapping
from typing import Any

from crisalad_jax.checkpoints.weights import model_hash
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.nn.config import ModelConfig, check_unit_length
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.retrieval.maps.store import store_name
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash
from crisalad_jax.utils.checksums import sealed_json
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import durable_path, read_json, real_path
from crisalad_jax.utils.notes import tell
from crisalad_jax.utils.temporaries import LOCK, is_temporary, remove_temporaries

FORMAT = 4
"""Newest version of the format that this package reads, and that of a map with components. Others
are written as format 3, which earlier versions read. Maps of format 2
have records without checksums; those of format 1 (package version 0.1) also have a hash of all
fields that a model had then."""
DESCRIPTION, SEGMENTS, LOCKS = "map.json", "segments", (LOCK, ".lock")
"""Names of the description, of the folder of additions, and of the locks for appending, today's
first."""
COMPONENTS, SHARES = "pca.safetensors", "shares"
"""Names of the components that shorten descriptors, and of the folder of shares to be joined."""


@dataclasses.dataclass(frozen=True)
class MapDescription:
    """The contents of map.json."""

    model: str
    """The `model_hash` of the weights that describe its images, and its queries."""
    weights: str
    """Where those weights were."""
    config: ModelConfig
    """The model, at the image size and in the type in which images are described."""
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
    format: int = 3


def describe_map(
    params: Crisalad,
    config: ModelConfig,
    weights: pathlib.Path,
    folder: pathlib.Path,
    *,
    store: str = "files",
    dtype: str = "float32",
    pca: Pca | None = None,
) -> MapDescription:
    """Make the description of a new map in `folder`, whose images this model will describe.

    Raises:
        InputError: the model's descriptors are no unit vectors, or its components make none or are
            of another length; what `store_name` raises.
    """
    check_unit_length(config, str(weights))
    if pca is not None:
        pca.check(config.descriptor_dim, str(weights))
        if not pca.config.renormalise:
            raise InputError(
                "pca: found components that leave lengths as they are, expected some that make "
                "unit vectors, which maps compare by cosine"
            )
    return MapDescription(
        model=model_hash(params, config),
        weights=str(real_path(weights)),
        config=config,
        descriptor_length=config.descriptor_dim if pca is None else len(pca.components),
        store=store_name(store, folder, dtype),
        dtype=dtype,
        collection=f"crisalad_{uuid.uuid4().hex}",
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        pca="" if pca is None else pca_hash(pca),
        format=3 if pca is None else FORMAT,
    )


def write_description(folder: pathlib.Path, description: MapDescription) -> None:
    """Write map.json, whole or not at all; a field that is not used is left out for old readers.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    value = to_plain(description)
    if not description.pca:
        del value["pca"]
    write_record(folder / DESCRIPTION, value, indent=2)


def read_components(folder: pathlib.Path, description: MapDescription) -> Pca | None:
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


def read_description(folder: str | os.PathLike[str]) -> MapDescription | None:
    """Read the description of the map in `folder`; None where a new map can be made.

    Raises:
        InputError: the folder is a file or holds other things than a map, or the map is damaged or
            of a newer version of this package.
    """
    folder = pathlib.Path(folder)
    path = folder / DESCRIPTION
    if not path.exists():
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: found a file, expected a map's folder")
        # A process killed before it has made the map leaves its lock and temporary files behind.
        others = sorted(_others(folder, *LOCKS, SEGMENTS, COMPONENTS, SHARES))
        if _others(folder / SEGMENTS):
            others.append(SEGMENTS)
        if others:
            raise InputError(
                f"{folder}: found {others[0]} and no {DESCRIPTION}, expected a map or an empty "
                "folder"
            )
        return None
    # Who edits the description removes its checksum. A changed key would be an unknown field.
    value = read_json(path, "a map", quiet=True)
    version = _version(value)
    if version > FORMAT:
        raise InputError(
            f"{path}: found a map of format {version}, expected at most {FORMAT}: it is of a newer "
            "crisalad-jax"
        )
    description = from_plain(MapDescription, value, source=str(path))
    try:
        store_name(description.store, folder, description.dtype)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return description


def _version(value: Any) -> int:
    """Return the format that a description says; 0 where it says none."""
    version = value.get("format") if isinstance(value, dict) else None
    return version if type(version) is int else 0


def is_checked(version: int) -> bool:
    """Return whether the records of a map of this format hold checksums."""
    return version >= 3


def _others(folder: pathlib.Path, *names: str) -> list[str]:
    """Return the names in `folder` that are neither temporary nor in `names`."""
    if not folder.is_dir():
        return []
    return [p.name for p in folder.iterdir() if p.name not in names and not is_temporary(p)]


def has_images(folder: pathlib.Path) -> bool:
    """Return whether a folder holds a map with images; a map without any counts as none."""
    return any((folder / SEGMENTS).glob("[0-9]*.json"))


@contextlib.contextmanager
def undone_without_images(folder: pathlib.Path) -> Iterator[None]:
    """Remove the map if the block raises before it has images: nothing is lost."""
    try:
        yield
    except BaseException:
        if not has_images(folder):
            with contextlib.suppress(OSError):
                _remove(folder)
        raise


def _remove(folder: pathlib.Path) -> None:
    """Remove a map without images; its description stays where other files are left."""
    segments = folder / SEGMENTS
    remove_temporaries(segments)
    for path in segments.glob("[0-9]*.npy"):
        path.unlink()
    segments.rmdir()
    if {path.name for path in folder.iterdir()} <= {DESCRIPTION, COMPONENTS, *LOCKS}:
        for name in (DESCRIPTION, COMPONENTS, *LOCKS):
            (folder / name).unlink(missing_ok=True)
        folder.rmdir()


def check_model(
    description: MapDescription, folder: str | os.PathLike[str], digest: str, weights: object
) -> None:
    """Check that a map was made by the model with the hash `digest`.

    A map of version 0.1 cannot be checked; a note tells so.

    Raises:
        InputError: the hashes differ; the message has both.
    """
    if description.format < 2:
        tell(
            f"{folder}: found a map of crisalad-jax 0.1, which cannot tell whether {weights} made "
            "it; `crisalad index` into a new folder makes one that can"
        )
    elif digest != description.model:
        raise InputError(
            f"{folder}: found a map made by model {description.model[:12]} "
            f"({description.weights}), but {weights} is model {digest[:12]}"
        )


def write_record(path: pathlib.Path, value: Mapping[str, Any], indent: int | None = None) -> None:
    """Write an object as JSON with its checksum, whole or not at all, and flush it to the disk.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    data = sealed_json(value, indent)
    with durable_path(path) as temporary:
        temporary.write_bytes(data)
