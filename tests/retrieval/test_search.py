"""Search against a float64 stable argsort, and against faiss."""

import sys
import unittest.mock

import faiss
import hypothesis
import hypothesis.strategies as st
import ml_dtypes
import numpy as np
import pytest

from crisalad_jax.retrieval import neighbours
from crisalad_jax.retrieval import search as retrieval
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.target import GPU
from tests.utils.test_compiler import in_a_program


def _unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def _random_unit(seed, count, length):
    rows = np.random.default_rng(seed).standard_normal((count, length))
    return _unit(rows).astype(np.float32)


def _brute_force(database, queries, k):
    similarities = queries.astype(np.float64) @ database.astype(np.float64).T
    indices = np.argsort(-similarities, axis=1, kind="stable")[:, :k]
    return indices, np.take_along_axis(similarities, indices, axis=1)


def _assert_ranked(found, database, queries, k):
    """The order is the exact one, up to swaps of neighbours that float32 cannot tell apart."""
    indices, similarities = _brute_force(database, queries, k)
    assert found.indices.dtype == np.int64
    assert found.similarities.dtype == np.float32
    assert found.indices.shape == indices.shape
    exact = queries.astype(np.float64) @ database.astype(np.float64).T
    # 1e-6: a float32 sum of products of unit vectors errs by a few 6e-8.
    np.testing.assert_allclose(found.similarities, similarities, atol=1e-6, rtol=0)
    np.testing.assert_allclose(
        np.take_along_axis(exact, found.indices, axis=1), similarities, atol=1e-6, rtol=0
    )
    for row in found.indices:
        assert len(set(row.tolist())) == len(row)


def _by_devices(
    database: np.ndarray, queries: np.ndarray, k: int, *, chunk: int = 4096
) -> retrieval.Neighbours:
    """As on an accelerator; a CPU leaves it to numpy."""
    with unittest.mock.patch.object(retrieval, "target", return_value=GPU):
        return retrieval.search(database, queries, k, chunk=chunk)


BOTH_WAYS = pytest.mark.parametrize(
    "search", [pytest.param(retrieval.search, id="numpy"), pytest.param(_by_devices, id="devices")]
)


@BOTH_WAYS
@pytest.mark.parametrize("chunk", [1, 7, 64, 128, 299, 300, 8192])
def test_search_agrees_with_brute_force_for_any_chunk(search, chunk):
    database, queries = _random_unit(0, 300, 24), _random_unit(1, 11, 24)
    found = search(database, queries, 10, chunk=chunk)
    # These draws have no two similarities within 1e-6 among the first 11: the order is unique.
    indices, similarities = _brute_force(database, queries, 11)
    assert np.diff(similarities, axis=1).max() < -1e-6
    np.testing.assert_array_equal(found.indices, indices[:, :10])
    _assert_ranked(found, database, queries, 10)


def test_search_walks_queries_in_chunks(monkeypatch):
    database, queries = _random_unit(4, 40, 16), _random_unit(5, 23, 16)
    whole = retrieval.search(database, queries, 5)
    monkeypatch.setattr(neighbours, "QUERY_CHUNK", 10)
    parts = retrieval.search(database, queries, 5)
    np.testing.assert_array_equal(parts.indices, whole.indices)
    _assert_ranked(parts, database, queries, 5)


def test_signed_zeros_are_a_tie():
    # The first product underflows to -0.0.
    database = np.array([[1, 0, -1e-30], [1, 0, 0], [1, 0, 1e-30]], np.float32)
    found = retrieval.search(database, np.array([[0, 1, 1e-30]], np.float32), 3)
    np.testing.assert_array_equal(found.indices, [[0, 1, 2]])


@BOTH_WAYS
@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(
    count=st.integers(1, 40),
    queries=st.integers(1, 6),
    k=st.integers(1, 45),
    chunk=st.integers(1, 45),
    seed=st.integers(0, 2**32 - 1),
)
def test_small_integers_are_ranked_exactly(search, count, queries, k, chunk, seed):
    # Rows with four of 16 entries +-0.5 are unit vectors, and their products are exact in float32:
    # many ties, and the float64 stable argsort is the one right answer.
    rng = np.random.default_rng(seed)
    rows = np.zeros((count + queries, 16), np.float32)
    rows[:, :4] = rng.choice([-0.5, 0.5], (len(rows), 4))
    rows = rng.permuted(rows, axis=1)
    database, wanted = rows[:count], rows[count:]
    found = search(database, wanted, k, chunk=chunk)
    indices, similarities = _brute_force(database, wanted, k)
    np.testing.assert_array_equal(found.indices, indices)
    np.testing.assert_array_equal(found.similarities, similarities)


