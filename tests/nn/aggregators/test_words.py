"""Hand-made features and their words against OpenCV, scikit-learn and counts by hand."""

import dataclasses
import pathlib

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sklearn.cluster

import crisalad_jax as cj
from crisalad_jax.data.images import read_image
from crisalad_jax.data.local_features import encode_local_features
from crisalad_jax.nn.aggregators.vlad import Words
from crisalad_jax.nn.aggregators.words import Bow, BowConfig, HardVladConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.local_features import OrbConfig, SiftConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.vocabulary import k_majority, start_vocabulary, with_vocabulary
from crisalad_jax.utils.errors import InputError

COUNT = 60
KEY = jax.random.key(0)


def picture(seed: int) -> np.ndarray:
    """Blobs and edges, for detectors to find."""
    generator = np.random.default_rng(seed)
    image = np.zeros((96, 128, 3), np.uint8)
    for _ in range(25):
        corner, size = generator.integers(0, 100, 2), generator.integers(4, 30, 2)
        colour = generator.integers(0, 256, 3).tolist()
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), colour, -1)
    return cv2.GaussianBlur(image, (0, 0), 1)


def saved(folder: pathlib.Path, count: int) -> list[pathlib.Path]:
    paths = [folder / f"{number}.png" for number in range(count)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), picture(number)[..., ::-1])
    return paths


def model(kind: str, head: str, words: int) -> ModelConfig:
    config = cj.recipe("b14", f"{kind}-{head}").model
    part = dataclasses.replace(config.aggregator, clusters=words)
    backbone = dataclasses.replace(config.backbone, count=COUNT)
    return dataclasses.replace(config, aggregator=part, backbone=backbone)


def by_opencv(image: np.ndarray, kind: str) -> np.ndarray:
    detector = cv2.SIFT_create(COUNT) if kind == "sift" else cv2.ORB_create(COUNT)
    points, found = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    return found[np.argsort([-point.response for point in points], kind="stable")[:COUNT]]


def of_image(image: np.ndarray, kind: str) -> np.ndarray:
    """The backbone's features, without the rows that stand for none."""
    config = model(kind, "bow", 2)
    encoded = cj.prepare_image(image, config)[None]
    request, images = config.aggregator.features(1), jnp.asarray(encoded, jnp.float32)
    patches, _ = config.backbone.apply(None, images, request, remat="none", valid=None)
    (rows,) = np.asarray(patches.patches)
    assert rows.shape == (COUNT, config.backbone.dim)
    kept = rows.any(axis=1)
    assert not rows[kept.sum() :].any()
    return rows[kept]


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_features_are_opencvs(kind: str) -> None:
    image = picture(3)
    expected, found = by_opencv(image, kind), of_image(image, kind)
    assert 10 < len(found) == len(expected)
    if kind == "sift":
        shares = expected / expected.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(found, np.sqrt(shares), atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    else:
        bits = np.unpackbits(expected, axis=1).astype(np.float32)
        np.testing.assert_array_equal(found, (2 * bits - 1) / 16)
        # The product counts bits in common: Hamming's distance by OpenCV.
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).match(expected[:1], expected[1:])
        nearest = (found[:1] @ found[1:].T).max()
        assert pairs[0].distance == 128 * (1 - nearest)


def test_strongest_features_come_first_and_none_are_left_over() -> None:
    image = picture(5)
    few = encode_local_features(image, "sift", 7)
    assert few.shape == (7, 43, 3)
    np.testing.assert_array_equal(few, encode_local_features(image, "sift", COUNT)[:7])
    flat = encode_local_features(np.full((96, 128, 3), 9, np.uint8), "orb", 5)
    assert flat.shape == (5, 11, 3)
    assert not flat.any()


def test_pixels_are_refused_where_features_are_meant() -> None:
    config = model("sift", "vlad", 4)
    params = cj.init_crisalad(KEY, config)
    words = f"^images: found 96 x 128 pixels, expected the {COUNT} features of backbone sift"
    with pytest.raises(InputError, match=words):
        cj.describe(params, picture(0)[None], config)
    with pytest.raises(InputError, match=r"preprocessing: found floats of .*, expected bytes of m"):
        config.resized(None, ["floats"])
    with pytest.raises(InputError, match=r"found bytes of mean \(0.485, .* for backbone sift, exp"):
        dataclasses.replace(config, preprocessing=cj.PreprocessingConfig())


def features(rows: np.ndarray, empty: int = 3) -> Features:
    """One image's unit features, with rows of zeros behind them, and an image without any."""
    padded = np.concatenate([rows, np.zeros((empty, rows.shape[1]), np.float32)])
    both = jnp.asarray(np.stack([padded, np.zeros_like(padded)]), jnp.float32)
    return Features(both[:, 0, :0], both)


