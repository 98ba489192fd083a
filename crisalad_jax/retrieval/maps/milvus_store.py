"""Descriptors in Milvus: on a server, or in milvus-lite in this process, with the same code.

Rows are upserted, so that a call whose acknowledgement was lost can be repeated. Milvus writes rows
to its log before acknowledging them; searches here see all rows acknowledged before.
"""

import contextlib
import logging
import os
import pathlib
import re
import time
import urllib.parse
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.config.checks import choose, require
from crisalad_jax.retrieval.bits import Bits
from crisalad_jax.retrieval.chunks import Block, Descriptors, Queries
from crisalad_jax.retrieval.maps.milvus_filter import among, columns_of, left_in
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.neighbours import Neighbours, nearest
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.output import one_line, warn, warn_once
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Float, Int64

TOKEN = "CRISALAD_MILVUS_TOKEN"
"""The environment variable that holds a server's token, or its user:password."""
# Most bytes in a message: Milvus accepts 64 MiB by default.
_MESSAGE_BYTES = 2**24
_MOST = 16384
"""Largest number of neighbours, of queries at once, and of returned rows that Milvus allows."""
_CONNECT = 10.0
"""Seconds to wait for a connection."""
_GRPC = {"grpc.max_reconnect_backoff_ms": 1000}
"""Without this, up to two minutes pass before a server that is back is contacted again."""
_ANSWER = 120.0
"""Seconds to wait for an answer, including a restart of the server."""
_STALLED = 1800.0
"""Seconds without progress before giving up on an index: a segment of a GB takes some minutes."""
_PASSING = (2, 101, 103, 106, 503, 700)
"""Error codes of a server that is coming back, which Milvus does not call retriable: no connection;
a collection that is not loaded, or whose index is being built; an unavailable channel."""
# The last one logs a call that milvus-lite lacks and whose failure the client expects.
_LOGS = ("pymilvus.decorators", "pymilvus.client", "milvus_lite.server_manager", "grpc._server")


class _Kind(NamedTuple):
    """An index of Milvus."""

    name: str
    since: tuple[int, ...]
    """The first version that has it; milvus-lite counts as (0,)."""
    build: Mapping[str, Any] = {}
    search: Callable[[int], Mapping[str, Any]] = lambda _: {}
    """Returns parameters of a search for k neighbours."""


KINDS = {
    "exact": _Kind("FLAT", (0,)),
    "hnsw": _Kind(
        "HNSW", (0,), {"M": 32, "efConstruction": 128}, lambda k: {"ef": max(128, 2 * k)}
    ),
    "ivf-rabitq": _Kind(
        "IVF_RABITQ",
        (2, 6),
        {"nlist": 1024, "refine": True, "refine_type": "SQ8"},
        lambda _: {"nprobe": 64, "refine_k": 4},
    ),
    "diskann": _Kind("DISKANN", (2, 2), {}, lambda k: {"search_list": max(128, 2 * k)}),
}
"""How Milvus searches: all descriptors ("exact"), a graph set up as for files ("hnsw") or codes of
a bit and a byte per dimension ("ivf-rabitq"), in memory; or a graph on disk ("diskann")."""
_FEW, _GRAPH_BYTES = 50_000, 2**34
"""Maximum number of descriptors compared one by one, and maximum bytes of those in a graph."""


def choose_kind(count: int, length: int, version: tuple[int, ...]) -> str:
    """Choose one of `KINDS` in this Milvus version, for `count` descriptors of this length."""
    kinds = [kind for kind in ("ivf-rabitq", "diskann") if KINDS[kind].since <= version]
    small = "exact" if count <= _FEW else "hnsw"
    return small if 4 * count * length <= _GRAPH_BYTES or not kinds else kinds[0]


def check_address(address: str) -> bool:
    """Check a Milvus address; return True for an http address, False for a file.

    Raises:
        InputError: it is neither, or contains a user name.
    """
    if address.startswith(("http://", "https://")):
        if "@" in urllib.parse.urlsplit(address).netloc:
            raise InputError(
                "store: found a user's name in the address, expected it in the environment "
                f"variable {TOKEN}, which no file stores"
            )
        return True
    if "://" in address or not address.endswith(".db"):
        raise InputError(
            f"store: found {address!r} after milvus:, expected a file name.db or an address "
            "http://host:port"
        )
    return False