@pytest.mark.parametrize(
    ("kind", "in_a_file"), [(np.float16, np.float16), (ml_dtypes.bfloat16, "V2")]
)
def test_search_reads_a_memory_map_of_half_floats(tmp_path, kind, in_a_file):
    """A .npy file has no name for bfloat16: it comes back as two bytes each."""
    database, queries = _random_unit(8, 70, 12).astype(kind), _random_unit(9, 4, 12)
    np.save(tmp_path / "database.npy", database)
    mapped = np.load(tmp_path / "database.npy", mmap_mode="r")
    assert mapped.dtype == np.dtype(in_a_file)
    found = retrieval.search(mapped, queries, 6, chunk=32)
    _assert_ranked(found, database, queries, 6)
    again = retrieval.search(database, queries, 6)
    np.testing.assert_array_equal(found.similarities, again.similarities)


@pytest.mark.parametrize("seed", range(3))
def test_duplicates_and_their_order_are_those_of_faiss(seed):
    """More equal rows than a device names beside k, at every k; 24 queries are multiplied as one
    matrix by faiss, 3 one by one."""
    generator = np.random.default_rng(seed)
    distinct = np.zeros((40, 64), np.float32)
    # Products of these are exact in float32, squared distances too.
    distinct[:, :16] = generator.choice([-0.25, 0.25], (40, 16))
    distinct = generator.permuted(distinct, axis=1)
    database = distinct[generator.integers(0, 40, 900)]
    index = faiss.IndexFlatL2(64)
    index.add(database)
    for count, k in ((24, 1), (24, 20), (24, 77), (3, 20)):
        queries = distinct[generator.integers(0, 40, count)]
        distances, indices = index.search(queries, k)
        found = retrieval.search(database, queries, k, chunk=128)
        np.testing.assert_array_equal(found.indices, indices)
        np.testing.assert_array_equal(2 - 2 * found.similarities, distances)


@BOTH_WAYS
@hypothesis.settings(max_examples=20, deadline=None)
@hypothesis.given(
    count=st.integers(1, 300), k=st.integers(1, 40), chunk=st.integers(1, 300), seed=st.integers(0)
)
@hypothesis.example(count=900, k=20, chunk=450, seed=3)
def test_copies_and_rows_that_float32_cannot_tell_apart_are_ranked_exactly(
    search, count, k, chunk, seed
):
    """Their products differ by less than a float32 product errs: candidates are the wrong ones."""
    generator = np.random.default_rng(seed)
    places = _random_unit(17, 3, 1000)
    queries = np.concatenate([places, _random_unit(18, 2, 1000)])
    database = places[generator.integers(0, generator.integers(1, 4), count)]
    is_copy = generator.random((count, 1)) < generator.random()
    noise = 1e-7 * generator.standard_normal(database.shape)
    database = np.where(is_copy, database, database + noise).astype(np.float32)
    wanted = (queries.astype(np.float64) @ database.astype(np.float64).T).astype(np.float32)
    found = search(database, queries, k, chunk=chunk)
    indices = np.argsort(-wanted, axis=1, kind="stable")[:, :k]
    np.testing.assert_array_equal(found.indices, indices)
    np.testing.assert_array_equal(found.similarities, np.take_along_axis(wanted, indices, axis=1))


_ON_DEVICES = """
import sys
import jax, numpy as np
from crisalad_jax.retrieval import search as retrieval
from crisalad_jax.utils.target import GPU
assert len(jax.local_devices()) == int(sys.argv[2])
retrieval.target = lambda: GPU
arrays = np.load(sys.argv[1])
for name, (k, chunk) in {"some": (20, 300), "tiny": (3, 1), "all": (700, 4096)}.items():
    # Which a CPU leaves to numpy.
    found = retrieval.search(arrays["database"], arrays["queries"], k, chunk=chunk)
    np.savez(f"{sys.argv[3]}-{name}.npz", *found)
"""


@pytest.mark.parametrize("count", [1, 8])
def test_devices_change_no_bit(count, tmp_path):
    database, queries = _random_unit(14, 700, 96), _random_unit(15, 30, 96)
    database[400:500] = database[:100]
    database[600:660] = database[3]
    queries[0] = database[3]
    np.savez(tmp_path / "arrays.npz", database=database, queries=queries)
    arguments = map(str, (tmp_path / "arrays.npz", count, tmp_path / "found"))
    in_a_program(_ON_DEVICES, tmp_path, *arguments, JAX_NUM_CPU_DEVICES=str(count))
    for name, k in {"some": 20, "tiny": 3, "all": 700}.items():
        found = np.load(tmp_path / f"found-{name}.npz")
        expected = retrieval.search(database, queries, k)
        np.testing.assert_array_equal(found["arr_0"], expected.indices)
        np.testing.assert_array_equal(found["arr_1"], expected.similarities)


