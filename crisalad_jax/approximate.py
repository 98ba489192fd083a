"""Approximate search by FAISS, for databases whose exact search takes too long.

A graph (HNSW: Malkov and Yashunin, 2018) keeps the descriptors as they are and finds nearly all
neighbours. IVF-PQ (Jegou, Douze and Schmid, 2011) keeps 128 bytes of each at most, and looks at a
part of them. What either misses is measured against the exact search: `recall_against_exact`.
Descriptors of thousands of numbers are reduced first (`pca`).
"""

import itertools
import math
import os
import pathlib
from typing import Any, Literal, NamedTuple

import faiss as _faiss
import numpy as np
from jaxtyping import Float, Int

from crisalad_jax.config import choose
from crisalad_jax.errors import InputError
from crisalad_jax.files import atomic_path, check_source
from crisalad_jax.progress import progress_bar
from crisalad_jax.retrieval import Neighbours
from crisalad_jax.rows import WIDE, as_rows, blocks, pieces, sample

faiss: Any = _faiss  # its classes are made when it is loaded
Kind = Literal["hnsw", "ivf-pq"]
KINDS = {
    "hnsw": "a graph over the descriptors as they are: nearly exact, and as large as they are",
    "ivf-pq": "lists of codes of at most 128 bytes each: small, and less exact",
}
_LINKS = 32
"""Of a vector in each layer but the lowest, which has twice as many: within the 4 to 64 that faiss
recommends, and within the 5 to 48 of the paper, nearer to their ends for long vectors."""
_BUILD_EFFORT = 128
"""Candidates that are kept while a vector is put in; the paper's examples keep 100."""
_LEAST_EFFORT = 128
"""Candidates that are kept while a graph is searched."""
_CODE_BYTES = 128
_CENTROIDS = 256
"""Of a part of a vector: one byte."""
_PER_CENTROID = 39
"""Vectors to train a centroid from: with fewer faiss warns of a poor clustering."""
LEAST_ROWS = _PER_CENTROID * _CENTROIDS
"""Descriptors that an IVF-PQ index is trained from, at least."""
_TRAINING_BYTES = 2**30
"""Of descriptors that an index is trained from, at most."""
_CHUNK_BYTES = 2**26


