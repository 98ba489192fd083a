"""Both stores against brute force in float64, and against each other."""

import fcntl
import os
import pathlib
import resource
import sys
from typing import Any

import numpy as np
import pymilvus
import pytest

from crisalad_jax.retrieval.maps import file_store
from crisalad_jax.retrieval.maps import milvus_store as milvus
from crisalad_jax.retrieval.maps.metadata import MapMetadata
from crisalad_jax.retrieval.maps.store import Store, check_store, open_store, store_name
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.search import search
from crisalad_jax.utils.errors import InputError
from tests.retrieval.maps.milvus_server import ADDRESS

LENGTH = 24
# Sums of 24 products of float32 below one, in whatever order.
ROUNDING = 2e-6
SERVER = pytest.param(f"milvus:{ADDRESS}", marks=pytest.mark.slow)
STORES = ("files", "milvus:rows.db", SERVER)


def unit_rows(count: int, seed: int = 0, length: int = LENGTH) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((count, length))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def opened(folder: pathlib.Path, name: str, *, new=True, length=LENGTH, **options) -> Store:
    fields = {"store": name, "collection": "rows", "descriptor_length": length} | options
    metadata = MapMetadata(model="", weights="", config={}, **fields)
    return open_store(metadata, folder, new=new)


@pytest.fixture(params=STORES)
def store(request, tmp_path):
    if "http" in request.param:
        request.getfixturevalue("milvus_server")
    found = opened(tmp_path, request.param)
    yield found
    found.close()


def brute_force(rows: np.ndarray, queries: np.ndarray, k: int) -> np.ndarray:
    similarities = queries.astype(np.float64) @ rows.astype(np.float64).T
    return np.argsort(-similarities, axis=1, kind="stable")[:, :k]


def record(first: int, count: int) -> dict[str, Any]:
    return {"names": [f"{number}.png" for number in range(first, first + count)]}


def fill(store: Store, rows: np.ndarray, sizes: tuple[int, ...]) -> None:
    first = 0
    for size in sizes:
        store.add(first, rows[first : first + size], record(first, size))
        first += size
    assert first == len(rows)


def test_an_addition_is_told_to_the_disk_before_it_counts(tmp_path, monkeypatch):
    """A map's record, which counts it, is written after it; a power failure leaves both or none."""
    synced = []

    def fsync(descriptor: int) -> None:
        synced.append(os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}")))

    monkeypatch.setattr(os, "fsync", fsync)
    opened(tmp_path, "files").add(0, unit_rows(3), record(0, 3))
    assert len(synced) == 2  # the file under a temporary name, then the folder that has its name
    assert [name.endswith(".npy") for name in synced] == [True, False]


@pytest.mark.parametrize("k", [1, 4, 12])
def test_search_is_exact_over_all_additions(store, k):
    rows, queries = unit_rows(12), unit_rows(5, seed=1)
    fill(store, rows, (1, 7, 4))
    found = store.search(queries, k, 12)
    expected = brute_force(rows, queries, k)
    np.testing.assert_array_equal(found.indices, expected)
    exact = np.take_along_axis(queries @ rows.T, expected, axis=1)
    np.testing.assert_allclose(found.similarities, exact, atol=ROUNDING, rtol=0)
    assert (found.indices.dtype, found.similarities.dtype) == (np.int64, np.float32)


def open_files() -> list[int]:
    return [int(name) for name in os.listdir("/proc/self/fd")]


def test_a_map_of_many_additions_leaves_descriptors_to_others(tmp_path, monkeypatch):
    """Each file that stays mapped has one of the files that the process may have open."""
    monkeypatch.setattr(file_store, "most_files", lambda: 64)
    store, rows = opened(tmp_path, "files"), unit_rows(60)
    fill(store, rows, (1,) * 60)
    before, (soft, hard) = open_files(), resource.getrlimit(resource.RLIMIT_NOFILE)
    np.testing.assert_array_equal(store.rows(np.arange(60)), rows)
    assert len(open_files()) <= len(before) + 4
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(open_files()) + 8, hard))
    try:
        found = store.search(rows, 60, 60)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    np.testing.assert_array_equal(found.indices[:, 0], np.arange(60))


def test_of_equal_descriptors_the_lower_number_is_found(store):
    """Of six alike, in three additions; which of them a search keeps is FAISS's choice."""
    rows = unit_rows(20)
    alike = [2, 3, 8, 11, 12, 19]
    rows[alike] = rows[2]
    fill(store, rows, (5, 6, 9))
    other = int(brute_force(rows, rows[2:3], 7)[0, -1])
    for k in range(1, 8):
        found = store.search(rows[2:3], k, 20)
        assert found.indices.tolist() == [[*alike, other][:k]]


