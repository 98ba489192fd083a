"""Stores of a map's descriptors: files or Milvus, behind one interface.

A store knows descriptors by number, from 0, and nothing about images. The map says how many of them
count. Descriptors beyond these, left by a killed addition, are never returned, and the next
addition overwrites them.
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
"""Types that descriptors may be stored as; bits are their signs (`retrieval.bits`)."""
_MILVUS = "milvus:"


Store = FileStore | MilvusStore
"""Descriptors by number. Each method raises InputError if the store is damaged or gone."""


def check_store(name: str, dtype: str) -> None:
    """Check the name of a store, and that it can hold descriptors of a type.

    Raises:
        InputError: neither "files" nor "milvus:URI", or a URI or type that Milvus does not take.
    """
    if name != "files":
        require(name.startswith(_MILVUS), f"store: found {name!r}, expected files or milvus:URI")
        check_address(name.removeprefix(_MILVUS))
    types = DTYPES if name == "files" else DTYPES[:1]
    require(dtype in types, f"dtype: found {dtype!r}, expected {' or '.join(types)} in {name}")


def store_name(name: str, folder: pathlib.Path) -> str:
    """Return the name that a map in `folder` records for a store from the command line.

    It contains the absolute path of a Milvus file, or the path relative to the map's folder if the
    file is inside.
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
        new: whether to create the store, in place of one that a kill left unfinished.

    Raises:
        InputError: it cannot be reached, is missing, or holds something else.
    """
    if metadata.store == "files":
        return FileStore(folder / "segments", *metadata.row)
    address = metadata.store.removeprefix(_MILVUS)
    if not check_address(address):
        address = str(real_path(folder) / address)
    return MilvusStore(address, metadata.collection, metadata.descriptor_length, new=new)
