"""Descriptors in Milvus: a server, or milvus-lite in this process, by the same code."""

import contextlib
import logging
import os
import pathlib
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from crisalad_jax.retrieval.bits import Bits
from crisalad_jax.retrieval.chunks import Descriptors, Queries
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.shapes import Float, Int64

TOKEN = "CRISALAD_MILVUS_TOKEN"
"""The environment variable that holds a server's token, or its user:password."""
# Bytes in a message, at most: Milvus takes 64 MiB by default.
_MESSAGE_BYTES = 2**24
_MOST = 16384
"""Largest number of neighbours, of queries at once, and of returned rows that Milvus allows."""
# The last one logs a call that milvus-lite lacks, whose failure the client expects.
_LOGS = ("pymilvus.decorators", "milvus_lite.server_manager", "grpc._server")


def check_address(address: str) -> bool:
    """Check Milvus' address; return True for an http address, False for a file.

    Raises:
        InputError: neither, or an address with a user's name.
    """
    if address.startswith(("http://", "https://")):
        if "@" in urllib.parse.urlsplit(address).netloc:
            raise InputError(
                "store: found a user's name in the address, expected it in the environment "
                f"variable {TOKEN}, which no file keeps"
            )
        return True
    if "://" in address or not address.endswith(".db"):
        raise InputError(
            f"store: found {address!r} after milvus:, expected a file name.db or an address "
            "http://host:port"
        )
    return False


@contextlib.contextmanager
def _one_line(address: str) -> Iterator[None]:
    """Turn Milvus' errors into one line."""
    import grpc
    import pymilvus

    try:
        yield
    except (pymilvus.MilvusException, grpc.RpcError) as error:
        words = getattr(error, "message", None) or str(error)
        if "Open local milvus failed" in words:
            words += " (damaged, or another process has it open)"
        raise InputError(f"{address}: Milvus says: {' '.join(words.split())}") from error


