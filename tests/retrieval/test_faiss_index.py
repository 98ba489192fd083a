"""Approximate indexes: what they find of the exact neighbours, and what they are made from."""

from collections.abc import Iterator

import faiss
import numpy as np
import pytest

from crisalad_jax.retrieval import faiss_index as approximate
from crisalad_jax.retrieval.faiss_index import build, load_index, recall_against_exact, save_index
from crisalad_jax.retrieval.search import search
from crisalad_jax.utils.errors import InputError

COUNT, LENGTH = 4001, 64


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """So that a graph depends on its seed alone; and threads that wait for each other in turn take
    longer than one where cores are shared."""
    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    yield
    faiss.omp_set_num_threads(before)


@pytest.fixture(scope="module")
def places() -> tuple[np.ndarray, np.ndarray]:
    """Database and queries: several views of each of many places, as descriptors lie; float16
    holds them."""
    generator = np.random.default_rng(0)
    centres = generator.standard_normal((200, LENGTH))

    def views(count: int) -> np.ndarray:
        rows = centres[generator.integers(0, 200, count)]
        rows = rows + 0.5 * generator.standard_normal(rows.shape)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        return rows.astype(np.float16).astype(np.float32)

    return views(COUNT), views(50)


@pytest.fixture(scope="module")
def indexes(places) -> dict[str, approximate.Index]:
    return {kind: build(kind, places[0], seed=3) for kind in approximate.KINDS}


def share_of(exact: np.ndarray, found: np.ndarray) -> float:
    """The share of the exact neighbours that are anywhere among those that were found."""
    pairs = zip(exact, found, strict=True)
    return sum(np.isin(one, some).sum() for one, some in pairs) / exact.size


def test_what_is_found_are_most_of_the_exact_neighbours(places, indexes):
    exact = search(*places, 10)
    # Measured: 1.000 of a graph; of signs 0.72, and 1.000 among 100. Chance would find 0.0025.
    for kind, least in (("hnsw", 0.99), ("ivf-rabitq", 0.6)):
        found = indexes[kind].search(places[1], 10)
        assert found.indices.dtype == np.int64
        assert found.similarities.dtype == np.float32
        assert (np.diff(found.similarities, axis=1) <= 0).all()
        assert least <= recall_against_exact(found.indices, exact.indices) <= 1
        assert share_of(exact.indices, indexes[kind].search(places[1], 100).indices) > 0.97
        assert indexes[kind].size == COUNT