def unit(*shape: int, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal(shape)
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


def nearest(words: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """By scikit-learn, which is given the words."""
    kmeans = sklearn.cluster.KMeans(len(words), init=words, n_init=1, max_iter=1).fit(words)
    kmeans.cluster_centers_ = words
    return kmeans.predict(rows)


def test_vlad_is_the_loop_over_features() -> None:
    words, rows = 0.7 * unit(5, 6), unit(30, 6, seed=1)
    config = HardVladConfig(clusters=5)
    tokens = config.apply(Words(jnp.asarray(words)), features(rows), (1, 33), key=None)
    expected = np.zeros((5, 6))
    for word, row in zip(nearest(words, rows), rows, strict=True):
        expected[word] += row - words[word]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(tokens.local[0], expected, atol=1e-5)
    # An image without features is not 0, which no cosine takes.
    np.testing.assert_array_equal(tokens.local[1], np.ones((5, 6)))


def test_bags_are_counted_by_hand() -> None:
    words = unit(4, 6)
    images = [unit(n, 6, seed=n) for n in (9, 12, 2)]
    config = BowConfig(clusters=4)
    start = config.from_centroids(jnp.asarray(words), jnp.zeros((1, 6)))
    learnt: Bow = config.with_frequencies(start, images)
    has = np.array([np.bincount(nearest(words, rows), minlength=4) > 0 for rows in images])
    idf = np.log(len(images) / np.maximum(has.sum(axis=0), 1))
    assert len(set(idf)) > 1
    np.testing.assert_allclose(learnt.weights, idf, rtol=1e-6)

    rows = images[0]
    tokens = config.apply(learnt, features(rows), (1, 12), key=None)
    counts = np.bincount(nearest(words, rows), minlength=4)
    np.testing.assert_allclose(tokens.global_token[0], counts / len(rows) * idf, atol=1e-6)
    np.testing.assert_array_equal(tokens.global_token[1], np.ones(4))


def test_binary_words_are_majorities_of_their_features() -> None:
    """Each cluster a few flipped bits from its centre, which is found; then a plain fixed point."""
    generator = np.random.default_rng(0)
    centres = generator.choice([-1, 1], (4, 64))
    flips = np.where(generator.random((120, 64)) < 0.1, -1, 1)
    rows = (centres[np.arange(120) % 4] * flips / 8).astype(np.float32)
    found = k_majority(rows, 4, seed=0)
    assert found.dtype == np.float32
    assert {tuple(row) for row in np.sign(found)} == {tuple(row) for row in centres}
    np.testing.assert_array_equal(np.abs(found), 1 / 8)

    mixed = generator.choice([-0.25, 0.25], (50, 16)).astype(np.float32)
    found = k_majority(mixed, 5, seed=1)
    distances = [[int((a != b).sum()) for b in found] for a in mixed]
    groups = np.argmin(distances, axis=1)
    for number, centroid in enumerate(found):
        ones = (mixed[groups == number] > 0).mean(axis=0)
        np.testing.assert_array_equal(centroid[ones > 0.5] > 0, True)
        np.testing.assert_array_equal(centroid[ones < 0.5] > 0, False)
    # More words than there are different features.
    assert k_majority(mixed[:2], 4, seed=0).shape == (4, 16)


@pytest.mark.parametrize(
    ("kind", "head"), [("sift", "vlad"), pytest.param("orb", "bow", marks=pytest.mark.slow)]
)
def test_a_vocabulary_and_its_descriptors(tmp_path: pathlib.Path, kind: str, head: str) -> None:
    """As `crisalad vocabulary` makes it, down to the descriptors of files."""
    paths, config = saved(tmp_path, 6), model(kind, head, 8)
    params = with_vocabulary(cj.Model(cj.init_crisalad(KEY, config), config), paths)
    words = np.asarray(params.aggregator.words)
    by_image = [of_image(read_image(path), kind) for path in paths]
    rows = np.concatenate(by_image)
    if kind == "sift":
        # k-means converged: one more round of scikit-learn's moves no word.
        again = sklearn.cluster.KMeans(8, init=words, n_init=1, max_iter=1).fit(rows)
        np.testing.assert_allclose(again.cluster_centers_, words, atol=1e-4)
    else:
        bits = np.array([np.bincount(nearest(words, each), minlength=8) > 0 for each in by_image])
        idf = np.log(6 / np.maximum(bits.sum(axis=0), 1))
        np.testing.assert_allclose(params.aggregator.weights, idf, atol=1e-6)
    found = cj.describe_files(cj.Model(params, config), paths)
    assert found.shape == (6, config.descriptor_dim)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    again = cj.describe_images(cj.Model(params, config), [read_image(paths[2])])
    np.testing.assert_allclose(again[0], found[2], atol=1e-6)


def test_recipes_by_name() -> None:
    for name, backbone, words in (
        ("sift-vlad", SiftConfig, 64),
        ("sift-bow", SiftConfig, 1000),
        ("orb-bow", OrbConfig, 1000),
    ):
        config = start_vocabulary(name).config
        assert type(config.backbone) is backbone
        assert config.aggregator.clusters == words
        assert config.preprocessing.size_rule == "longer-side"
    assert config.descriptor_dim == 1000
