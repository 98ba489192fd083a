"""Maps by components, and with an approximate search."""

import json
import pathlib

import numpy as np
import pytest

from crisalad_jax.data.images import list_images
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval import faiss_index
from crisalad_jax.retrieval.maps import approximate
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.approximate import choose_search
from crisalad_jax.retrieval.maps.build import Indexed, index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import query
from crisalad_jax.retrieval.maps.removed import Removed
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.pca import fit_pca, save_pca
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import MODEL, describe_single, read_options
from tests.killed_appends import append_until, metadata, names, rows
from tests.retrieval.maps.test_stores import brute_force

ROOT = pathlib.Path(__file__).parents[3]
QUERIES = rows(1000, 5)


@pytest.fixture(scope="module")
def database(shared) -> pathlib.Path:
    return shared / "town" / "images" / "test" / "database"


@pytest.fixture(scope="module")
def whole(shared, params, database, tmp_path_factory) -> pathlib.Path:
    """A map that one process made."""
    folder = tmp_path_factory.mktemp("whole") / "map"
    run(shared, params, database, folder)
    return folder


def run(shared, params, images, out, **options) -> Indexed:
    weights = shared / "weights.safetensors"
    return index(Model(params, MODEL), images, out, weights=weights, **read_options(options))


def contents(folder: pathlib.Path) -> tuple[list, bytes]:
    """Images and descriptors of a map."""
    with Map.open(folder) as places:
        return places.images, np.concatenate(list(places.descriptors)).tobytes()


# Components


def test_a_map_of_components_shortens_queries_too(shared, params, database, whole, tmp_path):
    with Map.open(whole) as places:
        full = np.concatenate(list(places.descriptors))
    fitted, file, out = fit_pca(full, 3), tmp_path / "pca.safetensors", tmp_path / "map"
    save_pca(file, fitted)
    run(shared, params, database, out, pca=file)
    file.unlink()
    run(shared, params, database, out)  # the map has a copy
    value = json.loads((out / "map.json").read_text())
    assert (value["format"], value["descriptor_length"]) == (4, 3)
    queries = list_images(shared / "town" / "images" / "test" / "queries")
    asked = describe_single(Model(params, MODEL), queries)
    with Map.open(out) as places:
        stored = np.concatenate(list(places.descriptors))
        # Products of other shapes round otherwise, by some units in the last place.
        np.testing.assert_allclose(stored, fitted.apply(full), atol=1e-5)
        answers = query(places, queries, k=3, **read_options({}))
    expected = brute_force(fitted.apply(full), fitted.apply(asked), 3)
    np.testing.assert_array_equal(answers.neighbours.indices, expected)
    other = fit_pca(full, 2)
    with pytest.raises(InputError, match=r"found components [0-9a-f]{12}, expected [0-9a-f]{12}"):
        run(shared, params, database, out, pca=other)
    with pytest.raises(InputError, match=r"components [0-9a-f]{12}, expected none as in the map"):
        run(shared, params, database, whole, pca=other)
    save_pca(out / "pca.safetensors", other)
    with pytest.raises(InputError, match=r"pca\.safetensors: found other components"):
        Map.open(out)


# Approximate search


@pytest.fixture
def grown(tmp_path) -> pathlib.Path:
    append_until(tmp_path / "map", 40)
    return tmp_path / "map"


def build(folder: pathlib.Path, kind: str) -> float | None:
    with open_for_appending(folder, metadata("files")) as target:
        return target.build_search(kind)


def test_a_graph_answers_and_ranks_exactly(grown):
    """Of 40 descriptors a graph finds all, so that the answer is that of brute force."""
    assert build(grown, "hnsw") == 1.0
    with Map.open(grown) as places:
        assert places.summary()["search"] == "hnsw"
        found, exact = places.search(QUERIES, 3), places.search(QUERIES, 3, exact=True)
        every = places.search(QUERIES, 100)
    np.testing.assert_array_equal(found.indices, brute_force(rows(0, 40), QUERIES, 3))
    np.testing.assert_array_equal(found.indices, exact.indices)
    np.testing.assert_array_equal(found.similarities, exact.similarities)
    assert sorted(every.indices[0]) == list(range(40))