_IN_MEMORY = """
import pathlib, re, sys
import jax, numpy as np
from crisalad_jax.retrieval.search import search

def most():
    # What getrusage says begins with the memory of the program that started this one.
    status = pathlib.Path("/proc/self/status").read_text()
    return int(re.search("VmHWM:\\s*(\\d+) kB", status)[1])

database, queries = (np.load(path, mmap_mode="r") for path in sys.argv[1:])
search(database[:2048], queries, 5, chunk=512)
before = most()
search(database, queries, 5, chunk=512)
print(most() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's account of memory")
def test_memory_does_not_grow_with_the_database(tmp_path):
    """10,000 and 100,000 rows of 1 KiB, of which a program that kept them would have 102 MB."""
    generator = np.random.default_rng(0)
    np.save(tmp_path / "queries.npy", _random_unit(1, 16, 256))
    grown = {}
    for count in (10_000, 100_000):
        path = tmp_path / f"{count}.npy"
        rows = np.lib.format.open_memmap(path, "w+", np.float32, (count, 256))
        for start in range(0, count, 10_000):
            part = generator.standard_normal((10_000, 256), np.float32)
            rows[start : start + 10_000] = _unit(part)
        del rows
        said = in_a_program(_IN_MEMORY, tmp_path, str(path), str(tmp_path / "queries.npy"))
        grown[count] = int(said) * 1024
    # A chunk is 0.5 MB, the pages around it some MB; what is read in all, 92 MB more.
    assert grown[100_000] - grown[10_000] < 12e6


def test_a_copy_on_write_map_keeps_what_was_written_to_it(tmp_path):
    """Its pages are never let go: what they hold is nowhere else."""
    np.save(tmp_path / "database.npy", _random_unit(16, 4000, 16))
    mapped = np.load(tmp_path / "database.npy", mmap_mode="c")
    mapped[3000] = np.eye(16)[2]
    query = np.eye(16, dtype=np.float32)[2:3]
    for _ in range(2):
        assert retrieval.search(mapped, query, 1, chunk=64).indices == 3000


@pytest.mark.parametrize("name", ["database", "queries"])
@pytest.mark.parametrize(
    ("value", "found"), [(np.nan, "not finite"), (np.inf, "not finite"), (3, "of length")]
)
def test_wrong_rows_are_named(name, value, found):
    arrays = {"database": _random_unit(0, 9, 4), "queries": _random_unit(1, 9, 4)}
    arrays[name][6, 1] = value
    with pytest.raises(InputError, match=rf"^{name}: row 6 is {found}"):
        retrieval.search(**arrays, k=1, chunk=4)


def test_wrong_shapes_and_numbers_are_named():
    rows, none = _random_unit(0, 9, 4), np.zeros((0, 4), np.float32)
    for arguments, message in [
        ((none, rows, 1), r"^database: found shape \(0, 4\)"),
        ((rows, rows.astype(complex), 1), "^queries: found numbers of type complex128, expected"),
        ((rows.astype(object), rows, 1), "^database: found numbers of type object, expected"),
        ((rows, none, 1), r"^queries: found shape \(0, 4\)"),
        ((rows, _random_unit(1, 2, 5), 1), r"^queries: found shape .* expected \(images, 4\)"),
        ((rows, rows, 0), "^k: found 0"),
    ]:
        with pytest.raises(InputError, match=message):
            retrieval.search(*arguments)
    with pytest.raises(InputError, match=r"^chunk: found 0"):
        retrieval.search(rows, rows, 1, chunk=0)


# Euclidean distance


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_cosines_rank_as_distances(kind: type) -> None:
    rng = np.random.default_rng(0)
    sides = [
        (rng.normal(size=(count, 9)) * rng.uniform(0.1, 20, (count, 1))).astype(kind)
        for count in (300, 40)
    ]
    found = retrieval.search(*retrieval.to_unit_vectors(*sides), 5)
    database, queries = (side.astype(np.float64) for side in sides)
    squares = np.square(queries[:, None] - database).sum(axis=2)
    np.testing.assert_array_equal(found.indices, squares.argsort(axis=1, kind="stable")[:, :5])
    largest = max(np.square(side).sum(axis=1).max() for side in (database, queries))
    nearest = np.take_along_axis(squares, found.indices, axis=1)
    expected = (np.square(queries).sum(axis=1, keepdims=True) - nearest) / largest / 3
    # Float32 of a unit vector's numbers.
    np.testing.assert_allclose(found.similarities, expected, atol=3e-7, rtol=0)


def test_zeros_are_embedded() -> None:
    found = retrieval.search(*retrieval.to_unit_vectors(np.zeros((2, 3)), np.zeros((1, 3))), 1)
    assert found.indices.tolist() == [[0]]


def test_bad_sides_are_named() -> None:
    with pytest.raises(InputError, match=r"^queries: row 1 is not finite, expected finite"):
        retrieval.to_unit_vectors(np.zeros((2, 2)), np.array([[0.0, 1.0], [np.nan, 0.0]]))
    with pytest.raises(InputError, match=r"^queries: found shape \(2, 3\), expected \(images, 2\)"):
        retrieval.to_unit_vectors(np.zeros((2, 2)), np.zeros((2, 3)))
