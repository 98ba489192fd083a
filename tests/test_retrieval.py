"""Search against a float64 stable argsort, and recall by hand."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from crisalad_jax import retrieval
from crisalad_jax.errors import InputError


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


@pytest.mark.parametrize("chunk", [1, 7, 64, 128, 299, 300, 8192])
def test_search_agrees_with_brute_force_for_any_chunk(chunk):
    database, queries = _random_unit(0, 300, 24), _random_unit(1, 11, 24)
    found = retrieval.search(database, queries, 10, chunk=chunk)
    # These draws have no two similarities within 1e-6 among the first 11: the order is unique.
    indices, similarities = _brute_force(database, queries, 11)
    assert np.diff(similarities, axis=1).max() < -1e-6
    np.testing.assert_array_equal(found.indices, indices[:, :10])
    _assert_ranked(found, database, queries, 10)


def test_search_orders_as_the_l2_distance_does():
    database, queries = _random_unit(2, 50, 8), _random_unit(3, 5, 8)
    distances = np.linalg.norm(queries[:, None].astype(np.float64) - database[None], axis=2)
    found = retrieval.search(database, queries, 50, chunk=16)
    np.testing.assert_array_equal(found.indices, np.argsort(distances, axis=1))


def test_search_walks_queries_in_chunks(monkeypatch):
    database, queries = _random_unit(4, 40, 16), _random_unit(5, 23, 16)
    whole = retrieval.search(database, queries, 5)
    monkeypatch.setattr(retrieval, "_QUERY_CHUNK", 10)
    parts = retrieval.search(database, queries, 5)
    np.testing.assert_array_equal(parts.indices, whole.indices)
    _assert_ranked(parts, database, queries, 5)


@pytest.mark.parametrize("chunk", [1, 3, 100, 128, 130, 1000])
def test_equal_rows_come_in_database_order(chunk):
    # Every row stands 100 times, 5 apart, across chunk borders and at every place in a block.
    database = np.tile(_random_unit(6, 5, 200), (100, 1))
    queries = _random_unit(7, 3, 200)
    found = retrieval.search(database, queries, 150, chunk=chunk)
    best = np.argsort(-(queries.astype(np.float64) @ database[:5].astype(np.float64).T), axis=1)
    for row, (first, second, *_) in zip(found.indices, best, strict=True):
        np.testing.assert_array_equal(row[:100], np.arange(100) * 5 + first)
        np.testing.assert_array_equal(row[100:], np.arange(50) * 5 + second)


def test_signed_zeros_are_a_tie():
    # The first product underflows to -0.0.
    database = np.array([[1, 0, -1e-30], [1, 0, 0], [1, 0, 1e-30]], np.float32)
    found = retrieval.search(database, np.array([[0, 1, 1e-30]], np.float32), 3)
    np.testing.assert_array_equal(found.indices, [[0, 1, 2]])


@pytest.mark.parametrize("chunk", [2, 8192])
def test_k_beyond_the_database_gives_every_image_and_no_padding(chunk):
    # All similarities are negative: a padding row of zeros would come first.
    database = np.array([[-1, 0], [-0.6, 0.8], [-0.8, 0.6]], np.float32)
    found = retrieval.search(database, np.array([[1, 0]], np.float32), 20, chunk=chunk)
    np.testing.assert_array_equal(found.indices, [[1, 2, 0]])
    np.testing.assert_array_equal(found.similarities, np.array([[-0.6, -0.8, -1]], np.float32))


@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(
    count=st.integers(1, 40),
    queries=st.integers(1, 6),
    k=st.integers(1, 45),
    chunk=st.integers(1, 45),
    seed=st.integers(0, 2**32 - 1),
)
def test_small_integers_are_ranked_exactly(count, queries, k, chunk, seed):
    # Rows with four of 16 entries +-0.5 are unit vectors, and their products are exact in float32:
    # many ties, and the float64 stable argsort is the one right answer.
    rng = np.random.default_rng(seed)
    rows = np.zeros((count + queries, 16), np.float32)
    rows[:, :4] = rng.choice([-0.5, 0.5], (len(rows), 4))
    rows = rng.permuted(rows, axis=1)
    database, wanted = rows[:count], rows[count:]
    found = retrieval.search(database, wanted, k, chunk=chunk)
    indices, similarities = _brute_force(database, wanted, k)
    np.testing.assert_array_equal(found.indices, indices)
    np.testing.assert_array_equal(found.similarities, similarities)


def test_search_reads_a_memory_map_of_half_floats(tmp_path):
    database, queries = _random_unit(8, 70, 12).astype(np.float16), _random_unit(9, 4, 12)
    np.save(tmp_path / "database.npy", database)
    mapped = np.load(tmp_path / "database.npy", mmap_mode="r")
    found = retrieval.search(mapped, queries, 6, chunk=32)
    _assert_ranked(found, database, queries, 6)


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
        ((rows, none, 1), r"^queries: found shape \(0, 4\)"),
        ((rows, _random_unit(1, 2, 5), 1), "^queries: found descriptors of length 5, expected 4"),
        ((rows, rows, 0), "^k: found 0"),
    ]:
        with pytest.raises(InputError, match=message):
            retrieval.search(*arguments)
    with pytest.raises(InputError, match=r"^chunk: found 0"):
        retrieval.search(rows, rows, 1, chunk=0)


def test_recall_by_hand():
    indices = np.array(
        [
            [4, 1, 2, 3, 0],  # right at rank 1
            [4, 1, 2, 3, 0],  # right at ranks 3 and 4
            [0, 1, 2, 3, 4],  # its positives were not found
            [0, 1, 2, 3, 4],  # it has none: a miss, and still counted
            [3, 2, 1, 4, 0],  # right at rank 5
        ]
    )
    positives = [np.array(p, np.int64) for p in ([4], [2, 3], [7, 9], [], [0, 12])]
    found = retrieval.recalls(indices, positives, ks=(1, 2, 3, 5, 20))
    assert found == {1: 1 / 5, 2: 1 / 5, 3: 2 / 5, 5: 3 / 5, 20: 3 / 5}
    assert list(retrieval.recalls(indices, positives)) == [1, 5, 10, 20]


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
def test_recall_agrees_with_sets_and_never_falls(seed):
    rng = np.random.default_rng(seed)
    indices = np.stack([rng.permutation(30)[:12] for _ in range(8)])
    positives = [rng.permutation(30)[: rng.integers(0, 4)] for _ in range(8)]
    ks = (1, 2, 5, 12)
    found = retrieval.recalls(indices, positives, ks)
    for k in ks:
        hits = [bool(set(i[:k]) & set(p)) for i, p in zip(indices, positives, strict=True)]
        assert found[k] == sum(hits) / 8
    assert sorted(found.values()) == list(found.values())


def test_recall_rejects_what_it_cannot_count():
    indices = np.array([[0, 1]])
    with pytest.raises(InputError, match=r"^indices: found no queries"):
        retrieval.recalls(np.zeros((0, 3), np.int64), [])
    with pytest.raises(InputError, match=r"^positives: found 2 lists, expected 1"):
        retrieval.recalls(indices, [np.array([0]), np.array([1])])
    with pytest.raises(InputError, match=r"^positives: query 0 has -1"):
        retrieval.recalls(indices, [np.array([-1])])
    with pytest.raises(InputError, match=r"^ks: found 0"):
        retrieval.recalls(indices, [np.array([0])], ks=(0, 5))


@pytest.mark.parametrize("most", [400, 5, 3, 1])
def test_similarity_map_by_brute_force(most: int, monkeypatch: pytest.MonkeyPatch):
    """Blocks smaller than the sets, whose last ones are not full."""
    monkeypatch.setattr(retrieval, "_QUERY_CHUNK", 4)
    monkeypatch.setattr(retrieval, "_MAP_CHUNK", 6)
    database, queries = _random_unit(2, 13, 8), _random_unit(3, 7, 8)
    every = queries @ database.T
    rows, columns = retrieval.cells_of(7, most), retrieval.cells_of(13, most)
    expected = np.array(
        [
            [every[np.ix_(rows == row, columns == column)].max() for column in np.unique(columns)]
            for row in np.unique(rows)
        ]
    )
    found = retrieval.similarity_map(database, queries, most=most)
    assert found.shape == (min(7, most), min(13, most))
    # Sums of eight products in float32.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_cells_are_even_and_in_order():
    assert retrieval.cells_of(5, 9).tolist() == [0, 1, 2, 3, 4]
    cells = retrieval.cells_of(1003, 10)
    assert (np.diff(cells) >= 0).all()
    assert set(np.bincount(cells)) == {100, 101}


def test_a_similarity_map_checks_what_it_is_given():
    unit = np.eye(3, dtype=np.float32)
    with pytest.raises(InputError, match=r"^database: row 0 is of length 2"):
        retrieval.similarity_map(2 * unit, unit)
    with pytest.raises(InputError, match=r"^queries: found descriptors of length 2, expected 3"):
        retrieval.similarity_map(unit, unit[:, :2])
