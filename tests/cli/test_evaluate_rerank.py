"""`crisalad evaluate --rerank`."""

import json

import pytest

from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.nn.model import Model
from tests.cli.test_cli import fails, files_in, succeeds
from tests.conftest import BATCH, random_params
from tests.experiments.report.test_page import Page
from tests.retrieval.reranking.test_stage import TRANSVPR


@pytest.fixture
def weights(tmp_path):
    """Of a model that makes what TransVPR compares."""
    path = tmp_path / "transvpr.safetensors"
    save_weights(path, Model(random_params(TRANSVPR), TRANSVPR))
    return path


@pytest.mark.slow
def test_rows_come_in_pairs(capfd, tmp_path, shared, weights):
    out = succeeds(
        capfd,
        *("evaluate", "--data", shared / "town", "--weights", shared / "weights.safetensors"),
        *("--batch-size", BATCH, "--grouping", "single,sequential/single", "--quiet"),
        *("--rerank", "transvpr:3", "--rerank-weights", weights, "--json", tmp_path / "f.json"),
        *("--out", tmp_path / "out", "--report", tmp_path / "page"),
    )
    assert out.count("+ transvpr:3") == 3  # two rows, and the note
    found = json.loads((tmp_path / "f.json").read_text())
    assert (found["rerank"], found["rerank_weights"]) == ("transvpr:3", str(weights))
    rows = found["results"]
    assert [row["rerank"] for row in rows] == [None, "transvpr:3"] * 2
    for before, after in zip(rows[::2], rows[1::2], strict=True):
        assert after["recalls"]["R@5"] == before["recalls"]["R@5"]
        assert after["same_place"] == before["same_place"]
    names = ("single", "single_transvpr-3", "sequential-single", "sequential-single_transvpr-3")
    assert files_in(tmp_path / "out") - {"config.json"} == {f"gallery_{x}.png" for x in names}
    page = Page((tmp_path / "page" / "index.html").read_text(encoding="utf-8"))
    labels = [e["text"] for e in page.all("th", scope="row")]
    assert labels[:2] == ["single", "single + transvpr:3"]


def test_bad_input_is_named_before_any_work(capfd, shared, weights, monkeypatch):
    monkeypatch.setattr("crisalad_jax.evaluation.evaluate.TokenSet", None)
    own = shared / "weights.safetensors"
    start = ("evaluate", "--data", shared / "town", "--weights", own, "--quiet")
    nowhere = ("evaluate", "--data", shared / "none", "--weights", own, "--quiet")
    for given, words in (
        ((*nowhere, "--rerank", "transvpr"), ("found 'transvpr', expected NAME:TOPK",)),
        (
            (*nowhere, "--rerank", "glue:3"),
            ("'glue', expected one of fol, local, pair-vpr, ",),
        ),
        ((*start, "--rerank", "transvpr:3"), ("aggregator salad", "--rerank-weights")),
        ((*nowhere, "--rerank-weights", weights), ("--rerank-weights: found without --rerank",)),
        (
            (*start, "--rerank", "patch-netvlad:3", "--rerank-weights", weights),
            ("found a model with aggregator transvpr and size rule fixed, expected netvlad",),
        ),
        (
            (*start, "--rerank", "transvpr:8", "--rerank-weights", weights),
            ("found transvpr:8 over a database of 7 images, expected at most 7",),
        ),
    ):
        fails(capfd, *given, words=words)
