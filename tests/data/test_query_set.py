"""Training sets of queries, by positions, by cities of MSLS, and by a ground truth."""

import pathlib

import pytest

from crisalad_jax.data.query_set import read_query_set
from crisalad_jax.utils.errors import InputError
from tests.conftest import write_picture
from tests.data.benchmarks.test_msls import Image, write_msls
from tests.data.benchmarks.trees import write_sides


def write_street(root: pathlib.Path) -> pathlib.Path:
    """Ten places, 100 m apart, of two database images and a query each, with @UTM names."""
    for part, offsets in (("database", (0, 6)), ("queries", (3,))):
        for place in range(10):
            for offset in offsets:
                name = f"@{500_000 + 100 * place + offset:09.2f}@5000000.00@{part}@.jpg"
                seed = 900 + place
                write_picture(root / "images" / "train" / part / name, seed, noise=20.0)
    return root


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> pathlib.Path:
    return write_street(tmp_path_factory.mktemp("street"))


def test_query_sets_are_read_by_positions(street):
    found = read_query_set(street)
    assert (found.database, len(found.files)) == (20, 30)
    assert found.queries.tolist() == list(range(20, 30))
    assert [each.tolist() for each in found.positives] == [[2 * n, 2 * n + 1] for n in range(10)]
    assert [each.tolist() for each in found.near] == [[2 * n, 2 * n + 1] for n in range(10)]
    # 3.5 m reach both of a place's images; 103 m the first or both of the next as well.
    wide = read_query_set(street, positive_radius=3.5, negative_radius=97)
    assert wide.near[1].tolist() == [1, 2, 3, 4]
    assert wide.positives[1].tolist() == [2, 3]
    with pytest.raises(InputError, match="found 0 of 10 queries with a database image within 2 m"):
        read_query_set(street, positive_radius=2)
    with pytest.raises(InputError, match="and none of them with one farther than 5000 m"):
        read_query_set(street, negative_radius=5000)


def test_images_of_other_cities_are_no_positives(tmp_path):
    """Two cities of MSLS whose positions are alike, in other zones of UTM."""
    norths = {"query": (0, 500), "database": (3, 503, 900)}
    sides = {
        side: [Image(f"{side}{north}", 500_000, 4e6 + north, 0) for north in of_side]
        for side, of_side in norths.items()
    }
    write_msls(tmp_path, {"goa": sides, "tokyo": sides})
    found = read_query_set(tmp_path)
    assert [each.tolist() for each in found.positives] == [[0], [1], [3], [4]]
    assert [each.tolist() for each in found.near] == [[0], [1], [3], [4]]


def test_a_set_without_positions_goes_by_its_ground_truth(tmp_path):
    names = [f"{number}.jpg" for number in range(3)]
    write_sides(tmp_path, names, names)
    with pytest.raises(InputError, match="no ground truth, nothing to score"):
        read_query_set(tmp_path)
    table = "query,database\n0.jpg,1.jpg\n0.jpg,2.jpg\n1.jpg,\n2.jpg,0.jpg\n"
    (tmp_path / "ground_truth.csv").write_text(table)
    found = read_query_set(tmp_path)
    assert found.queries.tolist() == [3, 5]
    assert [each.tolist() for each in found.near] == [[1, 2], [0]]