class Index(NamedTuple):
    """What `build` makes."""

    kind: Kind
    faiss_index: Any
    """The index of faiss."""

    @property
    def size(self) -> int:
        """Descriptors in it."""
        return self.faiss_index.ntotal

    def search(
        self, queries: Float[np.ndarray, "q d"], k: int, effort: int | None = None
    ) -> Neighbours:
        """The most similar descriptors, as far as they are found.

        Where fewer than k are found, the last indices are -1 and their similarities -inf. Those of
        IVF-PQ are products with what the codes stand for.

        Args:
            queries: unit descriptors.
            k: neighbours per query; at most all.
            effort: how much is looked at, for more to be found in more time: of HNSW, candidates
                kept while searching (by default 128, or 2 k); of IVF-PQ, lists looked into (by
                default a sixteenth of them).

        Raises:
            InputError: queries of another length, not finite or not of unit length; k or effort
                below 1.
        """
        for name, value in (("k", k), ("effort", effort)):
            if value is not None and value < 1:
                raise InputError(f"{name}: found {value}, expected at least 1")
        queries = as_rows(queries, "queries")
        if queries.shape[1] != self.faiss_index.d:
            raise InputError(
                f"queries: found descriptors of length {queries.shape[1]}, expected "
                f"{self.faiss_index.d} as in the index"
            )
        k = min(k, self.size)
        if self.kind == "hnsw":
            chosen = faiss.SearchParametersHNSW(efSearch=effort or max(_LEAST_EFFORT, 2 * k))
        else:
            lists = self.faiss_index.nlist
            chosen = faiss.SearchParametersIVF(nprobe=min(effort or -(-lists // 16), lists))
        whole = iter([np.empty(queries.shape, WIDE)])
        (block,) = blocks(queries, "queries", whole)
        similarities, indices = self.faiss_index.search(block.rows, k, params=chosen)
        return Neighbours(indices, np.where(indices < 0, -np.inf, similarities).astype(np.float32))


def build(
    kind: Kind, database: Float[np.ndarray, "n d"], *, seed: int = 0, quiet: bool = True
) -> Index:
    """An index of unit descriptors, which may be a memory map: read some at a time.

    IVF-PQ: 4 sqrt(n) lists (faiss's guidelines: 4 to 16), fewer where the sample that they are
    trained from would not give each 39 vectors; a byte for each part of a vector, in as many parts
    as divide it, of 2 numbers or more, up to 128. The sample is drawn at random, 1 GiB of
    descriptors at most. HNSW: 32 links a vector. Its graph depends on the order in which threads
    put vectors in, and so do the few neighbours that it misses; with one thread
    (OMP_NUM_THREADS=1), and always for IVF-PQ, on the seed alone.

    Args:
        kind: of `KINDS`.
        database: unit descriptors, as `retrieval.search` takes them.
        seed: of the clustering and its sample, or of the vectors' layers in the graph.
        quiet: no progress bar.

    Raises:
        InputError: an unknown kind; an array that is empty or no matrix; rows that are not finite
            or not of unit length; too few to train from.
    """
    choose("kind", kind, KINDS)
    database = as_rows(database, "database")
    count, length = database.shape
    index = _graph(length, seed) if kind == "hnsw" else _trained_lists(database, seed)
    size = max(1, _CHUNK_BYTES // (4 * length))
    buffer = np.empty((min(size, count), length), WIDE)
    with progress_bar(kind, count, "rows", quiet=quiet) as bar:
        for block in blocks(database, "database", itertools.repeat(buffer)):
            index.add(block.rows[: block.valid])
            bar.advance(block.valid)
    return Index(kind, index)


def _graph(length: int, seed: int) -> Any:
    index = faiss.IndexHNSWFlat(length, _LINKS, faiss.METRIC_INNER_PRODUCT)
    index.hnsw.efConstruction = _BUILD_EFFORT
    index.hnsw.rng = faiss.RandomGenerator(seed)
    return index


def _trained_lists(database: Float[np.ndarray, "n d"], seed: int) -> Any:
    count, length = database.shape
    if count < LEAST_ROWS:
        raise InputError(
            f"database: found {count} descriptors, expected at least {LEAST_ROWS} to train an "
            "IVF-PQ index from; search so few exactly, or by hnsw"
        )
    largest = max(LEAST_ROWS, _TRAINING_BYTES // (4 * length))
    wanted = round(4 * math.sqrt(count))
    trained_from = min(count, largest, max(LEAST_ROWS, 2 * _PER_CENTROID * wanted))
    lists = min(wanted, trained_from // _PER_CENTROID)
    parts = max(n for n in range(1, _CODE_BYTES + 1) if length % n == 0 and 2 * n <= max(2, length))
    index = faiss.IndexIVFPQ(
        faiss.IndexFlatIP(length), length, lists, parts, 8, faiss.METRIC_INNER_PRODUCT
    )
    # Centroids of unit vectors that are compared by products.
    index.cp.spherical = True
    index.cp.seed = index.pq.cp.seed = seed
    size = max(1, _CHUNK_BYTES // (4 * length))
    places = sample(count, trained_from, seed)
    index.train(np.concatenate(list(pieces(database, "database", size, places))))
    return index


def save_index(path: str | os.PathLike[str], index: Index) -> None:
    """Write an index as faiss does, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        try:
            faiss.write_index(index.faiss_index, str(temporary))
        except RuntimeError as error:
            raise InputError(f"{path}: cannot be written: {_first_line(error)}") from error


def load_index(path: str | os.PathLike[str]) -> Index:
    """Read what `save_index` wrote.

    Raises:
        InputError: there is no such file, or it holds no index of `KINDS`.
    """
    path = pathlib.Path(path)
    check_source(path, "a faiss index")
    try:
        index = faiss.read_index(str(path))
    except (RuntimeError, MemoryError) as error:
        raise InputError(f"{path}: not a whole faiss index: {_first_line(error)}") from error
    kinds: dict[type, Kind] = {faiss.IndexHNSWFlat: "hnsw", faiss.IndexIVFPQ: "ivf-pq"}
    if type(index) not in kinds or index.metric_type != faiss.METRIC_INNER_PRODUCT:
        raise InputError(
            f"{path}: found a {type(index).__name__}, expected one of inner products, as `build` "
            "makes it"
        )
    return Index(kinds[type(index)], index)


def _first_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def recall_against_exact(found: Int[np.ndarray, "q k"], exact: Int[np.ndarray, "q k"]) -> float:
    """The share of the exact neighbours that were found, over all queries, 0 to 1.

    Args:
        found: indices by an approximate search.
        exact: those by `retrieval.search`.

    Raises:
        InputError: arrays of other shapes than each other's, or of nothing.
    """
    if found.shape != exact.shape or not exact.size:
        raise InputError(
            f"found: found indices of shape {found.shape}, expected {exact.shape} as the exact "
            "ones, not empty"
        )
    pairs = zip(found, exact, strict=True)
    return sum(np.intersect1d(a, b).size for a, b in pairs) / exact.size