def test_what_a_killed_addition_left_is_not_found_and_is_overwritten(store):
    rows = unit_rows(8)
    fill(store, rows[:6], (4, 2))
    # The map counts four; the addition of two was cut off before it counted.
    store.check([(0, 4)])
    found = store.search(rows[4:6], 4, 4)
    assert set(found.indices.ravel()) == {0, 1, 2, 3}
    store.add(4, rows[5:8], record(4, 3))
    store.check([(0, 4), (4, 3)])
    np.testing.assert_array_equal(store.read(4, 3), rows[5:8])
    assert store.search(rows[5:8], 1, 7).indices.tolist() == [[4], [5], [6]]


def test_descriptors_that_are_missing_are_an_error(store):
    fill(store, unit_rows(3), (3,))
    with pytest.raises(InputError, match=r"found (3|no such file)"):
        store.check([(0, 3), (3, 1)])


def test_float16_files_are_half_as_large_and_search_what_they_hold(tmp_path):
    rows, queries = unit_rows(12), unit_rows(5, seed=1)
    store = opened(tmp_path, "files", dtype="float16")
    fill(store, rows, (5, 7))
    kept = rows.astype(np.float16)
    np.testing.assert_array_equal(store.read(5, 7), kept[5:])
    expected = brute_force(kept.astype(np.float32), queries, 3)
    np.testing.assert_array_equal(store.search(queries, 3, 12).indices, expected)
    assert (tmp_path / "segments" / "0000000005.npy").stat().st_size == 128 + 7 * LENGTH * 2


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: data[:-1],
        lambda data: b"no array" * 52,
        lambda data: data.replace(b"(3, 24)", b"(2, 24)"),
        lambda data: data.replace(b"<f4", b"<i4"),
        lambda data: data.replace(b"False", b"True "),
    ],
)
def test_a_damaged_file_is_found_when_the_map_is_opened(tmp_path, spoil):
    """Without reading its numbers: by its header, byte for byte, and its size."""
    store = opened(tmp_path, "files")
    fill(store, unit_rows(3), (3,))
    path = tmp_path / "segments" / "0000000000.npy"
    spoilt = spoil(path.read_bytes())
    assert spoilt != path.read_bytes()
    path.write_bytes(spoilt)
    words = r"0000000000\.npy: found bytes other than float32 \(3, 24\), expected the whole"
    with pytest.raises(InputError, match=words):
        store.check([(0, 3)])


def test_files_give_the_bits_of_an_exact_search_whatever_else_is_asked(tmp_path):
    """Of copies in two segments, products in float32 differ with what else is multiplied."""
    generator = np.random.default_rng(0)
    first = unit_rows(256, length=96)
    rows = np.concatenate([first, first[generator.choice(256, 37, replace=False)]])
    queries = unit_rows(200, seed=1, length=96)
    queries[:100] = rows[generator.choice(256, 100)]
    store = opened(tmp_path, "files", length=96)
    fill(store, rows, (256, 37))
    expected = search(rows, queries, 2)
    for size in (200, 7, 1):
        parts = [store.search(queries[i : i + size], 2, 293) for i in range(0, 200, size)]
        for found, wanted in zip(zip(*parts, strict=True), expected, strict=True):
            np.testing.assert_array_equal(np.concatenate(found), wanted)


# Milvus


@pytest.fixture
def in_milvus(tmp_path):
    store = opened(tmp_path, "milvus:rows.db")
    yield store
    store.close()


def test_milvus_gives_no_descriptors_back_and_takes_bounded_messages(in_milvus, monkeypatch):
    rows, queries = unit_rows(10), unit_rows(7, seed=1)
    sent, asked, came = [], [], []
    client = in_milvus._client
    upsert, search = client.upsert, client.search

    def spied_upsert(collection, data, **more):
        sent.append(len(data))
        return upsert(collection, data, **more)

    def spied_search(collection, data, **more):
        asked.append(len(data))
        hits = search(collection, data, **more)
        came.extend(set(hit["entity"]) for query in hits for hit in query)
        return hits

    monkeypatch.setattr(client, "upsert", spied_upsert)
    monkeypatch.setattr(client, "search", spied_search)
    monkeypatch.setattr(in_milvus, "_rows", 4)
    fill(in_milvus, rows, (10,))
    found = in_milvus.search(queries, 3, 10)
    np.testing.assert_array_equal(found.indices, brute_force(rows, queries, 3))
    np.testing.assert_array_equal(in_milvus.read(0, 10), rows)
    assert sent == [4, 4, 2]
    assert asked == [4, 3]
    assert came == [{"id"}] * (7 * 4)  # one more than k


def test_a_file_that_another_process_has_open_is_one_line(tmp_path, in_milvus, capfd):
    in_milvus.close()
    with (tmp_path / "rows.db" / "LOCK").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(InputError, match=r"rows\.db: Milvus says: .*another process has it"):
            opened(tmp_path, "milvus:rows.db", new=False)
    again = opened(tmp_path, "milvus:rows.db", new=False)  # for the fixture to close
    again.close()
    assert capfd.readouterr() == ("", "")


def test_what_is_missing_in_milvus_is_named(tmp_path, in_milvus):
    with pytest.raises(InputError, match=r"gone\.db: found nothing, expected the descriptors"):
        opened(tmp_path, "milvus:gone.db", new=False)
    with pytest.raises(InputError, match=r"rows\.db: found no collection other, expected it"):
        opened(tmp_path, "milvus:rows.db", collection="other", new=False)