class MilvusStore:
    """A `Store` in a Milvus collection."""

    def __init__(self, address: str, collection: str, length: int, *, new: bool) -> None:
        """Connect to `address`, and create the collection if it is `new`."""
        self._is_file = not check_address(address)
        try:
            import pymilvus

            if self._is_file:
                import milvus_lite as _milvus_lite  # noqa: F401
        except ModuleNotFoundError as error:
            raise InputError(missing_extra(error, "store milvus")) from error
        for name in _LOGS:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # its errors are raised
        self._address, self._collection, self._length = address, collection, length
        self._rows = max(1, min(_MOST, _MESSAGE_BYTES // (4 * length)))
        self._since: int | None = None
        """Milvus' time after the last acknowledged addition; None if not known yet."""
        self._loaded = False
        path = pathlib.Path(address)
        if self._is_file and new:
            path.parent.mkdir(parents=True, exist_ok=True)
        if self._is_file and not new and not path.exists():
            raise InputError(f"{address}: found nothing, expected the descriptors of this map")
        with self._one_line("connecting"):
            options = {"timeout": _CONNECT, "grpc_options": _GRPC}
            token = os.environ.get(TOKEN, "")
            self._client: Any = pymilvus.MilvusClient(address, token=token, **options)
            self._server: str = self._client.get_server_version(timeout=_CONNECT)
        numbers = re.findall(r"\d+", self._server)[:3]
        self._version = (0,) if self._is_file else tuple(map(int, numbers))
        self.kind = "exact"
        """The kind of the current index, one of `KINDS`."""
        if new:
            self._ask("removing what a kill left", "drop_collection")
            self._create()
        elif not self._ask("looking for the map", "has_collection"):
            raise InputError(
                f"{address}: found no collection {collection}, expected it with this map's rows"
            )
        elif found := self._index():
            names = {each.name: kind for kind, each in KINDS.items()}
            self.kind = names[found["index_type"]]
        else:  # a process was killed while changing the index
            self._make_index()

    @contextlib.contextmanager
    def _one_line(self, doing: str) -> Iterator[None]:
        """Turn Milvus' errors into one line."""
        import grpc
        import pymilvus

        try:
            yield
        except (pymilvus.MilvusException, grpc.RpcError) as error:
            words = getattr(error, "message", None) or str(error)
            if isinstance(error, grpc.RpcError):
                words = f"no answer in time, {error.code().name}"  # pyright: ignore
            if "Open local milvus failed" in words:
                words += " (damaged, or another process has it open)"
            words = f"{one_line(words)} (while {doing})"
            raise InputError(f"{self._address}: Milvus says: {words}") from error

    def _ask(self, doing: str, method: str, *, wait: float = 0, **options: Any) -> Any:
        """Call a method of the client, and retry while a server is coming back.

        Raises:
            InputError: Milvus refuses, or does not come back in `_ANSWER` seconds.
        """
        import grpc
        import pymilvus

        end, wait = None, wait or _ANSWER
        while True:
            with self._one_line(doing):
                try:
                    call = getattr(self._client, method)
                    return call(self._collection, timeout=wait, **options)
                except pymilvus.MilvusException as error:
                    end = end or time.monotonic() + _ANSWER
                    # 2.3 has no code for components that have not found each other yet.
                    passes = error.retriable or "unrecoverable error" in error.message
                    passes |= error.code in _PASSING
                    if not passes or self._is_file or time.monotonic() > end:
                        raise
                    words = f"Milvus says {error.message}; waiting for up to {_ANSWER:g} s"
                    warn_once(self._address, one_line(words))
            time.sleep(0.5)
            wait = max(1.0, end - time.monotonic())
            if self._loaded:
                with contextlib.suppress(pymilvus.MilvusException, grpc.RpcError):
                    self._client.load_collection(self._collection, timeout=wait)

    def _create(self) -> None:
        from pymilvus import DataType

        schema = self._client.create_schema(auto_id=False, enable_dynamic_field=False)
        schema.add_field("id", DataType.INT64, is_primary=True)
        schema.add_field("name", DataType.VARCHAR, max_length=65535)
        for name in ("added", "taken", "x", "y"):
            schema.add_field(name, DataType.DOUBLE)
        schema.add_field("descriptor", DataType.FLOAT_VECTOR, dim=self._length)
        options = {"schema": schema, "consistency_level": "Strong"}
        self._ask("making a collection", "create_collection", **options)
        self._make_index()

    def _index(self) -> Any:
        return self._ask("asking for the index", "describe_index", index_name="descriptor")

    def _make_index(self) -> None:
        index, (name, _, build, _) = self._client.prepare_index_params(), KINDS[self.kind]
        index.add_index("descriptor", index_type=name, metric_type="IP", params=dict(build))
        self._ask("making an index", "create_index", index_params=index, sync=False)

    def _drop_index(self) -> None:
        self._loaded = False
        self._ask("removing an index", "release_collection")
        self._ask("removing an index", "drop_index", index_name="descriptor")

    def _load(self) -> None:
        if self._loaded:
            return
        try:
            self._ask("loading descriptors", "load_collection", wait=_STALLED)
        except InputError:
            if not self._is_file:
                raise
            # milvus-lite writes an index in place: one that a kill interrupted never loads again,
            # but can be rebuilt from the descriptors.
            self._drop_index()
            self._make_index()
            self._ask("loading descriptors", "load_collection")
        self._loaded = True

    def build(self, kind: str, count: int, *, quiet: bool = True) -> None:
        """Build the index of all descriptors, including those that are added later.

        Searches, also in other processes, wait until it is ready.

        Args:
            kind: one of `KINDS`, or "auto" for `choose_kind`.
            count: number of descriptors.
            quiet: whether to hide the progress bar.

        Raises:
            InputError: this server does not have this kind, or fails.
        """
        if kind == "auto":
            kind = choose_kind(count, self._length, self._version)
            what = f"{count} descriptors of {self._length} dimensions, Milvus {self._server}"
            warn(f"{self._address}: --search auto takes {kind}: {what}")
        known = [name for name, each in KINDS.items() if each.since <= self._version]
        choose(f"search in Milvus {self._server}", kind, dict.fromkeys(known))
        self._ask("writing descriptors", "flush", wait=_STALLED)
        if kind != self.kind:
            self._drop_index()
            self.kind = kind
            self._make_index()
        rows, last = 0, time.monotonic()
        with progress_bar("indexed", count, "descriptors", quiet=quiet) as bar:
            while (found := self._index())["state"] != "Finished":
                if found["indexed_rows"] > rows:
                    bar.advance(found["indexed_rows"] - rows)
                    rows, last = found["indexed_rows"], time.monotonic()
                if found["state"] == "Failed" or time.monotonic() - last > _STALLED:
                    raise InputError(
                        f"{self._address}: found the index of {self._collection} "
                        f"{found['state']} at {rows} of {count} descriptors"
                    )
                time.sleep(0.2)
        self._load()

    def add(self, first: int, descriptors: Descriptors, record: Mapping[str, Any]) -> None:
        """Upsert descriptors by number; see `FileStore.add`."""
        numbers = range(first, first + len(descriptors))
        columns = {"id": numbers, "descriptor": np.asarray(descriptors, np.float32)}
        columns |= columns_of(record)
        for start in range(0, len(numbers), self._rows):
            parts = (column[start : start + self._rows] for column in columns.values())
            data = [dict(zip(columns, row, strict=True)) for row in zip(*parts, strict=True)]
            self._ask(f"adding descriptors from {numbers[start]} on", "upsert", data=data)
        if self._is_file:  # a server has written them to its log
            self._ask("writing descriptors", "flush")
        self._since = None

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Count the stored descriptors; see `FileStore.check`."""
        if not segments:  # a new map is loaded once it is searched
            return
        expected = sum(count for _, count in segments)
        condition, fields = f"id < {expected}", ["count(*)"]
        (answer,) = self._fetch("counting descriptors", "query", condition, output_fields=fields)
        if (stored := answer["count(*)"]) != expected:
            raise InputError(
                f"{self._address}: found {stored} descriptors in {self._collection}, expected "
                f"{expected}, as many as the map has images"
            )

    def _fetch(self, doing: str, method: str, condition: str, **options: Any) -> Any:
        """Query or search everything that was acknowledged before the first call."""
        self._load()
        if self._since is None:
            with self._one_line("asking for its time"):
                self._since = self._client._get_connection().alloc_timestamp(timeout=_ANSWER)
        # "Strong" would wait for Milvus' next tick each time, 0.2 s or more.
        options |= {"consistency_level": "Customized", "guarantee_timestamp": self._since}
        return self._ask(doing, method, filter=condition, **options)

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Fetch the descriptors of one addition; see `FileStore.read`."""
        return self.rows(np.arange(first, first + count))

    def rows(self, numbers: Int64[np.ndarray, " n"]) -> Descriptors:
        """Fetch the descriptors with these numbers; see `FileStore.rows`."""
        found, ordered = dict[int, Any](), np.sort(numbers)
        for start in range(0, len(ordered), self._rows):
            condition = among(ordered[start : start + self._rows])
            fields = {"output_fields": ["id", "descriptor"]}
            for row in self._fetch("reading descriptors", "query", condition, **fields):
                found[row["id"]] = np.asarray(row["descriptor"], np.float32)
        if missing := set(numbers.tolist()) - found.keys():
            raise InputError(
                f"{self._address}: found no descriptor {min(missing)} in {self._collection}, "
                "expected all of the map's images"
            )
        return np.array([found[number] for number in numbers.tolist()])

    def drop(self, first: int) -> None:
        """Do nothing, as the next addition overwrites the rows; see `FileStore.drop`."""

    def search(
        self, queries: Queries | Bits, k: int, count: int, removed: Removed = NONE
    ) -> Neighbours:
        """Find the k most similar descriptors for each query; see `FileStore.search`.

        With kind "exact" Milvus itself searches; with others all descriptors are read and compared.
        """
        require(k <= _MOST, f"k: found {k}, expected at most {_MOST}, the limit of Milvus")
        if self.kind != "exact":
            return self._search_here(queries, k, count, removed)
        left = min(count - len(removed.rows), _MOST)
        found = break_ties(lambda some, k: self.ask(some, k, count, removed), queries, k, left)
        return found._replace(indices=removed.numbers_of(found.indices))

    def _search_here(self, queries: Queries, k: int, count: int, removed: Removed) -> Neighbours:
        def read(numbers: Int64[np.ndarray, " n"]) -> Descriptors:
            return self.rows(removed.rows_of(numbers))

        def stream() -> Generator[Block]:
            left = np.arange(count - len(removed.rows))
            for start in range(0, len(left), self._rows):
                yield Block(start, read(left[start : start + self._rows]))

        return nearest(stream, queries, k, read, self._rows)

    def ask(self, queries: Queries, k: int, count: int, removed: Removed) -> Neighbours:
        """Search Milvus' index; if it finds fewer than k, the last numbers are -1."""
        k, condition = min(k, _MOST), left_in(count, removed)
        # Answers are bounded too: 12 bytes per neighbour, and 8 for its number again.
        size = max(1, min(self._rows, _MESSAGE_BYTES // (20 * k)))
        indices = np.full((len(queries), k), -1, np.int64)
        similarities = np.full((len(queries), k), -np.inf, np.float32)
        for start in range(0, len(queries), size):
            found = self._fetch(
                "searching",
                "search",
                condition,
                data=list(queries[start : start + size]),
                limit=k,
                # milvus-lite reads an empty list as all fields, descriptors included.
                output_fields=["id"],
                search_params={"metric_type": "IP", "params": dict(KINDS[self.kind].search(k))},
            )
            for row, hits in enumerate(found, start):
                indices[row, : len(hits)] = [hit["id"] for hit in hits]
                similarities[row, : len(hits)] = [hit["distance"] for hit in hits]
        return Neighbours(indices, similarities)

    def close(self) -> None:
        """Disconnect; other processes may then open the file."""
        with self._one_line("disconnecting"):
            self._client.close()
        if self._is_file:
            from milvus_lite.server_manager import server_manager_instance

            server_manager_instance.release_server(self._address)


def break_ties(
    ask: Callable[[Queries, int], Neighbours], queries: Queries, k: int, count: int
) -> Neighbours:
    """Search so that equal similarities are ordered by number, also at the k-th place.

    One more than k is requested. If the last is as similar as the k-th, there may be more equal
    ones: twice as many are requested, until the last is less similar.

    Args:
        ask: takes queries and k; returns the k most similar of each, equal ones in any order.
        queries: unit descriptors.
        k: neighbours per query, at most `count`.
        count: number of descriptors that can be found.
    """
    asked = k + 1
    while True:
        indices, similarities = ask(queries, min(asked, count)).in_order()
        if asked >= count or (similarities[:, k - 1] > similarities[:, -1]).all():
            return Neighbours(indices[:, :k], similarities[:, :k])
        asked *= 2
