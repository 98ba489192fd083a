"""Approximate search with FAISS, for databases that are too large for exact search.

A graph (HNSW: Malkov and Yashunin, 2018) stores the descriptors as they are and finds nearly all
neighbours. IVF-RaBitQ (Gao and Long, 2024) stores one bit per dimension in lists of similar
vectors, and compares only the lists nearest to a query; rank its results by exact similarity.
`recall_against_exact` measures the share found. Reduce thousands of dimensions first (`pca`).
"""

import hashlib
import math
import os
import pathlib
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple, get_args

import faiss as _faiss
import numpy as np

from crisalad_jax.config.checks import check_count, choose
from crisalad_jax.retrieval.chunks import WIDE, Descriptors, as_rows, as_unit_rows, sample
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.checksums import ChangedFileError, sha256_of, tell_unchecked
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_source
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Float, Int

faiss: Any = _faiss  # its classes are created at import
Kind = Literal["hnsw", "ivf-rabitq"]
KINDS: dict[str, None] = dict.fromkeys(get_args(Kind))
"""A graph over the unchanged descriptors ("hnsw"), nearly exact and larger than they are; or lists
of their signs ("ivf-rabitq"), 80 bytes for a descriptor of 512 dimensions, to be ranked again."""
_LINKS = 32
"""Number of links of a vector in each layer of the graph; twice as many in the lowest. FAISS
recommends 4 to 64 and the paper 5 to 48, with more for longer vectors."""
_BUILD_EFFORT = 128
"""Number of candidates while a vector is inserted; the paper's examples use 100."""
_LEAST_EFFORT = 128
"""Minimum number of candidates while a graph is searched."""
_LEAST_LISTS = 256
"""Minimum number of lists that a query searches."""
_PER_LIST = 39
"""Number of vectors to train the centroid of a list from; with fewer, FAISS warns of a poor
clustering."""
_TRAINING_BYTES = 2**30
"""Maximum size in bytes of the descriptors that an index is trained on."""
_CHUNK_BYTES = 2**26


