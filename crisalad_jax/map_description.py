"""What a map says of itself in map.json: the model, its settings, where descriptors are."""

import contextlib
import dataclasses
import datetime
import json
import os
import pathlib
import uuid
from collections.abc import Iterator
from typing import Any

from crisalad_jax.checkpoint import model_hash
from crisalad_jax.config import ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.files import durable_path
from crisalad_jax.model import Crisalad
from crisalad_jax.serial import from_plain
from crisalad_jax.stores import store_name
from crisalad_jax.stores.files import remove_leftovers

FORMAT = 1
"""Version of the format that this package writes, and the newest that it reads."""
DESCRIPTION, SEGMENTS, LOCK = "map.json", "segments", ".lock"
"""The file, the folder of what was appended, and what who appends holds."""


@dataclasses.dataclass(frozen=True)
class MapDescription:
    """What map.json says."""

    model: str
    """The `model_hash` of the weights that describe its images, and its queries."""
    weights: str
    """Where those weights were."""
    config: ModelConfig
    """The model, at the image size and in the type in which images are described."""
    descriptor_length: int
    store: str = "files"
    """Where descriptors are; see `stores.store_name`."""
    dtype: str = "float32"
    """What descriptors are kept as."""
    grouping: str = "single"
    """Every image is described alone: what a map says of a place depends on no neighbour."""
    collection: str = ""
    """What Milvus keeps the descriptors under."""
    created: str = ""
    format: int = FORMAT


def describe_map(
    params: Crisalad,
    config: ModelConfig,
    weights: pathlib.Path,
    folder: pathlib.Path,
    *,
    store: str = "files",
    dtype: str = "float32",
) -> MapDescription:
    """The description of a new map in `folder`, of images that this model is to describe.

    Raises:
        InputError: what `store_name` raises.
    """
    return MapDescription(
        model=model_hash(params, config),
        weights=str(weights.resolve()),
        config=config,
        descriptor_length=config.descriptor_dim,
        store=store_name(store, folder, dtype),
        dtype=dtype,
        collection=f"crisalad_{uuid.uuid4().hex}",
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def read_description(folder: str | os.PathLike[str]) -> MapDescription | None:
    """What the map in `folder` says of itself; None where a new one can be made.

    Raises:
        InputError: the folder is a file or holds other things than a map, or the map is damaged or
            of a newer version of this package.
    """
    folder = pathlib.Path(folder)
    path = folder / DESCRIPTION
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: found a file, expected a map's folder") from None
        # Hidden, or empty, is what a process leaves that was killed before it had made the map.
        others = sorted(p.name for p in folder.glob("[!.]*"))
        if others != [SEGMENTS] * len(others) or any((folder / SEGMENTS).glob("[!.]*")):
            raise InputError(
                f"{folder}: found {others[0]} and no {DESCRIPTION}, expected a map or an empty "
                "folder"
            ) from None
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read this map: {error}") from error
    version = value.get("format") if isinstance(value, dict) else None
    if type(version) is int and version > FORMAT:
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


def has_images(folder: pathlib.Path) -> bool:
    """Whether the map in this folder has any image; one that has none counts as no map."""
    return any((folder / SEGMENTS).glob("[0-9]*.json"))


@contextlib.contextmanager
def undone_without_images(folder: pathlib.Path) -> Iterator[None]:
    """Remove the map if an exception ends this before it has images: nothing is lost with it."""
    try:
        yield
    except BaseException:
        if not has_images(folder):
            with contextlib.suppress(OSError):
                _remove(folder)
        raise


def _remove(folder: pathlib.Path) -> None:
    """Remove a map without images. Where there is more, its description stays to say of what."""
    segments = folder / SEGMENTS
    remove_leftovers(segments)
    for path in segments.glob("[0-9]*.npy"):
        path.unlink()
    segments.rmdir()
    if {path.name for path in folder.iterdir()} <= {DESCRIPTION, LOCK}:
        (folder / DESCRIPTION).unlink(missing_ok=True)
        (folder / LOCK).unlink()
        folder.rmdir()


def check_model(
    description: MapDescription, folder: str | os.PathLike[str], found: str, weights: object
) -> None:
    """Check that a map is of the model whose hash is `found`.

    Raises:
        InputError: it is not; the message has both hashes.
    """
    if found != description.model:
        raise InputError(
            f"{folder}: found a map made by model {description.model[:12]} "
            f"({description.weights}), but {weights} is model {found[:12]}"
        )


def write_record(path: pathlib.Path, value: Any, indent: int | None = None) -> None:
    """Write JSON, whole or not at all, and to the disk.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    try:
        with durable_path(path) as temporary:
            temporary.write_text(json.dumps(value, indent=indent) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