def test_candidates_come_from_the_index(grown, monkeypatch):
    """An index that finds some alone is asked; where it finds too few, the search is exact."""
    build(grown, "hnsw")
    with Map.open(grown) as places:
        approximate = places._approximate
        assert approximate is not None

        def poor(queries, k, count, removed):
            numbers = np.full((len(queries), k), -1)
            numbers[:, :2] = 7, 3
            return Neighbours(numbers, np.zeros(numbers.shape, np.float32))

        places._approximate = approximate._replace(ask=poor)
        found = places.search(QUERIES, 2)
        assert {tuple(sorted(row)) for row in found.indices.tolist()} == {(3, 7)}
        products = QUERIES.astype(np.float64) @ rows(0, 40)[[3, 7]].T.astype(np.float64)
        # Sums in float64, rounded to float32 once.
        np.testing.assert_allclose(found.similarities, -np.sort(-products), rtol=1e-7)
        np.testing.assert_array_equal(
            places.search(QUERIES, 3).indices, places.search(QUERIES, 3, exact=True).indices
        )


@pytest.mark.parametrize(("is_served", "expected"), [(False, 20), (True, 16)])
def test_more_candidates_take_the_place_of_what_was_removed(is_served, expected, grown):
    """A graph is asked for 16 at least, of 40; of 32 that are left it looks at a quarter more. A
    server looks among what is left by itself."""
    build(grown, "hnsw")
    asked = []
    with Map.open(grown) as places:
        approximate = places._approximate

        def ask(queries, k, count, removed):
            asked.append(k)
            return approximate.ask(queries, k, count, removed)

        counted = approximate._replace(ask=ask, is_served=is_served)
        counted.search(QUERIES, 3, 40, Removed(np.arange(8)))
    assert asked == [expected]


@pytest.mark.parametrize("kind", ["hnsw", "ivf-rabitq"])
@pytest.mark.filterwarnings("error::crisalad_jax.utils.output.Note")
def test_a_map_that_grew_is_searched_exactly(kind, grown, monkeypatch):
    """Until the same command adds the new images to the index, which is not built again."""
    build(grown, kind)
    with open_for_appending(grown, metadata("files")) as target:
        target.append(names(40, 1), [7], rows(40, 1), root="/images")
    with pytest.warns(Note, match=f"exactly; `crisalad index --search {kind}` builds it"):
        opened = Map.open(grown)
    with opened as places:
        assert (places.search_kind, places.stale_search) == ("exact", kind)
        assert places.summary()["stale_search"] == kind
        for exact in (False, True):
            assert places.search(rows(40, 1), 1, exact=exact).indices.tolist() == [[40]]
    monkeypatch.setattr(faiss_index, "build", None)
    assert build(grown, kind) == 1.0
    assert len(list((grown / "approximate").glob("*.index"))) == 1
    with Map.open(grown) as places:
        assert places.search(rows(40, 1), 1).indices.tolist() == [[40]]
        assert (places.search_kind, places.stale_search) == (kind, None)
    assert build(grown, "exact") is None
    assert not (grown / "approximate").exists()


def test_a_damaged_index_is_one_line(grown):
    build(grown, "hnsw")
    (path,) = (grown / "approximate").glob("*.index")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"\.index: found other bytes"):
        Map.open(grown)


def test_an_index_of_many_fewer_images_is_built_again(grown, monkeypatch):
    """Of 40 images there is one list, and of 140 there are 3, by 39 for each."""
    build(grown, "ivf-rabitq")
    with open_for_appending(grown, metadata("files")) as target:
        target.append(names(40, 100), [7] * 100, rows(40, 100), root="/images")
    built = []
    make = faiss_index.build
    monkeypatch.setattr(faiss_index, "build", lambda *a, **b: built.append(a) or make(*a, **b))
    build(grown, "ivf-rabitq")
    assert len(built) == 1


