"""The study of sequences on frames whose answers are known."""

import pathlib
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import Benchmark


@pytest.fixture
def study(scripts: Any) -> ModuleType:
    return scripts("study_sequence")


def test_what_the_filter_gains_is_measured(study: ModuleType) -> None:
    """Of ten places two are alike: alone, the frame at the second is taken for the first."""
    database = np.eye(10)
    database[7] = database[2]
    names = tuple(pathlib.Path(f"{number}.jpg") for number in range(10))
    positives = tuple(np.array([number]) for number in range(10))
    benchmark = Benchmark("twins", pathlib.Path(), names, names, positives, "the same number")
    found = study.measure(benchmark, (database, database))
    assert found["single frames"] == 90
    assert found["filter, no adapt"] == 100
    # All frames are equally similar to their best: the first four stand for the surest 40 %.
    assert found["single frames, surest"] == 100
    assert set(study.FILTERS) < set(found)
    table = study.study([], []).table
    assert {*found, "gain"} == set(table.header[2:])
