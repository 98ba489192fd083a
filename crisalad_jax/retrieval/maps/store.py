"""Stores of a map's descriptors: files or Milvus, behind one interface.

A store holds descriptors by index, from 0, and knows nothing about images. The map records how many
descriptors are valid. Descriptors beyond that number, left by an addition that was killed, are
never returned, and the next addition overwrites them.
"""

import pathlib
from typing import TYPE_CHECKING

from crisalad_jax.config.checks import require
from crisalad_jax.retrieval.maps.file_store import FileStore
from crisalad_jax.retrieval.maps.milvus_store import MilvusStore, check_address
from crisalad_jax.utils.files import real_path

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.metadata import MapMetadata

DTYPES = ("float32", "float16", "bits")
"""Types in which descriptors may be stored; bits are the signs of all dimensions (`pack_bits`)."""
_MILVUS = "milvus:"


Store = FileStore | MilvusStore
"""A map's stored descriptors. Methods raise InputError if the store is damaged or missing."""


def check_store(name: str, dtype: str) -> None:
    """Check the name of a store, and that the store can hold descriptors of type `dtype`.

    Raises:
        InputError: the name is neither "files" nor "milvus:URI"; the URI is neither a .db file nor
            an http address; or the store cannot hold the type (Milvus holds only float32).
    """
    if name != "files":
        require(name.startswith(_MILVUS), f"store: found {name!r}, expected files or milvus:URI")
        check_address(name.removeprefix(_MILVUS))
    types = DTYPES if name == "files" else DTYPES[:1]
    require(dtype in types, f"dtype: found {dtype!r}, expected {' or '.join(types)} in {name}")


def store_name(name: str, folder: pathlib.Path) -> str:
    """Convert the name of a store to the one that the map in `folder` records.

    The path of a Milvus file becomes absolute, or relative to `folder` if the file is inside it.
    """
    address = name.removeprefix(_MILVUS)
    if name == "files" or check_address(address):
        return name
    path, folder = real_path(address), real_path(folder)
    return f"{_MILVUS}{path.relative_to(folder) if path.is_relative_to(folder) else path}"


def open_store(metadata: "MapMetadata", folder: pathlib.Path, *, new: bool) -> Store:
    """Open the store of the map in `folder`.

    Args:
        metadata: the map's metadata.
        folder: the map's folder.
        new: whether to create the store, replacing one that a killed process left unfinished.

    Raises:
        InputError: the store cannot be reached, is missing, or does not belong to this map.
    """
    if metadata.store == "files":
        return FileStore(folder / "segments", *metadata.row)
    address = metadata.store.removeprefix(_MILVUS)
    if not check_address(address):
        address = str(real_path(folder) / address)
    return MilvusStore(address, metadata.collection, metadata.descriptor_length, new=new)
