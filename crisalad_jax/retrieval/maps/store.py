"""Where a map's descriptors are: files, or Milvus, behind one interface.

A store knows descriptors by their numbers, from 0, and nothing of images. The map says how many of
them count. Descriptors beyond, which a killed addition left, are never returned, and the next
addition overwrites them.
"""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from crisalad_jax.retrieval.bits import Bits
from crisalad_jax.retrieval.chunks import Descriptors, Queries
from crisalad_jax.retrieval.maps.file_store import FileStore
from crisalad_jax.retrieval.maps.milvus_store import MilvusStore, check_address
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.shapes import Float, Int64

DTYPES = ("float32", "float16", "bits")
"""Types that descriptors may be stored as; bits are their signs (`retrieval.bits`)."""
_MILVUS = "milvus:"


class Store(Protocol):
    """Descriptors by number. Each method raises InputError where the store is damaged or gone."""

    def add(self, first: int, descriptors: Descriptors, record: Mapping[str, Any]) -> None:
        """Write descriptors as numbers `first` and on; they are durable once this returns.

        Args:
            first: number of the first.
            descriptors: in order.
            record: of their images, which conditions of a search are about.
        """

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Check, without reading them, that all additions, as (first, count), are there."""

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Read the descriptors that were added together as numbers `first` and on."""
        ...

    def rows(self, numbers: Int64[np.ndarray, " n"]) -> Descriptors:
        """Read the descriptors of these numbers, in any order."""
        ...

    def drop(self, first: int) -> None:
        """Forget what was added from number `first` on, which did not count."""

    def search(
        self, queries: Queries | Bits, k: int, count: int, removed: Removed = NONE
    ) -> Neighbours:
        """Find the k nearest of numbers below `count`, exactly.

        They are compared by inner product, packed bits by those that are equal.

        Of equal similarities the lower number stands first, also at the k-th place.

        Args:
            queries: as they are compared.
            k: neighbours of each, from 1 to as many as are left.
            count: number of descriptors, those that were removed included.
            removed: which are left out. The others are numbered in its way in the result.
        """
        ...

    def close(self) -> None:
        """Close connections, if there are any."""


def check_store(name: str, dtype: str) -> None:
    """Check the name of a store, and that it holds descriptors of a type.

    Raises:
        InputError: neither "files" nor "milvus:URI", or such an URI or type that Milvus has not.
    """
    if name != "files":
        if not name.startswith(_MILVUS):
            raise InputError(f"store: found {name!r}, expected files or milvus:URI")
        check_address(name.removeprefix(_MILVUS))
    types = DTYPES if name == "files" else DTYPES[:1]
    if dtype not in types:
        raise InputError(f"dtype: found {dtype!r}, expected {' or '.join(types)} in {name}")


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


def open_store(
    name: str, folder: pathlib.Path, *, collection: str, length: int, dtype: str, new: bool
) -> Store:
    """Open the store that `store_name` named for the map in `folder`.

    Args:
        name: the store.
        folder: the map's.
        collection: what Milvus keeps this map's descriptors under.
        length: numbers in a stored row.
        dtype: of the files, "uint8" of packed bits.
        new: whether the store is made anew, in place of one that a kill left unfinished.

    Raises:
        InputError: it cannot be reached, is missing, or holds something else.
    """
    if name == "files":
        return FileStore(folder / "segments", length, dtype)
    address = name.removeprefix(_MILVUS)
    if not check_address(address):
        address = str(real_path(folder) / address)
    return MilvusStore(address, collection, length, new=new)