def test_an_index_that_a_kill_cut_short_is_made_again(tmp_path, in_milvus, capfd):
    """milvus-lite writes it in place, and cannot load what is left of it."""
    rows = unit_rows(10)
    fill(in_milvus, rows, (6, 4))
    in_milvus.close()
    indices = sorted((tmp_path / "rows.db").rglob("*.idx"))
    assert indices
    for path, rest in zip(indices, (b"", b"half"), strict=False):
        path.write_bytes(rest)
    again = opened(tmp_path, "milvus:rows.db", new=False)
    again.check([(0, 6), (6, 4)])
    np.testing.assert_array_equal(again.search(rows, 1, 10).indices[:, 0], range(10))
    again.close()
    assert capfd.readouterr() == ("", "")


def test_a_server_that_does_not_answer_is_one_line(tmp_path, capfd):
    with pytest.raises(InputError, match=r"^http://127\.0\.0\.1:9: Milvus says: Fail connecting"):
        opened(tmp_path, "milvus:http://127.0.0.1:9")
    assert capfd.readouterr() == ("", "")


def test_a_server_gets_the_token_of_the_environment(tmp_path, monkeypatch):
    given = []

    def refuse(*arguments, **options):
        given.append((arguments, options))
        raise pymilvus.MilvusException(message="auth\ncheck failure")

    monkeypatch.setattr(pymilvus, "MilvusClient", refuse)
    monkeypatch.setenv(milvus.TOKEN, "root:secret")
    with pytest.raises(
        InputError, match=r"^https://a\.b:1: Milvus says: auth check failure \(while connecting\)$"
    ):
        opened(tmp_path, "milvus:https://a.b:1")
    ((addresses, options),) = given
    assert (addresses, options["token"]) == (("https://a.b:1",), "root:secret")


def test_milvus_is_asked_for_when_it_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "milvus_lite", None)
    with pytest.raises(
        InputError, match=r"found no module milvus_lite, .*pip install 'crisalad-jax"
    ):
        opened(tmp_path, "milvus:rows.db")


def test_more_neighbours_than_milvus_gives_are_an_error(in_milvus):
    with pytest.raises(InputError, match="k: found 16385, expected at most 16384"):
        in_milvus.search(unit_rows(1), 16385, 20000)


# Names


@pytest.mark.parametrize(
    ("name", "dtype", "words"),
    [
        ("hdf5", "float32", "store: found 'hdf5', expected files or milvus:URI"),
        ("milvus:map", "float32", "found 'map' after milvus:, expected a file name.db"),
        ("milvus:http://me:secret@host", "float32", "in the environment variable CRISALAD_MILVUS_"),
        ("milvus:x.db", "float16", "dtype: found 'float16', expected float32 in milvus:x.db"),
        ("files", "int8", "dtype: found 'int8', expected float32 or float16 or bits in files"),
    ],
)
def test_a_store_that_is_none_is_refused_by_its_name(name, dtype, words):
    with pytest.raises(InputError) as error:
        check_store(name, dtype)
    assert words in str(error.value)
    assert "secret" not in str(error.value)


def test_a_file_inside_of_the_map_is_named_relative_to_it(tmp_path, monkeypatch):
    """So that the map can be moved."""
    monkeypatch.chdir(tmp_path)
    folder = pathlib.Path("map")
    assert store_name("milvus:map/x.db", folder) == "milvus:x.db"
    assert store_name("milvus:x.db", folder) == f"milvus:{tmp_path / 'x.db'}"
    assert store_name("milvus:http://h:19530", folder) == "milvus:http://h:19530"


# Ties


@pytest.mark.parametrize("seed", range(20))
def test_any_choice_among_equals_becomes_the_lower_number(seed):
    """`ask` takes any of equal ones, in any order; similarities are few, so that most are equal."""
    generator = np.random.default_rng(seed)
    queries, count = 6, int(generator.integers(1, 30))
    similarities = generator.integers(0, 4, (queries, count)).astype(np.float32)
    k = int(generator.integers(1, count + 1))

    def ask(part: np.ndarray, asked: int) -> Neighbours:
        shuffled = generator.permuted(np.tile(np.arange(count), (len(part), 1)), axis=1)
        chosen = similarities[part[:, 0].astype(int)]
        order = np.argsort(-np.take_along_axis(chosen, shuffled, axis=1), axis=1)[:, :asked]
        indices = np.take_along_axis(shuffled, order, axis=1)
        return Neighbours(indices, np.take_along_axis(chosen, indices, axis=1))

    rows = np.arange(queries, dtype=np.float32)[:, None]
    found = milvus.break_ties(ask, rows, k, count)
    expected = np.argsort(-similarities, axis=1, kind="stable")[:, :k]
    np.testing.assert_array_equal(found.indices, expected)
    np.testing.assert_array_equal(
        found.similarities, np.take_along_axis(similarities, expected, axis=1)
    )