def test_what_is_searched_how_is_chosen_by_size_and_memory(grown, monkeypatch):
    """A graph of a descriptor of 512 numbers takes 2,048 + 272 bytes, by hand."""
    free = 2 * 10**9
    monkeypatch.setattr(approximate, "available_memory", lambda: free)
    for count, dtype, kind in (
        (65_536, "float16", "exact"),  # 2^26 bytes
        (65_537, "float16", "hnsw"),
        (32_769, "float32", "hnsw"),
        (215_517, "float16", "hnsw"),  # 0.5 GB / 2,320
        (215_518, "float16", "ivf-rabitq"),
        (10**8, "bits", "exact"),
    ):
        assert choose_search(count, 512, dtype)[0] == kind
    said = "a graph in memory takes 2.32 GB, of 0.50 GB at most (2.0 GB available)"
    assert choose_search(10**6, 512, "float16") == ("ivf-rabitq", said)
    free = 10**12
    assert choose_search(462_819, 512, "float16")[0] == "hnsw"  # 1 GiB / 2,320
    assert choose_search(462_820, 512, "float16")[0] == "ivf-rabitq"
    with pytest.warns(Note, match="map: --search auto takes exact: a query reads 0.0 MB"):
        assert build(grown, "auto") is None
    free = 10**6
    monkeypatch.setattr(approximate, "_EXACT_BYTES", 0)
    with pytest.warns(Note, match="map: --search auto takes hnsw: a graph in memory"):
        assert build(grown, "auto") == 1.0


def test_what_cannot_be_built(grown, shared, params, database, tmp_path):
    with pytest.raises(InputError, match="search: found 'tree'"):
        run(shared, params, database, tmp_path / "new", search="tree")
    store = f"milvus:{tmp_path / 'new' / 'rows.db'}"
    for kind, where in (("ivf-pq", store), ("diskann", "files")):
        with pytest.raises(InputError, match=f"search: found '{kind}', expected one of "):
            run(shared, params, database, tmp_path / "new", search=kind, store=where)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_codes_find_most_neighbours(tmp_path):
    """Twenty views each of 500 places: the neighbours of a view are those of its place."""
    generator = np.random.default_rng(0)
    centres = generator.standard_normal((500, 48)).astype(np.float32)
    views = centres[np.repeat(np.arange(500), 20)]
    views += 0.3 * generator.standard_normal(views.shape).astype(np.float32)
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    with open_for_appending(tmp_path / "map", metadata("files")) as target:
        for start in range(0, len(views), 1000):
            part = views[start : start + 1000]
            target.append(names(start, len(part)), [7] * len(part), part, root="/images")
        recall = target.build_search("ivf-rabitq")
        assert recall is not None
        assert recall > 0.9  # measured 1.0: ten of 19 views, of 100 candidates
        found = target.search(views[:50], 10)
        exact = target.search(views[:50], 10, exact=True)
    assert (found.similarities[:, 0] == exact.similarities[:, 0]).mean() > 0.95


def test_the_command_line_says_what_is_recalled(shared, database, tmp_path, capfd):
    from tests.cli.test_cli import succeeds
    from tests.cli.test_index import index as command
    from tests.cli.test_index import query as ask

    out = tmp_path / "map"
    said = succeeds(capfd, *command(shared, database, out, "--search", "hnsw"))
    assert "7 images added, 7 with positions" in said
    assert "approximate search finds 100.0 % of the exact 10 nearest of 7 images" in said
    lines = [
        succeeds(capfd, *ask(out, list_images(database)[0], "--json", "-", *more))
        for more in ((), ("--exact",))
    ]
    assert lines[0] == lines[1]
