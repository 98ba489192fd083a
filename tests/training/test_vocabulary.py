"""Vocabularies: fixed points of k-means on features that are read here again; what is refused."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig
from crisalad_jax.nn.aggregators.vlad import (
    AnyLocConfig,
    NetVlad,
    NetVladConfig,
    VladBuff,
    VladBuffConfig,
    Words,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, unit_features
from crisalad_jax.training.trainable import split_params
from crisalad_jax.training.vocabulary import build_vocabulary, with_vocabulary
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.output import Note
from tests.cli.test_cli import fails
from tests.conftest import BATCH, MODEL, RECIPE, assert_equal, random_params

ANYLOC = dataclasses.replace(
    MODEL,
    aggregator=AnyLocConfig(clusters=4, layer=0, facet="key"),
    cross_image="none",
)
NETVLAD = dataclasses.replace(ANYLOC, aggregator=NetVladConfig(clusters=4))
IMAGE = dataclasses.replace(
    ANYLOC,
    backbone=dataclasses.replace(MODEL.backbone, registers=2, position_resize="plain"),
    aggregator=AggregationTokensConfig(tokens=4, insertion=-1),
)
VLAD_BUFF = dataclasses.replace(ANYLOC, aggregator=VladBuffConfig(clusters=4, reduced=8))
CONFIGS = pytest.mark.parametrize("config", [ANYLOC, NETVLAD], ids=["anyloc", "netvlad"])


@pytest.fixture(scope="module")
def fresh() -> Crisalad:
    """AnyLoc without a vocabulary."""
    params = random_params(ANYLOC)
    return dataclasses.replace(params, aggregator=Words(jnp.ones((4, 32))))


@pytest.fixture(scope="module")
def paths(shared: pathlib.Path) -> list[pathlib.Path]:
    return list_images(shared / "town")


@pytest.fixture(scope="module")
def built(fresh: Crisalad, paths: list[pathlib.Path]) -> Crisalad:
    return with_vocabulary(Model(fresh, ANYLOC), paths, seed=3, batch_size=BATCH)


def centroids_of(params: Crisalad) -> np.ndarray:
    aggregator = params.aggregator
    assert isinstance(aggregator, Words | NetVlad)
    return np.asarray(aggregator.words if isinstance(aggregator, Words) else aggregator.centroids)


def features_of(params: Crisalad, config: ModelConfig, paths: list[pathlib.Path]) -> np.ndarray:
    """Unit features of all patches of all images, read here again."""
    images = np.stack([resize_image(read_image(path), config.image_size) for path in paths])
    batches = images.reshape(-1, BATCH, *images.shape[1:])
    found = [np.asarray(unit_features(params, jnp.asarray(batch), config)) for batch in batches]
    return np.concatenate(found).reshape(-1, 32)


@CONFIGS
def test_a_centroid_is_the_mean_of_the_features_nearest_to_it(config, paths) -> None:
    """Of all features of all images: with 12 patches an image, none are left out."""
    fresh = random_params(config)
    centroids = centroids_of(with_vocabulary(Model(fresh, config), paths, seed=3, batch_size=BATCH))
    features = features_of(fresh, config, paths).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, rtol=1e-6)
    distances = np.linalg.norm(features[:, None] - centroids, axis=2)
    if config is ANYLOC:  # whose k-means compares by the angle
        distances = -features @ (centroids / np.linalg.norm(centroids, axis=1)[:, None]).T
    nearest = distances.argmin(axis=1)
    assert set(nearest) == set(range(4))
    means = [features[nearest == k].mean(axis=0) for k in range(4)]
    # Means of at most 144 float32 numbers; a round more of k-means would not move them.
    np.testing.assert_allclose(centroids, means, atol=1e-6)


@pytest.mark.parametrize("config", [IMAGE, VLAD_BUFF], ids=["image", "vlad-buff"])
def test_other_starts_are_of_the_same_features(config, paths) -> None:
    """ImAge's are those of its backbone without tokens, VLAD-BuFF's centroids of components."""
    fresh = random_params(config)
    found = with_vocabulary(Model(fresh, config), paths, seed=3, batch_size=BATCH).aggregator
    alone = dataclasses.replace(config, aggregator=NetVladConfig(clusters=4))
    params = dataclasses.replace(random_params(alone), backbone=fresh.backbone)
    features = jnp.asarray(features_of(params, alone, paths))
    reduced = np.asarray(config.aggregator.centroid_features(features))
    if isinstance(found, VladBuff):
        centroids = np.asarray(found.centroids)
    else:
        # Directions are all that is left of them.
        expected = with_vocabulary(Model(params, alone), paths, seed=3, batch_size=BATCH)
        centroids = centroids_of(expected)
        weight = expected.aggregator.conv.weight  # pyright: ignore
        # The same features but for the order of the compiled program's float32 sums.
        np.testing.assert_allclose(found.tokens, weight.T, rtol=1e-4, atol=1e-3)
    nearest = np.linalg.norm(reduced[:, None] - centroids, axis=2).argmin(axis=1)
    means = [reduced[nearest == k].mean(axis=0) for k in range(4)]
    np.testing.assert_allclose(centroids, means, atol=1e-6)


def test_a_seed_draws_images_and_centroids(fresh, paths, built) -> None:
    again = with_vocabulary(Model(fresh, ANYLOC), paths, seed=3, batch_size=BATCH)
    assert_equal(again, built)
    fewer = with_vocabulary(Model(fresh, ANYLOC), paths, images=5, seed=3, batch_size=BATCH)
    others = with_vocabulary(Model(fresh, ANYLOC), paths, images=5, seed=4, batch_size=BATCH)
    some = [centroids_of(params) for params in (built, fewer, others)]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert not np.array_equal(some[i], some[j])
    assert_equal(dataclasses.replace(built, aggregator=fresh.aggregator), fresh)


def test_a_file_has_the_vocabulary_of_so_many_images(fresh, paths, tmp_path) -> None:
    out, model = tmp_path / "anyloc.safetensors", Model(fresh, ANYLOC)
    found = build_vocabulary(model, paths, out, max_images=4, batch_size=BATCH, quiet=True)
    expected = with_vocabulary(model, paths, images=4, batch_size=BATCH, quiet=True)
    np.testing.assert_array_equal(centroids_of(load_weights(out).params), centroids_of(expected))
    assert (found.words, found.images) == (4, 4)


def test_what_does_not_fit_is_said_before_images_are_read(fresh, tmp_path) -> None:
    nowhere = [tmp_path / "none.jpg"]
    for options, words in (
        ({"images": 0}, "images: found 0, expected at least 1"),
        ({"seed": -1}, "seed: found -1, expected at least 0"),
        ({"batch_size": 0}, "batch size: found 0"),
    ):
        with pytest.raises(InputError, match=words):
            with_vocabulary(Model(fresh, ANYLOC), nowhere, **options)


def test_unreadable_images_stop_or_are_left_out(fresh, paths, built, tmp_path) -> None:
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"no image")
    with pytest.raises(InputError, match=f"{bad}: found 8 bytes that do not decode"):
        with_vocabulary(Model(fresh, ANYLOC), [*paths, bad], batch_size=BATCH)
    options = {"seed": 3, "batch_size": BATCH, "on_bad_image": "skip"}
    with pytest.warns(Note, match=f"images: 1 unreadable left out, {bad} the first"):
        assert_equal(with_vocabulary(Model(fresh, ANYLOC), [*paths, bad], **options), built)
    with pytest.raises(InputError, match="found 0 features in those that can be read, expected at"):
        with_vocabulary(Model(fresh, ANYLOC), [bad], **options)


def test_features_that_are_not_finite_are_refused(fresh, paths) -> None:
    spoilt = dataclasses.replace(fresh.backbone, cls_token=jnp.full(32, jnp.nan))
    broken = dataclasses.replace(fresh, backbone=spoilt)
    token = AnyLocConfig(clusters=4, layer=-1, facet="token")
    model = Model(broken, dataclasses.replace(ANYLOC, aggregator=token))
    with pytest.raises(InputError, match=r"^images: found .* without NaN or infinity"):
        with_vocabulary(model, paths[:BATCH], batch_size=BATCH)


# In training


@pytest.fixture
def quick_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random parameters by numpy: to compile `init_crisalad` takes longer."""
    name = "crisalad_jax.training.start.init_crisalad"
    monkeypatch.setattr(name, lambda _, config: random_params(config))