def test_a_rotation_makes_the_signs_of_uneven_numbers_tell(places):
    """As of principal components, of which the first are the largest: FAISS's own index of them,
    without a rotation, finds less."""
    uneven = [rows * np.arange(1, LENGTH + 1) ** -1.5 for rows in places]
    uneven = [(rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype("f4") for rows in uneven]
    exact, ours = search(*uneven, 10).indices, build("ivf-rabitq", uneven[0])
    flat = faiss.IndexFlatIP(LENGTH)
    plain = faiss.IndexIVFRaBitQ(flat, LENGTH, COUNT // 39, faiss.METRIC_INNER_PRODUCT)
    plain.cp.spherical = True
    plain.train(uneven[0])
    plain.add(uneven[0])
    plain.nprobe = plain.nlist
    found = plain.search(uneven[1], 20)[1]
    # Measured: 0.97 and 0.80.
    assert share_of(exact, ours.search(uneven[1], 20).indices) > share_of(exact, found) + 0.1


def test_signs_estimate_inner_products(places, indexes):
    found = indexes["ivf-rabitq"].search(places[1], 5)
    expected = np.einsum("qd,qkd->qk", places[1], places[0][found.indices])
    # The paper's bound falls as 1 / sqrt(d), 0.125 here, times the distances to the centroid.
    assert np.abs(found.similarities - expected).mean() < 0.1


def test_what_was_added_later_is_found(places, indexes):
    later = build("ivf-rabitq", places[0][:3600], seed=3)  # 92 lists
    later.add([places[0][3600:3900], places[0][3900:]], 401)
    assert later.size == COUNT
    found = later.search(places[0][3600:3650], 10).indices
    assert all(3600 + i in row for i, row in enumerate(found))
    assert later.has_room_for(2 * 92 * 39)
    assert not later.has_room_for(3 * 92 * 39)
    assert indexes["hnsw"].has_room_for(10**9)


@pytest.mark.parametrize("kind", approximate.KINDS)
def test_what_is_left_out_is_not_found(kind, places, indexes):
    nearest = indexes[kind].search(places[1], 5).indices
    without = np.unique(nearest)
    found = indexes[kind].search(places[1], 5, without=without).indices
    assert not np.isin(found, without).any()
    assert (found >= 0).all()


def test_the_similarities_of_a_graph_are_inner_products(places, indexes):
    found = indexes["hnsw"].search(places[1], 5)
    expected = np.einsum("qd,qkd->qk", places[1], places[0][found.indices])
    np.testing.assert_allclose(found.similarities, expected, atol=1e-6)  # float32 sums


def test_more_effort_finds_more(places, indexes):
    for kind, k, asked, most in (("hnsw", 10, 10, 400), ("ivf-rabitq", 50, 200, 10**6)):
        exact = search(*places, k).indices
        little, much = (
            share_of(exact, indexes[kind].search(places[1], asked, effort).indices)
            for effort in (1, most)
        )
        assert little < much


def test_the_parameters_are_those_that_are_documented(indexes):
    rotated, graph = indexes["ivf-rabitq"].faiss_index, indexes["hnsw"].faiss_index
    lists = faiss.downcast_index(rotated.index)
    # As many lists as give each 39 of the vectors; a bit of each number, and two factors.
    assert (lists.nlist, lists.code_size) == (COUNT // 39, LENGTH // 8 + 8)
    turned = rotated.chain.at(0).apply(np.eye(LENGTH, dtype=np.float32))
    np.testing.assert_allclose(turned @ turned.T, np.eye(LENGTH), atol=1e-5)  # float32 sums
    assert np.abs(turned).max() < 0.7  # of 64 numbers drawn with a deviation of 1/8
    assert graph.hnsw.nb_neighbors(1) == 32
    assert graph.hnsw.efConstruction == 128


def test_a_few_long_vectors_fill_up_to_a_power_of_two(capfd):
    rows = np.eye(20, 8200, dtype=np.float32)
    index = build("ivf-rabitq", rows)
    lists = faiss.downcast_index(index.faiss_index.index)
    assert (lists.nlist, lists.code_size) == (1, 16384 // 8 + 8)
    np.testing.assert_array_equal(index.search(rows, 1).indices[:, 0], np.arange(20))
    assert capfd.readouterr() == ("", "")  # no warning of a library


def test_the_same_seed_makes_the_same_lists_of_a_memory_map(places, indexes, tmp_path, monkeypatch):
    np.save(tmp_path / "database.npy", places[0].astype(np.float16))
    mapped = np.load(tmp_path / "database.npy", mmap_mode="r")
    monkeypatch.setattr(approximate, "_CHUNK_BYTES", 4 * LENGTH * 1000)  # a thousand at a time
    found = build("ivf-rabitq", mapped, seed=3).search(places[1], 10)
    expected = indexes["ivf-rabitq"].search(places[1], 10)
    np.testing.assert_array_equal(found.indices, expected.indices)
    # Rotated in other numbers of rows, whose float32 sums round otherwise.
    np.testing.assert_allclose(found.similarities, expected.similarities, atol=1e-5)


def test_a_graph_of_a_memory_map_finds_all_if_it_looks_everywhere(places, tmp_path, monkeypatch):
    np.save(tmp_path / "database.npy", places[0][:500])
    mapped = np.load(tmp_path / "database.npy", mmap_mode="r")
    monkeypatch.setattr(approximate, "_CHUNK_BYTES", 4 * LENGTH * 60)
    found = build("hnsw", mapped).search(places[1], 3, effort=500)
    np.testing.assert_array_equal(found.indices, search(mapped, places[1], 3).indices)


@pytest.mark.parametrize("kind", approximate.KINDS)
def test_what_is_saved_comes_back(kind, places, indexes, tmp_path):
    path = tmp_path / "new" / "some.index"
    save_index(path, indexes[kind])
    again = load_index(path)
    assert again.kind == kind
    for found, expected in zip(
        again.search(places[1], 4), indexes[kind].search(places[1], 4), strict=True
    ):
        np.testing.assert_array_equal(found, expected)
    assert [one.name for one in path.parent.iterdir()] == ["some.index"]


def test_neighbours_that_are_not_found_are_minus_one(places, indexes):
    """Of one list of some 39 vectors, 100 are wanted."""
    found = indexes["ivf-rabitq"].search(places[1], 1000, effort=1)
    missing = found.indices == -1
    assert missing.any()
    assert (found.similarities[missing] == -np.inf).all()
    assert np.isfinite(found.similarities[~missing]).all()


def test_bad_input_is_named(places, indexes, tmp_path):
    database, queries = places
    for call, words in (
        (lambda: build("lsh", database), "^kind: found 'lsh', expected one of hnsw, ivf-rabitq"),
        (lambda: build("hnsw", database[0]), r"^database: found shape \(64,\)"),
        (lambda: build("hnsw", database * 2), "^database: row 0 is of length 2, expected finite"),
        (
            lambda: indexes["hnsw"].search(queries[:, :5], 3),
            r"^queries: found shape \(50, 5\), expected \(images, 64\)",
        ),
        (lambda: indexes["hnsw"].search(queries, 0), "^k: found 0, expected at least 1"),
        (
            lambda: indexes["ivf-rabitq"].search(queries, 1, 0),
            "^effort: found 0, expected at least 1",
        ),
        (lambda: load_index(tmp_path / "none"), "none: found no such file, expected a faiss index"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_files_of_something_else_are_named(places, indexes, tmp_path):
    path = tmp_path / "some.index"
    faiss.write_index(faiss.IndexFlatL2(4), str(path))
    with pytest.raises(
        InputError, match=r"some\.index: found a IndexFlatL2, expected an index by inner product"
    ):
        load_index(path)
    save_index(path, indexes["ivf-rabitq"])
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"some\.index: not a whole faiss index"):
        load_index(path)


def test_recall_by_hand():
    exact = np.array([[0, 1, 2], [3, 4, 5]])
    assert recall_against_exact(np.array([[2, 1, 0], [9, 8, -1]]), exact) == 3 / 6
    assert recall_against_exact(exact, exact) == 1