class Index(NamedTuple):
    """An index for approximate search, made by `build`."""

    kind: Kind
    faiss_index: Any
    """The FAISS index."""

    @property
    def size(self) -> int:
        """Number of descriptors in the index."""
        return self.faiss_index.ntotal

    def search(
        self,
        queries: Float[np.ndarray, "q d"],
        k: int,
        effort: int | None = None,
        *,
        without: Int[np.ndarray, " rows"] | None = None,
    ) -> Neighbours:
        """Find the descriptors most similar to each query, approximately.

        If fewer than k are found, the last indices are -1 and their similarities -inf. The
        similarities of IVF-RaBitQ are estimates.

        Args:
            queries: unit descriptors.
            k: number of neighbours per query; all descriptors if there are fewer.
            effort: how much to search; more finds more and takes longer. For HNSW, the number of
                candidates (by default the larger of 128 and 2 k); for IVF-RaBitQ, the number of
                lists (by default the larger of 256 and a sixteenth of all lists).
            without: indices to exclude; None excludes none.

        Raises:
            InputError: the queries have another length, or are not finite or not of unit length; or
                k or effort is below 1.
        """
        check_count("k", k)
        check_count("effort", 1 if effort is None else effort)
        queries = as_unit_rows(queries, "queries", self.faiss_index.d)
        k = min(k, self.size)
        if self.kind == "hnsw":
            chosen = faiss.SearchParametersHNSW(efSearch=effort or max(_LEAST_EFFORT, 2 * k))
        else:
            lists = _lists(self.faiss_index).nlist
            looked = min(effort or max(_LEAST_LISTS, lists // 16), lists)
            chosen = faiss.SearchParametersIVF(nprobe=looked)
        if without is not None and len(without):
            left = np.ones(self.size, bool)
            left[without] = False
            packed = np.packbits(left, bitorder="little")  # must live as long as the search
            chosen.sel = faiss.IDSelectorBitmap(len(packed), faiss.swig_ptr(packed))
        if self.kind != "hnsw":
            chosen = faiss.SearchParametersPreTransform(index_params=chosen)
        similarities, indices = self.faiss_index.search(queries, k, params=chosen)
        return Neighbours(indices, np.where(indices < 0, -np.inf, similarities).astype(np.float32))

    def add(
        self, parts: Iterable[Float[np.ndarray, "rows d"]], count: int, *, quiet: bool = True
    ) -> None:
        """Append descriptors, some rows at a time.

        Args:
            parts: arrays of unit descriptors.
            count: total number of rows in all parts, for the progress bar.
            quiet: whether to hide the progress bar.

        Raises:
            InputError: a row is not finite or not of unit length.
        """
        with progress_bar(self.kind, count, "rows", quiet=quiet) as bar:
            for part in parts:
                self.faiss_index.add(as_unit_rows(part, "database"))
                bar.advance(len(part))

    def has_room_for(self, count: int) -> bool:
        """Return whether a new index of `count` descriptors has at most twice this one's lists."""
        index = self.faiss_index
        return self.kind == "hnsw" or 2 * _lists(index).nlist >= _list_count(count, index.d)


Parts = Callable[[], Iterable[Float[np.ndarray, "rows d"]]]
"""A function that yields all descriptors, some rows at a time, whenever it is called."""


def build(kind: Kind, database: Descriptors | Parts, *, seed: int = 0, quiet: bool = True) -> Index:
    """Build an index of unit descriptors, reading some at a time.

    IVF-RaBitQ rotates vectors by random signs and Hadamard matrices, so that no dimension counts
    more than others. For n descriptors it has 4 sqrt(n) lists (the FAISS guidelines say 4 to 16
    sqrt(n)), or fewer, so that each is trained from 39 vectors. The training sample is random, at
    most 1 GiB of descriptors. A descriptor takes one bit per dimension, rounded up to the next
    power of two, plus 8 bytes for two factors and 8 for its index.

    HNSW has 32 links per vector. Its graph, and therefore the few neighbours that it misses, depend
    on the order in which threads insert vectors. With one thread (OMP_NUM_THREADS=1) the graph
    depends only on the seed, as IVF-RaBitQ always does.

    Args:
        kind: one of `KINDS`.
        database: unit descriptors (n, d), which may be a memory map; or a function that yields them
            in parts, which is called for each of up to three passes.
        seed: seed of the clustering and its sample, or of the graph's layers.
        quiet: whether to hide the progress bar.

    Raises:
        InputError: the kind is unknown; the array is empty or not a matrix; or a row is not finite
            or not of unit length.
    """
    choose("kind", kind, KINDS)
    parts = database if callable(database) else _parts_of(as_rows(database, "database"))
    shapes = [part.shape for part in parts()]
    count, length = sum(rows for rows, _ in shapes), shapes[0][1]
    made = _graph(length, seed) if kind == "hnsw" else _trained_lists(count, length, parts, seed)
    index = Index(kind, made)
    index.add(parts(), count, quiet=quiet)
    return index


def _parts_of(database: Descriptors) -> Parts:
    size = max(1, _CHUNK_BYTES // (4 * database.shape[1]))
    return lambda: (database[start : start + size] for start in range(0, len(database), size))


def _graph(length: int, seed: int) -> Any:
    index = faiss.IndexHNSWFlat(length, _LINKS, faiss.METRIC_INNER_PRODUCT)
    index.hnsw.efConstruction = _BUILD_EFFORT
    index.hnsw.rng = faiss.RandomGenerator(seed)
    return index


def _list_count(count: int, length: int) -> int:
    most = min(count, _TRAINING_BYTES // (4 * length)) // _PER_LIST
    return max(1, min(most, round(4 * math.sqrt(count))))


def _lists(index: Any) -> Any:
    """Return the lists behind the rotation."""
    return faiss.downcast_index(index.index)


def _trained_lists(count: int, length: int, database: Parts, seed: int) -> Any:
    number = _list_count(count, length)
    rotation = faiss.HadamardRotation(length, seed)
    bits = rotation.d_out
    lists = faiss.IndexIVFRaBitQ(faiss.IndexFlatIP(bits), bits, number, faiss.METRIC_INNER_PRODUCT)
    # The centroids are unit vectors, since they are compared by inner products.
    lists.cp.spherical = True
    lists.cp.seed = seed
    lists.cp.min_points_per_centroid = 1  # or it warns about a single list of a few vectors
    places = sample(count, min(count, _PER_LIST * number), seed)
    start, chosen = 0, []
    for part in database():
        first, end = np.searchsorted(places, [start, start + len(part)])
        chosen.append(np.asarray(part[places[first:end] - start], WIDE))
        start += len(part)
    index = faiss.IndexPreTransform(rotation, lists)
    index.train(np.concatenate(chosen))
    return index


def save_index(path: str | os.PathLike[str], index: Index) -> None:
    """Write an index in the FAISS format, followed by its checksum, atomically.

    FAISS itself can read the file too; it stops before the checksum.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        try:
            faiss.write_index(index.faiss_index, str(temporary))
        except RuntimeError as error:
            raise InputError(f"{path}: cannot be written: {one_line(error)}") from error
        line = _APPENDED + sha256_of(temporary).encode() + b"\n"
        with temporary.open("ab") as file:
            file.write(line)


def load_index(path: str | os.PathLike[str], *, verify: bool = True) -> Index:
    """Read an index that `save_index` wrote; warn if its checksum is missing.

    Args:
        path: the file.
        verify: whether to check the file against its checksum.

    Raises:
        InputError: the file does not exist, was changed, or does not hold an index of `KINDS`.
    """
    path = pathlib.Path(path)
    check_source(path, "a faiss index")
    if verify and path.stat().st_size:  # an empty file cannot be mapped
        _check_appended(path)
    try:
        index = faiss.read_index(str(path))
    except (RuntimeError, MemoryError) as error:
        raise InputError(f"{path}: not a whole faiss index: {one_line(error)}") from error
    inner = _lists(index) if type(index) is faiss.IndexPreTransform else index
    kinds: dict[tuple[type, type], Kind] = {
        (faiss.IndexHNSWFlat, faiss.IndexHNSWFlat): "hnsw",
        (faiss.IndexPreTransform, faiss.IndexIVFRaBitQ): "ivf-rabitq",
    }
    kind = kinds.get((type(index), type(inner)))
    if kind is None or index.metric_type != faiss.METRIC_INNER_PRODUCT:
        raise InputError(
            f"{path}: found a {type(inner).__name__}, expected an index by inner product, from "
            "`build`"
        )
    return Index(kind, index)


def recall_against_exact(found: Int[np.ndarray, "q k"], exact: Int[np.ndarray, "q k"]) -> float:
    """Measure the share, 0 to 1, of the exact neighbours of all queries that a search found.

    Args:
        found: indices from an approximate search.
        exact: indices from `retrieval.search`.

    Raises:
        ValueError: the arrays differ in length.
    """
    pairs = zip(found, exact, strict=True)
    return sum(np.intersect1d(a, b).size for a, b in pairs) / exact.size


_APPENDED = b"\nsha256 "
"""Starts a line with the digest of the bytes before it; readers of the format stop before it."""
_APPENDED_SIZE = len(_APPENDED) + 64 + 1


def _check_appended(path: pathlib.Path) -> None:
    """Check the digest that `save_index` appended; warn if there is none.

    Raises:
        InputError: the bytes of the file do not match the digest.
    """
    data = np.memmap(path, np.uint8, "r")
    line = data[-_APPENDED_SIZE:].tobytes()
    if not line.startswith(_APPENDED):
        tell_unchecked(path)
        return
    digest = hashlib.sha256(data[:-_APPENDED_SIZE].data).hexdigest()
    if line != _APPENDED + digest.encode() + b"\n":
        raise ChangedFileError(path)
