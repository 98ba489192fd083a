"""A preset as small as the other tests' model, and comparisons of it that were carried out."""

import pathlib
from typing import Any

import pytest

from crisalad_jax.comparison import ComparisonConfig
from crisalad_jax.config import PRESETS
from tests.conftest import BATCH, MODEL


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """`tiny` is smaller here."""
    monkeypatch.setitem(PRESETS, "tiny", MODEL)  # type: ignore[arg-type]


@pytest.fixture
def flags(shared: pathlib.Path) -> tuple[object, ...]:
    """Of a comparison of CriSALAD alone, by two seeds of two epochs."""
    return (
        *("compare", "--methods", "crisalad", "--preset", "tiny", "--seeds", 2, "--epochs", 2),
        *("--train", shared / "city", "--test", shared / "town", "--batch-size", BATCH, "--quiet"),
    )


@pytest.fixture
def settings(shared: pathlib.Path) -> dict[str, Any]:
    """The same, for `ComparisonConfig`."""
    return {
        "kind": "compare",
        "names": ("crisalad",),
        "preset": "tiny",
        "seeds": 2,
        "epochs": 2,
        "train": str(shared / "city"),
        "test": (str(shared / "town"),),
        "batch_size": BATCH,
    }


@pytest.fixture
def config(settings: dict[str, Any]) -> ComparisonConfig:
    return ComparisonConfig(**settings)