class MilvusStore:
    """A `Store` in a collection of Milvus with the index FLAT, which is exact."""

    def __init__(self, address: str, collection: str, length: int, *, new: bool) -> None:
        """Connect to `address`, and make the collection if it is `new`."""
        self._is_file = not check_address(address)
        try:
            import pymilvus

            if self._is_file:
                import milvus_lite as _milvus_lite  # noqa: F401
        except ModuleNotFoundError as error:
            raise InputError(missing_extra(error, "store milvus")) from error
        for name in _LOGS:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # its errors are raised
        self._address, self._collection = address, collection
        self._rows = max(1, min(_MOST, _MESSAGE_BYTES // (4 * length)))
        path = pathlib.Path(address)
        if self._is_file and new:
            path.parent.mkdir(parents=True, exist_ok=True)
        if self._is_file and not new and not path.exists():
            raise InputError(f"{address}: found nothing, expected the descriptors of this map")
        with _one_line(address):
            self._client = pymilvus.MilvusClient(address, token=os.environ.get(TOKEN, ""))
            if new:
                self._client.drop_collection(collection)
                self._create(length)
            elif not self._client.has_collection(collection):
                raise InputError(
                    f"{address}: found no collection {collection}, expected it with the "
                    "descriptors of this map"
                )
            self._load()

    def _create(self, length: int) -> None:
        from pymilvus import DataType

        schema = self._client.create_schema(auto_id=False, enable_dynamic_field=False)
        schema.add_field("id", DataType.INT64, is_primary=True)
        schema.add_field("descriptor", DataType.FLOAT_VECTOR, dim=length)
        self._client.create_collection(
            self._collection, schema=schema, index_params=self._flat(), consistency_level="Strong"
        )

    def _flat(self) -> Any:
        index = self._client.prepare_index_params()
        index.add_index("descriptor", index_type="FLAT", metric_type="IP")
        return index

    def _load(self) -> None:
        import pymilvus

        try:
            self._client.load_collection(self._collection)
        except pymilvus.MilvusException:
            if not self._is_file:
                raise
            # milvus-lite writes an index in place: one that a kill cut short never loads again. It
            # can be rebuilt from the descriptors.
            self._client.release_collection(self._collection)
            self._client.drop_index(self._collection, "descriptor")
            self._client.create_index(self._collection, self._flat())
            self._client.load_collection(self._collection)

    def add(self, first: int, descriptors: Descriptors) -> None:
        """Upsert descriptors by number; see `Store.add`."""
        rows = np.ascontiguousarray(descriptors, np.float32)
        with _one_line(self._address):
            for start in range(0, len(rows), self._rows):
                part = enumerate(rows[start : start + self._rows], first + start)
                data = [{"id": number, "descriptor": row} for number, row in part]
                self._client.upsert(self._collection, data)
            self._client.flush(self._collection)

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Count the stored descriptors; see `Store.check`."""
        expected = sum(count for _, count in segments)
        (answer,) = self._fetch(f"id < {expected}", "count(*)")
        if (stored := answer["count(*)"]) != expected:
            raise InputError(
                f"{self._address}: found {stored} descriptors in {self._collection}, expected "
                f"{expected}, as many as the map has images"
            )

    def _fetch(self, condition: str, *fields: str) -> list[dict[str, Any]]:
        with _one_line(self._address):
            found = self._client.query(
                self._collection, filter=condition, output_fields=list(fields)
            )
        return list(found)

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Fetch the descriptors of one addition; see `Store.read`."""
        return self.rows(np.arange(first, first + count))

    def rows(self, numbers: Int64[np.ndarray, " n"]) -> Descriptors:
        """Fetch the descriptors of these numbers; see `Store.rows`."""
        found: dict[int, Any] = {}
        for start in range(0, len(numbers), self._rows):
            some = numbers[start : start + self._rows].tolist()
            part = self._fetch(f"id in {some}", "id", "descriptor")
            found |= {row["id"]: row["descriptor"] for row in part}
        return np.array([found[number] for number in numbers.tolist()], np.float32)

    def drop(self, first: int) -> None:
        """Do nothing, as the next addition overwrites them; see `Store.drop`."""

    def search(
        self, queries: Queries | Bits, k: int, count: int, removed: Removed = NONE
    ) -> Neighbours:
        """Find the k most similar descriptors of each query; see `Store.search`."""
        condition, left = f"id < {count}", count - len(removed.rows)
        if left < count:
            condition += f" and id not in {removed.rows.tolist()}"
        if k > _MOST:
            raise InputError(f"k: found {k}, expected at most {_MOST}, of which Milvus gives")

        def ask(queries: Queries, k: int) -> Neighbours:
            # Answers are bounded too: 12 bytes for each neighbour, and 8 for its number again.
            size = max(1, min(self._rows, _MESSAGE_BYTES // (20 * k)))
            found: list[list[dict[str, Any]]] = []
            with _one_line(self._address):
                for start in range(0, len(queries), size):
                    found += self._client.search(
                        self._collection,
                        data=list(queries[start : start + size]),
                        limit=k,
                        filter=condition,
                        # milvus-lite reads an empty list as all fields, descriptors included.
                        output_fields=["id"],
                        search_params={"metric_type": "IP"},
                    )
            return Neighbours(
                np.array([[hit["id"] for hit in hits] for hits in found], np.int64),
                np.array([[hit["distance"] for hit in hits] for hits in found], np.float32),
            )

        found = break_ties(ask, queries, k, min(left, _MOST))
        return found._replace(indices=removed.numbers_of(found.indices))

    def close(self) -> None:
        """Disconnect; other processes may then open the file."""
        with _one_line(self._address):
            self._client.close()
        if self._is_file:
            from milvus_lite.server_manager import server_manager_instance

            server_manager_instance.release_server(self._address)


def break_ties(
    ask: Callable[[Queries, int], Neighbours], queries: Queries, k: int, count: int
) -> Neighbours:
    """Search so that equal similarities are ordered by number, also at the k-th place.

    One more than k is asked for. Where the last is as similar as the k-th, there may be more equal
    ones: twice as many are asked for, until the last is less similar.

    Args:
        ask: takes queries and k; returns the k most similar of each, equal ones in any order.
        queries: unit descriptors.
        k: neighbours per query, at most `count`.
        count: how many descriptors there are.
    """
    asked = k + 1
    while True:
        indices, similarities = ask(queries, min(asked, count)).in_order()
        if asked >= count or (similarities[:, k - 1] > similarities[:, -1]).all():
            return Neighbours(indices[:, :k], similarities[:, :k])
        asked *= 2
