"""A preset as small as the other tests' model, and comparisons of it that were carried out."""

import dataclasses
import pathlib
from typing import Any

import pytest

from crisalad_jax.experiments.comparison import ComparisonConfig, methods, plan
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes import from_scratch
from tests.conftest import BATCH, MODEL, RECIPE


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """`tiny` is smaller here."""
    monkeypatch.setitem(PRESETS, "tiny", MODEL)  # type: ignore[arg-type]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches and steps of CriSALAD are those of RECIPE, whose program other tests compile too."""

    def as_recipe(config: TrainConfig) -> TrainConfig:
        return dataclasses.replace(
            from_scratch(config),
            optimiser=RECIPE.optimiser,
            places_per_batch=RECIPE.places_per_batch,
        )

    monkeypatch.setattr(plan, "_VIEWS", RECIPE.images_per_place)
    monkeypatch.setattr(methods, "from_scratch", as_recipe)


@pytest.fixture
def flags(shared: pathlib.Path) -> tuple[object, ...]:
    """Of a comparison of CriSALAD alone, by two seeds of three epochs."""
    return (
        *("compare", "--methods", "crisalad", "--preset", "tiny", "--seeds", 2, "--epochs", 3),
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
        "epochs": 3,
        "train": str(shared / "city"),
        "test": (str(shared / "town"),),
        "batch_size": BATCH,
    }


@pytest.fixture
def config(settings: dict[str, Any]) -> ComparisonConfig:
    return ComparisonConfig(**settings)