@pytest.mark.usefixtures("quick_start")
def test_training_netvlad_starts_from_the_training_images(
    capfd, shared, places, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same start in every call, which is what lets a run go on; given weights stay."""
    config = dataclasses.replace(RECIPE, model=NETVLAD)
    write_json(tmp_path / "recipe.json", to_plain(config))
    starts = []

    def stop(*_, initial=None, **__):
        starts.append(initial)
        raise InputError("far enough")

    monkeypatch.setattr("crisalad_jax.experiments.train.fit", stop)
    weights = shared / "weights.safetensors"

    def start(out: str, *flags, words: str = "far enough") -> None:
        command = ("train", "--data", shared / "city", "--config", tmp_path / "recipe.json")
        fails(capfd, *command, "--out", tmp_path / out, *flags, "--quiet", words=(words,))

    for _ in range(2):
        start("run", "--backbone", weights)
    images = [places.path(image) for image in range(len(places.files))]
    expected = with_vocabulary(Model(starts[0], NETVLAD), images, seed=config.seed)
    assert_equal(starts[0], expected)
    assert_equal(starts[1], expected)
    assert_equal(starts[0].backbone, load_weights(weights)[0].backbone)

    save_weights(tmp_path / "w.safetensors", Model(random_params(NETVLAD), NETVLAD))
    start("run", "--weights", tmp_path / "w.safetensors")
    assert_equal(starts[2], load_weights(tmp_path / "w.safetensors")[0])

    # What holds something else is said before images are read for the centroids.
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    monkeypatch.setattr("crisalad_jax.training.start.with_vocabulary", None)
    start("full", "--backbone", weights, words="full: found files but no run")


def test_anyloc_does_not_train(capfd, fresh, shared, tmp_path) -> None:
    trainable, _ = split_params(fresh, ANYLOC, "head,-adapters")
    assert not jax.tree.leaves(trainable)
    write_json(tmp_path / "recipe.json", to_plain(dataclasses.replace(RECIPE, model=ANYLOC)))
    command = ("train", "--data", shared / "city", "--config", tmp_path / "recipe.json")
    words = "with aggregator anyloc trains nothing, expected another (`crisalad vocabulary` makes"
    fails(capfd, *command, "--out", tmp_path / "run", words=(words,))
    assert not (tmp_path / "run").exists()
