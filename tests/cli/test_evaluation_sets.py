"""The flags by which `evaluate` and `train` open evaluation sets."""

import json
import pathlib

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import BATCH, fails, succeeds, train
from tests.conftest import write_picture


@pytest.fixture
def streets(tmp_path: pathlib.Path) -> pathlib.Path:
    """Two plain folders of three frames each."""
    for part in ("database", "queries"):
        for i in range(3):
            write_picture(tmp_path / "streets" / part / f"{i}.jpg", seed=i, noise=10.0)
    return tmp_path / "streets"


def test_without_ground_truth_there_is_nothing_to_score(capfd, tmp_path, shared, streets, weights):
    words = (f"crisalad: {streets}: streets (two folders, no ground truth): no ground truth, no",)
    out = tmp_path / "out"
    fails(capfd, "evaluate", "--weights", weights, "--data", streets, "--out", out, words=words)
    fails(capfd, *train(shared, shared / "city", out, "--val", streets), words=words)
    assert not out.exists()


def test_flags_reach_the_reader(capfd, tmp_path, shared, streets, weights):
    """A frame matches itself, so a table is written; the other flags are told by their errors."""
    start = ("evaluate", "--weights", weights, "--quiet")
    out = succeeds(
        capfd,
        *(*start, "--data", streets, "--frames", "0", "--batch-size", BATCH),
        *("--grouping", "single", "--json", tmp_path / "t.json"),
    )
    name = "streets (two folders, +-0 frames)"
    assert f"{name}: 3 queries, 3 database images; positive: at most 0 frames apart" in out
    assert json.loads((tmp_path / "t.json").read_text())["benchmark"] == name
    town = (*start, "--data", shared / "town")
    for flag, value in (("--frames", "2"), ("--max-heading-difference", "40.0"), ("--images", "a")):
        option = flag[2:].replace("-", "_")
        words = (f"/town: found {option} for the layout utm, which takes split, radius",)
        fails(capfd, *town, flag, value, words=words)
    words = ("test: found database/, queries/, expected a folder queries_night",)
    fails(capfd, *town, "--queries", "queries_night", words=words)
    words = (f"{streets}/database/0.jpg: found no coordinates",)
    fails(capfd, *start, "--data", streets, "--layout", "utm", words=words)
    fails(capfd, *town, "--layout", "netflad", words=("layout: found 'netflad', expected one of",))


def test_validation_by_lists(capfd, tmp_path, shared, benchmark, monkeypatch):
    """The lists lie elsewhere than the images, as in a checkout of GSV-Cities."""
    root = benchmark.root
    for kind, paths in (("dbImages", benchmark.database), ("qImages", benchmark.queries)):
        names = [path.relative_to(root).as_posix() for path in paths]
        np.save(tmp_path / f"town_{kind}.npy", np.array(names))
    truth = np.empty(len(benchmark.queries), object)
    truth[:] = [found.tolist() for found in benchmark.ground_truth()]
    np.save(tmp_path / "town_gt.npy", truth, allow_pickle=True)
    lists, out = tmp_path / "town_dbImages.npy", tmp_path / "run"
    start = train(shared, shared / "city", out)
    words = (f"crisalad: {lists}: found 7 of 7 images missing, expected", "(--images)")
    fails(capfd, *start, "--val", lists, words=words)
    words = ("--val-images: found no --val",)
    fails(capfd, *start, "--val-images", root, words=words)
    assert not out.exists()

    def handed_on(*_, validation: Benchmark, **__):
        assert validation.database == benchmark.database
        assert validation.queries == benchmark.queries
        raise InputError(f"enough of {validation.name}")

    monkeypatch.setattr("crisalad_jax.experiments.train.fit", handed_on)
    words = ("crisalad: enough of town (SALAD's lists)",)
    fails(capfd, *start, "--val", lists, "--val-images", root, words=words)
