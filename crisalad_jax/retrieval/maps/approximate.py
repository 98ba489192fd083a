"""Approximate search of a map: a FAISS index built from its descriptors, or the index of Milvus.

The name of a FAISS index contains a digest of the additions that it was built from. An index of
other additions is not used, so a map that has grown never answers from an old one. If an index of
the first additions exists, building extends it by the new ones.
"""

import hashlib
import math
import pathlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.retrieval.chunks import Queries, sample
from crisalad_jax.retrieval.maps.milvus_store import KINDS, MilvusStore
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.maps.store import Store
from crisalad_jax.retrieval.neighbours import Neighbours, similarities_of
from crisalad_jax.retrieval.segments import Segments
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.host import available_memory
from crisalad_jax.utils.temporaries import made_folder, remove_temporaries

if TYPE_CHECKING:
    from crisalad_jax.retrieval.faiss_index import Index

SEARCHES: dict[str, None] = dict.fromkeys(("auto", "exact", "hnsw", "ivf-rabitq"))
"""How to search a map in files: "auto" is what `choose_search` chooses; "exact" compares every
descriptor; "hnsw" follows a graph of the descriptors in memory; "ivf-rabitq" compares their signs
in memory, and ranks the best by the descriptors in the files."""
_EXACT_BYTES = 2**26
"""Largest size of descriptors that `choose_search` searches exactly: a query reads all of them, in
less than a tenth of a second."""
_GRAPH_BYTES = 2**30
"""Largest size of a graph that `choose_search` chooses; a larger one takes long to build."""
_LINK_BYTES = 272
"""Size of one descriptor's links in a graph."""
FOLDER = "approximate"
NEIGHBOURS, SAMPLE = 10, 100
"""Recall is measured over the 10 nearest other images of each of 100 of the map's images."""
_CANDIDATES = {"hnsw": (2, 16), "ivf-rabitq": (10, 100), "diskann": (2, 16)}
"""By kind: candidates per neighbour, and the minimum number of candidates; the best of them by
exact similarity are the answer."""
_SEARCHED = 10
"""The index is searched only if at least one in this many descriptors is left."""
_SEED = 0
Additions = Sequence[tuple[int, int, str]]
"""Number of the first descriptor, count and SHA-256 of each addition to a map."""


class Approximate(NamedTuple):
    """An approximate search of a map's descriptors."""

    kind: str
    ask: Callable[[Queries, int, int, Removed], Neighbours]
    """Returns k candidates per query for (queries, k, count, removed); missing ones are -1."""
    store: Store
    recall: float
    """Share of exact neighbours found when it was built (see `NEIGHBOURS`); NaN if unknown."""
    is_served: bool = False
    """Whether Milvus finds the candidates, however few descriptors are left after removals."""

    def search(self, queries: Queries, k: int, count: int, removed: Removed = NONE) -> Neighbours:
        """Find the k most similar of `count` descriptors by ranking candidates exactly.

        A query with fewer than k candidates is searched exactly, as is a map in files with less
        than a tenth of its descriptors left. Descriptors in `removed` are never found.

        Raises:
            InputError: the store is damaged or gone.
        """
        each, least = _CANDIDATES[self.kind]
        left, candidates = count - len(removed.rows), max(least, each * k)
        if not self.is_served:
            if left < count // _SEARCHED:
                return self.store.search(queries, k, count, removed)
            candidates = candidates * count // left
        numbers = self.ask(queries, min(left, candidates), count, removed).indices
        query, found = np.nonzero(numbers >= 0)
        index, similarities = numbers[query, found], np.full(numbers.shape, -np.inf, np.float32)
        similarities[query, found] = similarities_of(queries, query, index, self.store.rows)
        numbers, similarities = Neighbours(numbers, similarities).in_order().first(k)
        few = np.flatnonzero(numbers[:, -1] < 0)
        if few.size:
            exact = self.store.search(queries[few], k, count, removed)
            numbers[few], similarities[few] = removed.rows_of(exact.indices), exact.similarities
        return Neighbours(removed.numbers_of(numbers), similarities)


def open_approximate(
    folder: pathlib.Path, segments: Segments, *, verify: bool
) -> Approximate | None:
    """Open the approximate search of the map in `folder`; None if it has none for `segments`.

    Raises:
        InputError: its index is damaged or, if `verify` is set, has changed.
    """
    if isinstance(segments.store, MilvusStore):
        return _served(segments.store)
    path = _current(folder, segments.spans)
    if path is None:
        return None
    from crisalad_jax.retrieval.faiss_index import load_index

    index = load_index(path, verify=verify)
    recall = float(_record(path)["recall"])
    return Approximate(index.kind, _asking(index), segments.store, recall)


def indexed_images(folder: pathlib.Path) -> list[tuple[pathlib.Path, int]]:
    """List the approximate searches in a map's folder, with the number of images in each.

    Raises:
        InputError: the record of one is damaged.
    """
    return [(path, int(_record(path)["images"])) for path in _indices(folder)]


def stale_kind(folder: pathlib.Path, additions: Additions) -> str | None:
    """Return the kind of an outdated approximate search in a map's folder; None without one."""
    found = _indices(folder)
    if not found or _current(folder, additions) is not None:
        return None
    return found[0].stem.rpartition("-")[0]


def check_search(kind: str, store: str, dtype: str) -> None:
    """Check that a store supports this kind of search for descriptors of type `dtype`.

    Raises:
        InputError: the store does not have this kind, or it is an approximate search of bits.
    """
    choose("search", kind, SEARCHES if store == "files" else dict.fromkeys((*KINDS, "auto")))
    if kind not in ("auto", "exact") and dtype == "bits":
        raise InputError(f"search: found {kind} for a map of bits, expected exact")


