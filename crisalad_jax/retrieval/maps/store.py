"""Where a map's descriptors are: files, or Milvus, behind one interface.

A store knows descriptors by their numbers, from 0, and nothing of images. The map says how many of
them count. Descriptors beyond, which a killed addition left, are never returned, and the next
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
"""Descriptors by number. Each method raises InputError where the store is damaged or gone."""


def check_store(name: str, dtype: str) -> None:
    """Check the name of a store, and that it holds descriptors of a type.

    Raises:
        InputError: neither "files" nor "milvus:URI", or such an URI or type that Milvus has not.
    """
    if name != "files":
        require(name.startswith(_MILVUS), f"store: found {name!r}, expected files or milvus:URI")
        check_address(name.removeprefix(_MILVUS))
    types = DTYPES if name == "files" else DTYPES[:1]
    require(dtype in types, f"dtype: found {dtype!r}, expected {' or '.join(types)} in {name}")


def store_name(name: str, folder: pathlib.Path) -> str:
    """Return the name that a map in `folder` records of a store on the command line.

    It holds a file of Milvus by its absolute path, or by one relative to the map's folder if it is
    inside.
    """
    address = name.removeprefix(_MILVUS)
    if name == "files" or check_address(address):
        return name
    path, folder = real_path(address), real_path(folder)
    return f"{_MILVUS}{path.relative_to(folder) if path.is_relative_to(folder) else path}"


def open_store(metadata: "MapMetadata", folder: pathlib.Path, *, new: bool) -> Store:
    """Open the store of the map in `folder`.

    Args:
        metadata: the map's.
        folder: the map's.
        new: whether the store is made anew, in place of one that a kill left unfinished.

    Raises:
        InputError: it cannot be reached, is missing, or holds something else.
    """
    if metadata.store == "files":
        return FileStore(folder / "segments", *metadata.row)
    address = metadata.store.removeprefix(_MILVUS)
    if not check_address(address):
        address = str(real_path(folder) / address)
    return MilvusStore(address, metadata.collection, metadata.descriptor_length, new=new)
