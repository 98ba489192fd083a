"""`crisalad pca`, and `extract --pca`."""

import hashlib
import json
import pathlib
import shutil

import ml_dtypes
import numpy as np
import pytest

from crisalad_jax.retrieval.pca import PcaConfig, fit_pca, load_pca, save_pca
from crisalad_jax.utils.files import write_json
from tests.cli.test_cli import extract, fails, succeeds

DESCRIPTORS = np.random.default_rng(0).standard_normal((60, 48)).astype(np.float32)


def record(path: pathlib.Path) -> None:
    """Write the digest of descriptors beside them: a note tells of those that have none."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    write_json(path.with_name(f"{path.name}.json"), {"files": {"descriptors": digest}})


@pytest.mark.parametrize("kind", [np.float32, np.float16, ml_dtypes.bfloat16])
def test_what_is_fitted_is_written(capfd, tmp_path, kind):
    rows = DESCRIPTORS.astype(kind)
    np.save(tmp_path / "d.npy", rows)
    record(tmp_path / "d.npy")
    path = tmp_path / "new" / "pca.safetensors"
    out = succeeds(
        capfd,
        *("pca", "--descriptors", tmp_path / "d.npy", "--dim", 7, "--out", path, "--whiten"),
        *("--no-renormalise", "--samples", 50, "--seed", 4, "--quiet"),
    )
    expected = fit_pca(rows, 7, PcaConfig(whiten=True, renormalise=False), samples=50, seed=4)
    found = load_pca(path)
    assert found.config == expected.config
    for a, b in zip(found[:4], expected[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    share = f"{100 * expected.kept:.1f} %"
    assert out == f"{path}: 7 of 48 components, {share} of the variance of 50 descriptors"


def test_extract_writes_shorter_descriptors(capfd, tmp_path, shared):
    town, components = shared / "town", tmp_path / "pca.safetensors"
    succeeds(capfd, *extract(shared, town, tmp_path / "d.npy"))
    whole = np.load(tmp_path / "d.npy")
    fitted = fit_pca(whole, 5)
    save_pca(components, fitted)
    out = succeeds(capfd, *extract(shared, town, tmp_path / "s.npy", "--pca", components))
    assert "12 descriptors of 5 dimensions" in out
    np.testing.assert_array_equal(np.load(tmp_path / "s.npy"), fitted.apply(whole))
    config = json.loads((tmp_path / "s.npy.json").read_text())
    assert config["pca"] == str(components)


def test_evaluate_ranks_shorter_descriptors(capfd, tmp_path, shared, benchmark):
    town, weights = shared / "town", shared / "weights.safetensors"
    succeeds(capfd, *extract(shared, town, tmp_path / "d.npy"))
    whole, names = np.load(tmp_path / "d.npy"), (tmp_path / "d.names.txt").read_text().split()
    fitted, components = fit_pca(whole, 3), tmp_path / "pca.safetensors"
    start = ("evaluate", "--data", town, "--weights", weights, "--grouping", "single", "--quiet")

    def sides(fitted):
        save_pca(components, fitted)
        rows = dict(zip(names, fitted.apply(whole), strict=True))
        for paths in (benchmark.database, benchmark.queries):
            yield np.stack([rows[path.relative_to(town).as_posix()] for path in paths])

    def check(best, *more):
        succeeds(capfd, *start, *more, "--json", tmp_path / "found.json")
        (result,) = json.loads((tmp_path / "found.json").read_text())["results"]
        right = [index in wanted for index, wanted in zip(best, benchmark.positives, strict=True)]
        assert result["recalls"]["R@1"] == np.mean(right)

    database, queries = sides(fitted)
    check((queries @ database.T).argmax(axis=1), "--pca", components)
    # Of their own lengths, components rank by Euclidean distance, as in CricaVPR.
    database, queries = sides(fit_pca(whole, 3, PcaConfig(renormalise=False)))
    best = np.linalg.norm(queries[:, None] - database, axis=2).argmin(axis=1)
    check(best, "--pca", components)


def test_components_become_the_last_layer_of_a_model(capfd, tmp_path, shared, weights):
    town, model = shared / "town", tmp_path / "model.safetensors"
    succeeds(capfd, *extract(shared, town, tmp_path / "d.npy"))
    whole = np.load(tmp_path / "d.npy")
    fit = ("pca", "--descriptors", tmp_path / "d.npy", "--weights", weights)
    succeeds(capfd, *fit, "--whiten", "--dim", 4, "--out", model, "--quiet")
    out = ("extract", "--images", town, "--weights", model, "--out", tmp_path / "s.npy")
    succeeds(capfd, *out, "--grouping", "single", "--quiet")
    expected = fit_pca(whole, 4, PcaConfig(whiten=True)).apply(whole)
    # Unit vectors of float32: whitening divides by small deviations.
    np.testing.assert_allclose(np.load(tmp_path / "s.npy"), expected, atol=1e-4, rtol=0)

    again = (*fit[:-1], model, "--dim", 2, "--out", tmp_path / "twice.safetensors", "--quiet")
    fails(capfd, *again, words=(f"{model}: found a model with a projection to 4 dimensions",))
    plain = tmp_path / "plain.safetensors"
    succeeds(capfd, *fit, "--no-renormalise", "--dim", 4, "--out", plain, "--quiet")
    index = ("index", "--images", town, "--weights", plain, "--out", tmp_path / "map", "--quiet")
    fails(capfd, *index, words=(f"{plain}: found descriptors that are not normalised",))
    assert not (tmp_path / "map").exists()


def test_bad_input_is_named_before_any_work(capfd, tmp_path, shared, weights):
    save_pca(tmp_path / "long.safetensors", fit_pca(np.pad(DESCRIPTORS, ((0, 0), (0, 2))), 5))
    for components, words in (
        (tmp_path / "none", (f"{tmp_path / 'none'}: found no such file",)),
        (weights, (f"{weights}: found metadata", "as `crisalad pca` writes it")),
        (tmp_path / "long.safetensors", (f"{weights}: found descriptors of length 48", "50")),
    ):
        start = extract(shared, shared / "no-folder", tmp_path / "d.npy", "--pca", components)
        fails(capfd, *start, words=words)

    for name, rows in (("d", DESCRIPTORS), ("i", DESCRIPTORS.astype(np.int8))):
        np.save(tmp_path / f"{name}.npy", rows)
        record(tmp_path / f"{name}.npy")
    (tmp_path / "cut.npy").write_bytes((tmp_path / "d.npy").read_bytes()[:500])
    record(tmp_path / "cut.npy")
    shutil.copy(tmp_path / "d.npy.json", tmp_path / "changed.npy.json")
    np.save(tmp_path / "changed.npy", -DESCRIPTORS)
    for name, more, words in (
        ("d.npy", ("--dim", 49), ("dim: found 49, expected 1 to 48",)),
        ("d.npy", ("--seed", -3, "--samples", 50), ("seed: found -3, expected at least 0",)),
        ("d.npy", ("--out", "pca.npy"), ("pca.npy: found the suffix '.npy', expected .safe",)),
        ("none.npy", (), ("none.npy: found no such file, expected a .npy file",)),
        ("i.npy", (), ("i.npy: found int8, expected an array of floating-point numbers",)),
        ("cut.npy", (), ("cut.npy: not a whole .npy file",)),
        ("changed.npy", (), ("changed.npy: found other bytes than changed.npy.json says",)),
    ):
        given = ("pca", "--descriptors", tmp_path / name, "--out", tmp_path / "p.safetensors")
        fails(capfd, *given, "--dim", 5, *more, words=words)
    assert not (tmp_path / "p.safetensors").exists()