def choose_search(count: int, length: int, dtype: str) -> tuple[str, str]:
    """Choose how to search descriptors in files, by their size and the available memory.

    Args:
        count: number of descriptors.
        length: number of dimensions of each.
        dtype: type that they are stored as: "float32", "float16" or "bits".

    Returns:
        One of `SEARCHES`, and why it was chosen.
    """
    if dtype == "bits":
        return "exact", "bits are only searched exactly"
    size, graph = count * length * np.dtype(dtype).itemsize, count * (4 * length + _LINK_BYTES)
    if size <= _EXACT_BYTES:
        return "exact", f"a query reads {size / 1e6:.1f} MB, of {_EXACT_BYTES / 1e6:.0f} MB at most"
    memory = available_memory()
    most = min(_GRAPH_BYTES, memory // 4)
    why = f"a graph in memory takes {graph / 1e9:.2f} GB, of {most / 1e9:.2f} GB at most"
    return ("hnsw" if graph <= most else "ivf-rabitq"), f"{why} ({memory / 1e9:.1f} GB available)"


def build_approximate(
    folder: pathlib.Path, kind: str, segments: Segments, *, quiet: bool = True
) -> Approximate | None:
    """Build or extend the approximate search of a map; "exact" removes it, and returns None.

    Args:
        folder: the map's folder, whose lock is held.
        kind: one that `check_search` accepts; "auto" only for Milvus.
        segments: the map's descriptors.
        quiet: whether to hide the progress bar.

    Raises:
        InputError: an index that would be extended is damaged, or the disk is full.
    """
    count, store = len(segments), segments.store
    if isinstance(store, MilvusStore):
        # Before the index changes: with FLAT, the server compares all descriptors.
        measure = None if kind == "exact" else _measuring(store, count)
        store.build(kind, count, quiet=quiet)
        built = _served(store)
        return built and built._replace(recall=measure(built) if measure else math.nan)
    if kind == "exact":
        shutil.rmtree(folder / FOLDER, ignore_errors=True)
        return None
    path = folder / FOLDER / f"{kind}-{_digest(segments.spans)}.index"
    if path.exists():
        return open_approximate(folder, segments, verify=True)
    from crisalad_jax.retrieval.faiss_index import build, save_index

    index = _extended(folder, kind, segments, quiet=quiet)
    if index is None:
        index = build(cast(Any, kind), segments.blocks, seed=_SEED, quiet=quiet)
    built = Approximate(index.kind, _asking(index), store, 0.0)
    built = built._replace(recall=_measuring(store, count)(built))
    with made_folder(path.parent):
        remove_temporaries(path.parent)
        value = {"kind": kind, "images": count, "recall": built.recall}
        write_json(path.with_suffix(".json"), value | {"queries": min(SAMPLE, count)})
        save_index(path, index)
    for other in path.parent.iterdir():
        if other.stem != path.stem:
            other.unlink()
    return built


def _extended(
    folder: pathlib.Path, kind: str, segments: Segments, *, quiet: bool
) -> "Index | None":
    """Extend an index of a map's first additions by the new ones; None if no index fits."""
    for length, digest in enumerate(_digests(segments.spans), 1):
        path = folder / FOLDER / f"{kind}-{digest}.index"
        if path.exists():
            from crisalad_jax.retrieval.faiss_index import load_index

            index, more = load_index(path), segments.spans[length:]
            if not index.has_room_for(len(segments)):
                return None
            new = (segments.store.read(each.first, each.count) for each in more)
            index.add(new, len(segments) - index.size, quiet=quiet)
            return index
    return None


def _asking(index: "Index") -> Callable[[Queries, int, int, Removed], Neighbours]:
    return lambda queries, k, _, removed: index.search(queries, k, without=removed.rows)


def _served(store: MilvusStore) -> Approximate | None:
    """Return Milvus' approximate search of a map, whose recall is not known yet."""
    if store.kind == "exact":
        return None
    return Approximate(store.kind, store.ask, store, math.nan, is_served=True)


def _measuring(store: Store, count: int) -> Callable[[Approximate], float]:
    """Find the exact neighbours of some images; return a function that measures their recall."""
    from crisalad_jax.retrieval.faiss_index import recall_against_exact

    places = sample(count, min(SAMPLE, count), _SEED)
    k = min(NEIGHBOURS + 1, count)
    queries = store.rows(places).astype(np.float32)
    exact = _others(places, store.search(queries, k, count).indices)

    def recall(built: Approximate) -> float:
        found = _others(places, built.search(queries, k, count).indices)
        return recall_against_exact(found, exact) if exact.size else 1.0

    return recall


def _others(places: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Drop each image itself from its neighbours, or the last one if it is not among them."""
    kept = numbers != places[:, None]
    kept[kept.all(axis=1), -1] = False
    return numbers[kept].reshape(len(numbers), -1)


def _digests(additions: Additions) -> Iterator[str]:
    """Yield a digest of the first addition, of the first two, and so on."""
    digest = hashlib.sha256()
    for first, count, rows in additions:
        digest.update(f"{first} {count} {rows}\n".encode())
        yield digest.hexdigest()[:16]


def _digest(additions: Additions) -> str:
    return ["none", *_digests(additions)][-1]


def _indices(folder: pathlib.Path) -> list[pathlib.Path]:
    return sorted((folder / FOLDER).glob("*.index"))


def _current(folder: pathlib.Path, additions: Additions) -> pathlib.Path | None:
    """Return the index that was built from these additions."""
    digest = _digest(additions)
    return next((path for path in _indices(folder) if path.stem.endswith(digest)), None)


def _record(path: pathlib.Path) -> dict[str, Any]:
    return read_json(path.with_suffix(".json"), "a record of an approximate search")
