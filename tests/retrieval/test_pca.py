"""Principal components against numpy's singular values, and what they are defined by."""

import dataclasses

import numpy as np
import pytest
import safetensors.numpy

from crisalad_jax.checkpoints.safetensors_io import write_sealed
from crisalad_jax.retrieval import pca
from crisalad_jax.retrieval.pca import (
    PcaConfig,
    fit_pca,
    load_pca,
    project_to_plane,
    save_pca,
)
from crisalad_jax.utils.errors import InputError

PLAIN = PcaConfig(renormalise=False)


def _descriptors(count: int, length: int, seed: int = 0) -> np.ndarray:
    """Of variances that fall from one direction to the next, none of them along an axis, about a
    mean that is far from zero."""
    generator = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(generator.standard_normal((length, length)))
    scales = np.linspace(2, 0.2, length)
    rows = generator.standard_normal((count, length)) * scales @ turn + 5
    return rows.astype(np.float32)


def _by_svd(rows: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    wide = rows.astype(np.float64)
    _, values, vectors = np.linalg.svd(wide - wide.mean(axis=0), full_matrices=False)
    vectors = vectors[:dim]
    places = np.abs(vectors).argmax(axis=1)
    signs = np.sign(vectors[np.arange(dim), places])
    return vectors * signs[:, None], values[:dim] ** 2 / (len(rows) - 1)


@pytest.mark.parametrize(("count", "length"), [(400, 24), (24, 24), (25, 24), (17, 40)])
def test_components_are_numpys_singular_vectors(count, length, monkeypatch):
    monkeypatch.setattr(pca, "_CHUNK_BYTES", 8 * length * 60)  # 60 rows at a time
    rows = _descriptors(count, length)
    found = fit_pca(rows, 9)
    components, variances = _by_svd(rows, 9)
    # float32 holds 7 digits; neighbouring variances differ by a few percent at least, which makes
    # no more than some hundred of float64's roundings.
    np.testing.assert_allclose(found.components, components, atol=2e-7, rtol=0)
    np.testing.assert_allclose(found.variances, variances, rtol=2e-7)
    np.testing.assert_allclose(found.mean, rows.mean(axis=0, dtype=np.float64), rtol=2e-7)
    whole = rows.astype(np.float64).var(axis=0, ddof=1).sum()
    assert found.kept == pytest.approx(variances.sum() / whole, rel=1e-6)
    assert found.components.dtype == found.mean.dtype == np.float32


def test_a_plane_is_that_of_numpys_first_two_singular_vectors():
    rows = _descriptors(60, 20)
    found = project_to_plane(rows)
    components, variances = _by_svd(rows, 2)
    expected = (rows - rows.mean(axis=0, dtype=np.float64)) @ components.T
    # Sums of 20 products up to 4 in float32, of numbers about 5.
    np.testing.assert_allclose(found.positions, expected, atol=1e-5, rtol=0)
    whole = rows.astype(np.float64).var(axis=0, ddof=1).sum()
    np.testing.assert_allclose(found.shares, variances / whole, rtol=1e-6)
    with pytest.raises(InputError, match="dim: found 2, expected 1 to 1"):
        project_to_plane(rows[:2])


def test_reduced_descriptors_are_coordinates_about_the_mean():
    rows, more = _descriptors(300, 20), _descriptors(70, 20, seed=1)
    found = fit_pca(rows, 6, PLAIN)
    components, _ = _by_svd(rows, 6)
    expected = (more - rows.mean(axis=0, dtype=np.float64)) @ components.T
    # Sums of 20 products up to 4 in float32, of numbers about 5.
    np.testing.assert_allclose(found.apply(more), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [500, 15])
def test_whitened_descriptors_have_the_identity_as_covariance(count):
    rows = _descriptors(count, 16)
    reduced = fit_pca(rows, 10, PcaConfig(whiten=True, renormalise=False)).apply(rows)
    # float32 coordinates, of which as many as there are rows are summed.
    np.testing.assert_allclose(np.cov(reduced, rowvar=False), np.eye(10), atol=2e-5)
    np.testing.assert_allclose(reduced.mean(axis=0), 0, atol=2e-5)


@pytest.mark.parametrize("whiten", [False, True])
def test_renormalised_descriptors_are_the_same_directions(whiten):
    rows = _descriptors(200, 16)
    whole = fit_pca(rows, 8, PcaConfig(whiten=whiten))
    bare = whole._replace(config=dataclasses.replace(whole.config, renormalise=False)).apply(rows)
    expected = bare / np.linalg.norm(bare, axis=1, keepdims=True)
    np.testing.assert_allclose(whole.apply(rows), expected, atol=1e-7, rtol=0)  # one rounding


def test_a_sample_is_drawn_by_the_seed(tmp_path):
    np.save(tmp_path / "rows.npy", _descriptors(900, 10).astype(np.float16))
    rows = np.load(tmp_path / "rows.npy", mmap_mode="r")
    first, again, other = (fit_pca(rows, 4, samples=200, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.components, again.components)
    assert not np.array_equal(first.components, other.components)
    # By definition a sample's mean is that of some 200 rows, and none other than `seed` names.
    chosen = np.random.default_rng(1).choice(900, 200, replace=False)
    expected = rows[np.sort(chosen)].mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(first.mean, expected, rtol=1e-6)
    np.testing.assert_array_equal(
        fit_pca(rows, 4, samples=None).components, fit_pca(rows, 4, samples=5000).components
    )


def test_too_many_components_name_the_rank():
    rows = np.repeat(_descriptors(5, 12), 8, axis=0)
    for some, dim, words in (
        (rows, 6, "at most 4, the rank"),
        (rows[:10], 6, "at most 1, the rank"),
        (np.ones((20, 12), np.float32), 2, "at most 0, the rank"),
        (rows, 13, "1 to 12, .* 40 descriptors"),
        (_descriptors(12, 30), 12, "1 to 11"),
        (rows, 0, "at least 1"),
        (rows, 2.5, "a whole number of at least 1"),
    ):
        with pytest.raises(InputError, match=f"^dim: found {dim}, expected {words}"):
            fit_pca(some, dim)


def test_bad_descriptors_are_named():
    rows = _descriptors(30, 12)
    found, broken = fit_pca(rows, 3), rows.copy()
    assert np.isnan(found.apply(np.stack([rows[0], found.mean]))[1]).all()
    broken[17, 3] = np.nan
    not_finite = "^descriptors: row 17 is not finite, expected finite"
    for call, words in (
        (lambda: fit_pca(rows[:1], 1), "^dim: found 1, expected 1 to 0, the highest rank"),
        (lambda: fit_pca(rows[:, 0], 1), r"^descriptors: found shape \(30,\)"),
        (
            lambda: fit_pca(rows, 1, samples=20, seed=-3),
            "^seed: found -3, expected at least 0, and",
        ),
        (lambda: found.apply(rows[:, :5]), r"found shape \(30, 5\), expected \(images, 12"),
        (lambda: fit_pca(broken, 3), not_finite),
        (lambda: found.apply(broken), not_finite),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_what_is_saved_comes_back(tmp_path):
    config = PcaConfig(whiten=True, renormalise=False)
    found = fit_pca(_descriptors(30, 12), 5, config, model="ab12")
    path = tmp_path / "new" / "pca.safetensors"
    save_pca(path, found)
    again = load_pca(path)
    assert (again.config, again.model) == (found.config, "ab12")
    for a, b in zip(again[:4], found[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    assert [one.name for one in path.parent.iterdir()] == ["pca.safetensors"]


def test_files_of_something_else_are_named(tmp_path):
    found = fit_pca(_descriptors(30, 12), 5)
    path = tmp_path / "pca.safetensors"
    with pytest.raises(InputError, match=r"pca\.safetensors: found no such file"):
        load_pca(path)
    safetensors.numpy.save_file({"mean": np.zeros(3, np.float32)}, path)
    with pytest.raises(InputError, match=r"found metadata \[\], expected .*'crisalad-jax pca 2'"):
        load_pca(path)
    write_sealed(path, {}, "crisalad-jax pca 1", {"config": {}})
    with pytest.raises(InputError, match=r"^\S+pca\.safetensors: found .*'crisalad-jax pca 1'"):
        load_pca(path)
    for changes in (
        {"mean": found.mean[:7]},
        {"mean": np.full(12, np.nan, np.float32)},
        {"mean": found.mean.astype(np.float64)},
    ):
        save_pca(path, found._replace(**changes))
        with pytest.raises(InputError, match=r"expected {'mean': .*} of finite float32"):
            load_pca(path)
    save_pca(path, found)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"pca\.safetensors: not a whole safetensors file"):
        load_pca(path)


def test_components_that_changed_are_refused_unless_they_are_not_verified(tmp_path):
    found, path = fit_pca(_descriptors(30, 12), 5), tmp_path / "pca.safetensors"
    save_pca(path, found)
    data = bytearray(path.read_bytes())
    place = bytes(data).index(found.mean.tobytes())
    data[place] ^= 1  # the last bit of a number's fraction
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"pca\.safetensors: found other bytes than were written"):
        load_pca(path)
    again = load_pca(path, verify=False)
    assert again.mean[0] != found.mean[0]
    np.testing.assert_array_equal(again.components, found.components)
