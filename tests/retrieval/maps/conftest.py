"""A map of the town's database, and questions to it."""

import pathlib

import pytest

import crisalad_jax.retrieval.maps.build
from crisalad_jax.nn.model import Crisalad, Model
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answers, query
from tests.conftest import MODEL, read_options


@pytest.fixture(scope="session")
def town_map(shared, params, sides, tmp_path_factory) -> pathlib.Path:
    """Of the database, in segments of four and three images; to read only."""
    out, weights = tmp_path_factory.mktemp("maps") / "map", shared / "weights.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crisalad_jax.retrieval.maps.build, "SEGMENT", 4)
        index(Model(params, MODEL), sides[0], out, weights=weights, **read_options({}))
    return out


def ask(folder: pathlib.Path, params: Crisalad, images, **options) -> Answers:
    """Query a map, quietly, with its model."""
    with Map.open(folder) as places:
        return query(places, images, model=Model(params, places.config), **read_options(options))


@pytest.fixture(scope="session")
def milvus_server(tmp_path_factory):
    # pymilvus ends other handlers of logs: pytest's capture with absl's, as pytest reads this file.
    from tests.retrieval.maps.milvus_server import Server

    server = Server(tmp_path_factory.mktemp("milvus"))
    yield server
    server.kill()
