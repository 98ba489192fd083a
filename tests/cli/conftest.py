"""What several tests of the command line read: the town's two sides, and a map of one."""

import pathlib
import shutil

import pytest

from crisalad_jax.cli import main
from tests.conftest import BATCH


@pytest.fixture(scope="session")
def database(shared) -> pathlib.Path:
    return shared / "town" / "images" / "test" / "database"


@pytest.fixture(scope="session")
def queries(shared) -> pathlib.Path:
    return shared / "town" / "images" / "test" / "queries"


@pytest.fixture(scope="session")
def weights(shared) -> pathlib.Path:
    return shared / "weights.safetensors"


@pytest.fixture(scope="session")
def town_map(weights, database, tmp_path_factory) -> pathlib.Path:
    """A map of the town's database that no test changes."""
    out = tmp_path_factory.mktemp("town") / "map"
    given = ("index", "--weights", weights, "--images", database)
    assert main([*map(str, given), "--out", str(out), "--batch-size", str(BATCH), "--quiet"]) == 0
    return out


@pytest.fixture
def folder(town_map, tmp_path) -> pathlib.Path:
    """A map of the town's database that the test may change."""
    return shutil.copytree(town_map, tmp_path / "map")
