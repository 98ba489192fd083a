"""A map's description in map.json: the model, its settings, where descriptors are."""

import contextlib
import dataclasses
import datetime
import os
import pathlib
import uuid
from collections.abc import Iterator

from crisalad_jax.checkpoints.starter import recorded
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.nn.config import ModelConfig, check_unit_length
from crisalad_jax.retrieval.maps.head import (
    COMPONENTS,
    DESCRIPTION,
    SEGMENTS,
    MapHead,
    checked,
    has_images,
    read_value,
    write_record,
)
from crisalad_jax.retrieval.maps.store import store_name
from crisalad_jax.retrieval.model import Model, model_hash
from crisalad_jax.retrieval.pca import Pca, pca_hash
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.temporaries import LOCK, remove_temporaries


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapDescription(MapHead):
    """The contents of map.json."""

    config: ModelConfig
    """The model, at the image size and in the type in which images are described."""


def describe_map(
    params: Model,
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
        weights=recorded(weights),
        config=config,
        descriptor_length=config.descriptor_dim if pca is None else len(pca.components),
        store=store_name(store, folder, dtype),
        dtype=dtype,
        collection=f"crisalad_{uuid.uuid4().hex}",
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        pca="" if pca is None else pca_hash(pca),
    )


def write_description(folder: pathlib.Path, description: MapDescription) -> None:
    """Write map.json, whole or not at all.

    Raises:
        InputError: the disk is full, or the folder cannot be written to.
    """
    write_record(folder / DESCRIPTION, to_plain(description), indent=2)


def read_description(folder: str | os.PathLike[str]) -> MapDescription | None:
    """Read the description of the map in `folder`; None where a new map can be made.

    Raises:
        InputError: what `read_head` raises, or of the model's configuration.
    """
    folder = pathlib.Path(folder)
    value = read_value(folder)
    if value is None:
        return None
    return checked(from_plain(MapDescription, value, source=str(folder / DESCRIPTION)), folder)


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
    if {path.name for path in folder.iterdir()} <= {DESCRIPTION, COMPONENTS, LOCK}:
        for name in (DESCRIPTION, COMPONENTS, LOCK):
            (folder / name).unlink(missing_ok=True)
        folder.rmdir()
