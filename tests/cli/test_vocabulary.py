"""`crisalad vocabulary`: a whole model, of built-in aggregators and of a plug-in's."""

import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.data.images import list_images
from crisalad_jax.nn.model import Model
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.vocabulary import with_vocabulary
from tests.cli.test_cli import fails, succeeds
from tests.conftest import BATCH, assert_equal, random_params
from tests.training.test_vocabulary import ANYLOC

AT = "at 42 x 56, bilinear, antialiased, on bytes"


@pytest.fixture
def quick_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random parameters by numpy: to compile `init_crisalad` takes longer."""
    name = "crisalad_jax.training.vocabulary.init_crisalad"
    monkeypatch.setattr(name, lambda _, config: random_params(config))


def test_it_leaves_a_whole_model(capfd, shared, tmp_path):
    fresh = random_params(ANYLOC)
    start, out = tmp_path / "start.safetensors", tmp_path / "new" / "w.safetensors"
    save_weights(start, Model(fresh, ANYLOC))
    command = ("vocabulary", "--weights", start, "--images", shared / "town", "--out", out)
    said = succeeds(capfd, *command, "--seed", 3, "--batch-size", BATCH, "--quiet")
    assert said == f"{out}: anyloc, 4 words from 12 images {AT}, descriptors of 128 dimensions"
    found, config = load_weights(out)
    assert config == ANYLOC
    paths = list_images(shared / "town")
    assert_equal(found, with_vocabulary(Model(fresh, ANYLOC), paths, seed=3, batch_size=BATCH))


@pytest.mark.usefixtures("quick_start")
def test_a_preset_and_a_backbone(capfd, shared, tmp_path):
    """NetVLAD's, on the backbone of a model of another aggregator."""
    config = recipe("tiny", "scratch").model
    params = random_params(config)
    start, out = tmp_path / "start.safetensors", tmp_path / "w.safetensors"
    save_weights(start, Model(params, config))
    said = succeeds(
        capfd,
        *("vocabulary", "--backbone", start, "--preset", "tiny", "--aggregator", "netvlad"),
        *("--clusters", 3, "--image-size", 42, 56, "--images", shared / "town", "--out", out),
        *("--max-images", 4, "--batch-size", BATCH, "--quiet"),
    )
    assert said == f"{out}: netvlad, 3 words from 4 images {AT}, descriptors of 384 dimensions"
    found, found_config = load_weights(out)
    assert (found_config.image_size, found_config.aggregator.clusters) == ((42, 56), 3)
    assert_equal(found.backbone, params.backbone)


@pytest.mark.usefixtures("quick_start")
def test_bad_input_is_one_line(capfd, shared, tmp_path):
    out, weights = tmp_path / "w.safetensors", shared / "weights.safetensors"
    start = ("vocabulary", "--images", shared / "town", "--out")
    for more, words in (
        ((tmp_path / "w.npy",), "w.npy: found the suffix '.npy', expected .safetensors"),
        ((out, "--weights", weights), "aggregator: found salad, which has no vocabulary"),
        ((out, "--weights", weights, "--backbone", weights), "--backbone: found with --weights"),
        ((out, "--weights", weights, "--layer", 0), "--layer: found with --weights"),
        ((out, "--preset", "tiny", "--layer", 4), "layer: found 4, expected -4 to 3"),
        (
            (out, "--preset", "tiny", "--aggregator", "netvlad", "--facet", "key"),
            "--facet: found with --aggregator netvlad, which has no such setting, expected one",
        ),
        ((out, "--preset", "tiny", "--backbone", weights), "this backbone differs from the model"),
    ):
        fails(capfd, *start, *more, words=(words,))
    assert not out.exists()


PLUGIN = '''
import dataclasses

import jax.numpy as jnp

from crisalad_jax import Aggregator, TokenShape, register_aggregator
from crisalad_jax.nn.tokens import Tokens


@register_aggregator("bag-of-words")
@dataclasses.dataclass(frozen=True)
class BagOfWords(Aggregator):
    """How many patches are nearest to each word: a global token, and no local ones."""

    clusters: int = 8
    layer: int = 1

    def token_shape(self, dim):
        return TokenShape(self.clusters, 0, self.clusters)

    def count_centroids(self, dim):
        return self.clusters

    def init(self, key, backbone, grid):
        return jnp.zeros((self.clusters, backbone.dim))

    def from_centroids(self, centroids, features):
        return centroids

    def apply(self, params, features, grid, *, key):
        near = features.patches @ params.T - 0.5 * jnp.square(params).sum(-1)
        return Tokens.of_global(jnp.asarray(near == near.max(-1, keepdims=True), float).sum(-2))
'''


@pytest.mark.usefixtures("quick_start", "own_parts")
def test_a_plug_ins_aggregator(capfd, shared, tmp_path):
    """Flags set the fields that it has; `extract` finds it by --plugin."""
    plugin, out = tmp_path / "plugin.py", tmp_path / "w.safetensors"
    plugin.write_text(PLUGIN)
    images = ("--images", shared / "town", "--batch-size", BATCH, "--quiet", "--plugin", plugin)
    start = ("vocabulary", "--preset", "tiny", "--aggregator", "bag-of-words", "--out", out)
    start += images
    words = "--facet: found with --aggregator bag-of-words, which has no such setting, expected one"
    fails(capfd, *start, "--facet", "key", words=(words, "clusters, layer"))
    said = succeeds(capfd, *start, "--clusters", 5, "--layer", 2, "--image-size", 42, 56)
    assert said == f"{out}: bag-of-words, 5 words from 12 images {AT}, descriptors of 5 dimensions"
    params, config = load_weights(out)
    assert (config.aggregator.clusters, config.aggregator.layer) == (5, 2)
    paths = list_images(shared / "town")
    assert_equal(with_vocabulary(Model(params, config), paths, batch_size=BATCH), params)
    succeeds(capfd, "extract", "--weights", out, "--out", tmp_path / "d.npy", *images)
    assert np.load(tmp_path / "d.npy").shape == (12, 5)
