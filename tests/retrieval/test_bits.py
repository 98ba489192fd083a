"""Binary descriptors against numpy's packing and faiss's binary index."""

import faiss
import numpy as np
import pytest

from crisalad_jax import InputError, pack_bits, search
from crisalad_jax.retrieval.bits import sign_vectors
from crisalad_jax.retrieval.neighbours import QUERY_CHUNK
from crisalad_jax.retrieval.search import to_unit_vectors


def draw(count: int, length: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, length)).astype(np.float32)


def test_bits_are_the_signs_with_the_first_dimension_highest():
    rows = draw(5, 24)
    rows[0, :8] = [0.0, -0.0, 1e-30, -1e-30, 2, -2, 3, -3]
    bits = pack_bits(rows)
    assert bits.dtype == np.uint8
    assert bits[0, 0] == 0b11101010  # 0 and -0 give 1
    np.testing.assert_array_equal(bits, np.packbits(rows >= 0, axis=1))
    # A half has the same sign; the length of a vector does not count.
    np.testing.assert_array_equal(pack_bits(1000 * rows[1:].astype("f2")), bits[1:])


def test_sign_vectors_are_unit_vectors_of_the_signs():
    rows = draw(4, 16)
    expected = np.where(rows >= 0, 1, -1) / 4
    np.testing.assert_array_equal(sign_vectors(pack_bits(rows)), expected)


# Whole words and parts of one; several chunks of queries, and blocks of rows.
@pytest.mark.parametrize(
    ("length", "rows", "queries", "k"),
    [(512, 9000, 3, 20), (72, 300, QUERY_CHUNK + 5, 7), (8, 40, 2, 40), (8448, 50, 4, 50)],
)
def test_the_search_is_faisss_by_distance_and_then_by_index(length, rows, queries, k):
    database, asked = pack_bits(draw(rows, length)), pack_bits(draw(queries, length, 1))
    found = search(database, asked, k)
    index = faiss.IndexBinaryFlat(length)
    index.add(database)
    distances, _ = index.search(asked, k)
    # Rounded once to float32; neighbouring similarities are 2 / 8448 = 2.4e-4 apart and more.
    np.testing.assert_array_equal(found.similarities, (1 - 2 * distances / length).astype("f4"))
    # faiss leaves open which of equal rows stand where: of these the first are ours.
    distances = np.stack([np.bitwise_count(database ^ one).sum(1, np.int64) for one in asked])
    expected = np.argsort(distances, axis=1, kind="stable")[:, :k]
    np.testing.assert_array_equal(found.indices, expected)


def test_copies_stand_in_their_order_also_across_blocks():
    one = pack_bits(draw(1, 64))
    database = np.repeat(one, 9000, axis=0)
    database[[5, 8000]] ^= 255
    found = search(database, one, 8)
    assert found.indices.tolist() == [[0, 1, 2, 3, 4, 6, 7, 8]]
    assert (found.similarities == 1).all()
    assert search(database, one ^ np.uint8(255), 2).indices.tolist() == [[5, 8000]]


def test_the_similarity_is_the_cosine_of_the_sign_vectors():
    database, asked = pack_bits(draw(30, 64)), pack_bits(draw(4, 64, 1))
    found = search(database, asked, 30)
    cosines = sign_vectors(asked) @ sign_vectors(database).T
    # Sums of 64 numbers of 1/64 in float32.
    np.testing.assert_allclose(
        found.similarities, np.take_along_axis(cosines, found.indices, axis=1), atol=1e-6
    )


def test_bits_and_numbers_are_told_apart():
    rows = draw(4, 16)
    bits, unit = pack_bits(rows), rows / np.linalg.norm(rows, axis=1, keepdims=True)
    for database, queries, words in (
        (bits, unit, "queries: found float32 .4, 16., expected packed bits, uint8 of .*images, 2"),
        (unit, bits, "database: found float32 .4, 16., expected packed bits"),
        (bits, bits[:, :1], "queries: found uint8 .4, 1., expected packed bits, uint8 .*, 2"),
        (bits, bits[:0], "queries: found uint8 .0, 2., expected"),
    ):
        with pytest.raises(InputError, match=f"^{words}"):
            search(database, queries, 1)
    with pytest.raises(InputError, match=r"^database: found packed bits .uint8., expected"):
        to_unit_vectors(bits, bits)
    with pytest.raises(InputError, match=r"^descriptors: found 12 dimensions, expected a multiple"):
        pack_bits(draw(2, 12))
    rows[2, 3] = np.nan
    with pytest.raises(InputError, match=r"^descriptors: row 2 is not finite"):
        pack_bits(rows)
