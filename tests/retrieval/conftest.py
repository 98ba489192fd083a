"""The town's images, for maps and their service."""

import pathlib

import pytest


@pytest.fixture(scope="session")
def sides(shared) -> tuple[pathlib.Path, pathlib.Path]:
    """The town's database and queries."""
    images = shared / "town" / "images" / "test"
    return images / "database", images / "queries"
