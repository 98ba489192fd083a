"""Where a map's descriptors are: files that FAISS searches, or Milvus, behind one interface.

A store knows descriptors by their numbers, from 0, and nothing of images. The map says how many of
them count: what an addition that was killed left beyond them is never found, and the next addition
overwrites it.
"""

import pathlib
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32

from crisalad_jax.errors import InputError
from crisalad_jax.retrieval import Neighbours
from crisalad_jax.stores.files import FileStore
from crisalad_jax.stores.milvus import MilvusStore, check_address

DTYPES = ("float32", "float16")
"""What descriptors may be kept as."""
_MILVUS = "milvus:"


class Store(Protocol):
    """Descriptors by number. Each method raises InputError where the store is damaged or gone."""

    def add(self, first: int, descriptors: Float[np.ndarray, "n d"]) -> None:
        """Keep descriptors as numbers `first` and on, for good once this returns."""
        ...

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Check, without reading any, that all are there that were added as (first, how many)."""
        ...

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """The descriptors that were added together as numbers `first` and on."""
        ...

    def search(self, queries: Float32[np.ndarray, "q d"], k: int, count: int) -> Neighbours:
        """The k most similar of numbers below `count` by inner product, exactly; 1 <= k <= count.

        Of equal similarities the lower number stands first, and is the one that is found.
        """
        ...

    def close(self) -> None:
        """End connections, if there are any."""
        ...


def store_name(name: str, folder: pathlib.Path, dtype: str) -> str:
    """Check how a store is named on the command line; the name for a map in `folder` to keep.

    A file of Milvus is kept by its whole path, or relative to the map's folder if it is inside.

    Raises:
        InputError: neither "files" nor "milvus:URI", or such an URI or type that Milvus has not.
    """
    if dtype not in DTYPES:
        raise InputError(f"dtype: found {dtype!r}, expected one of {', '.join(DTYPES)}")
    if name == "files":
        return name
    if not name.startswith(_MILVUS):
        raise InputError(f"store: found {name!r}, expected files or milvus:URI")
    if dtype != "float32":
        raise InputError(f"dtype: found {dtype}, expected float32, which {name} keeps")
    address = name.removeprefix(_MILVUS)
    if not check_address(address):
        path, folder = pathlib.Path(address).resolve(), folder.resolve()
        address = str(path.relative_to(folder) if path.is_relative_to(folder) else path)
    return _MILVUS + address


def open_store(
    name: str, folder: pathlib.Path, *, collection: str, length: int, dtype: str, new: bool
) -> Store:
    """Open the store that `store_name` named for the map in `folder`.

    Args:
        name: the store.
        folder: the map's.
        collection: what Milvus keeps this map's descriptors under.
        length: numbers in a descriptor.
        dtype: of the files.
        new: whether the store is made, in place of what is left of one that a kill kept from that.

    Raises:
        InputError: it cannot be reached, is missing, or holds something else.
    """
    if name == "files":
        return FileStore(folder / "segments", length, dtype)
    address = name.removeprefix(_MILVUS)
    if not check_address(address):
        address = str(folder.resolve() / address)
    return MilvusStore(address, collection, length, new=new)
