"""The whole model: shapes, unit norm, what a descriptor depends on, precision, errors."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import (
    attend_across_images,
    cast_params,
    describe,
    extract_tokens,
    parameter_shapes,
    self_mask,
    transport_masses,
    valid_mask,
)
from crisalad_jax.nn.pixels import normalise
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.target import CPU, GPU, lowering_for
from tests.conftest import MODEL as CONFIG
from tests.conftest import assert_equal, random_params

# Descriptors have entries of order 0.1; float32 sums compiled for another batch size differ by
# some units in the last place after a few layers.
TOLERANCE = 2e-6


@pytest.fixture(scope="module")
def params():
    return random_params(CONFIG)


def pictures(count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.integers(0, 256, (count, 42, 56, 3), dtype=np.uint8)


def test_batches_of_batches_are_described_by_vmap(params) -> None:
    batches = np.stack([pictures(3), pictures(3, 1)])
    together = jax.vmap(lambda images: describe(params, images, CONFIG))(batches)
    for found, images in zip(together, batches, strict=True):
        np.testing.assert_allclose(found, describe(params, images, CONFIG), atol=TOLERANCE)


@pytest.mark.slow
def test_second_derivatives_are_those_of_differences() -> None:
    """Of a mean that pixels are scaled by; forward mode is refused, as the docstring says."""
    with jax.enable_x64(True):
        config = dataclasses.replace(CONFIG, compute_dtype="float64")
        params = random_params(config)
        images = np.random.default_rng(0).normal(size=(2, 42, 56, 3))

        def score(scale: jax.Array) -> jax.Array:
            return describe(params, scale * images, config)[0, :8].sum()

        slope = jax.jit(jax.grad(score))
        second = jax.jit(jax.jacrev(jax.grad(score)))(1.0)
        # Central differences of 1e-4 miss by 1e-8 of the third derivative, which is of order 1.
        numeric = (slope(1 + 1e-4) - slope(1 - 1e-4)) / 2e-4
        assert abs(second) > 1e-4
        np.testing.assert_allclose(second, numeric, rtol=1e-5, atol=1e-7)
        with pytest.raises(TypeError, match="forward-mode"):
            jax.jvp(score, (1.0,), (1.0,))


@pytest.mark.parametrize("sides", [(42, 56), (84, 28)])  # the configuration's, and others
def test_descriptors_are_unit_vectors(params, sides) -> None:
    images = np.random.default_rng(0).integers(0, 256, (4, *sides, 3), dtype=np.uint8)
    descriptors = describe(params, images, CONFIG)
    assert descriptors.shape == (4, 16 + 4 * 8)
    np.testing.assert_allclose(jnp.linalg.norm(descriptors, axis=1), 1, atol=1e-6)


def test_the_papers_descriptor_has_8448_numbers() -> None:
    config = PRESETS["b14"]
    params = parameter_shapes(config)
    images = jax.ShapeDtypeStruct((2, 224, 224, 3), jnp.uint8)
    assert jax.eval_shape(lambda p, x: describe(p, x, config), params, images).shape == (2, 8448)
    assert config.descriptor_dim == 8448


@pytest.mark.slow
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="how much memory a CPU's program takes")
def test_memory_is_what_attention_needs_at_once() -> None:
    """Scores; queries, keys and values as made; the first two as multiplied; the tokens.

    The feed-forward network needs no more: GELU is written over what it reads. Nor do copies of the
    weights: each is made when it is needed.
    """
    config = PRESETS["s14"]
    params = parameter_shapes(config)
    images = jax.ShapeDtypeStruct((8, 224, 224, 3), jnp.uint8)
    memory = describe.lower(params, images, config).compile().memory_analysis()
    scores, tokens = 8 * 6 * 257 * 257, 8 * 257 * 384
    needed = 4 * (scores + (3 + 2 + 1) * tokens)
    # A hundredth for the small arrays.
    assert memory.temp_size_in_bytes <= 1.01 * needed


def test_padding_images_change_nothing(params) -> None:
    images = pictures(3)
    bare = describe(params, images, CONFIG)
    padded = np.concatenate([images, pictures(5, seed=1)])
    mask = valid_mask(jnp.arange(8) < 3)
    np.testing.assert_allclose(
        describe(params, padded, CONFIG, mask=mask)[:3], bare, atol=TOLERANCE
    )
    # Without the mask the five others are looked at, so the test above can fail.
    assert np.abs(describe(params, padded, CONFIG)[:3] - bare).max() > 100 * TOLERANCE


def test_any_order_of_the_batch_gives_the_same_descriptors(params) -> None:
    images, order = pictures(5), np.array([3, 1, 4, 0, 2])
    permuted = describe(params, images[order], CONFIG)
    np.testing.assert_allclose(permuted, describe(params, images, CONFIG)[order], atol=TOLERANCE)


def test_alone_is_a_batch_of_one(params) -> None:
    images = pictures(4)
    together = describe(params, images, CONFIG, mask=self_mask(4))
    one_by_one = np.concatenate([describe(params, images[i : i + 1], CONFIG) for i in range(4)])
    np.testing.assert_allclose(together, one_by_one, atol=TOLERANCE)
    assert np.abs(describe(params, images, CONFIG) - together).max() > 100 * TOLERANCE


def test_describe_is_attention_across_images_after_their_tokens(params) -> None:
    images, mask = pictures(3), valid_mask(jnp.array([True, True, False]))
    tokens = extract_tokens(params, images, CONFIG)
    np.testing.assert_allclose(
        attend_across_images(params, tokens, CONFIG, mask=mask),
        describe(params, images, CONFIG, mask=mask),
        atol=TOLERANCE,
    )


def test_bytes_are_normalised_and_floats_are_taken_as_they_are(params) -> None:
    images = jnp.asarray(pictures(2))
    floats = jax.vmap(lambda image: normalise(image, PreprocessingConfig()))(images)
    np.testing.assert_allclose(
        describe(params, floats, CONFIG), describe(params, images, CONFIG), atol=TOLERANCE
    )


def test_dropout_is_drawn_from_the_key(params) -> None:
    plain, first, again, other = (
        describe(params, pictures(3), CONFIG, key=key)
        for key in (None, jax.random.key(1), jax.random.key(1), jax.random.key(2))
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert np.abs(first - plain).max() > 1e-3


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((1, 43, 56, 3), "found 43 x 56, expected sides that are multiples of 14"),
        ((1, 28, 28, 3), "found 28 x 28, which is 4 patches for 4 clusters.*42 x 42"),
    ],
)
def test_images_that_do_not_fit_raise_while_tracing(params, shape, message: str) -> None:
    images = jax.ShapeDtypeStruct(shape, jnp.uint8)
    with pytest.raises(InputError, match=message):
        jax.eval_shape(lambda p, x: describe(p, x, CONFIG), params, images)


def test_transport_masses_by_scaling_a_matrix_in_float64(params):
    """Sinkhorn's algorithm as it is usually written: columns, then rows, three times."""
    images = pictures(2)
    pixels = jax.vmap(lambda image: normalise(image, PreprocessingConfig()))(images)
    patches = np.asarray(CONFIG.backbone.apply(params.backbone, pixels)[0].patches, np.float64)
    network = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params.aggregator.score)
    hidden = np.maximum(patches @ network.fc1.weight + network.fc1.bias, 0)
    scores = hidden @ network.fc2.weight + network.fc2.bias
    dustbin = np.full((*scores.shape[:-1], 1), float(params.aggregator.dust_bin))
    kernel = np.exp(np.concatenate([scores, dustbin], axis=-1))
    patch_count, clusters = scores.shape[1:]
    wanted = np.append(np.ones(clusters), patch_count - clusters)
    rows = np.ones((2, patch_count))
    for _ in range(CONFIG.aggregator.sinkhorn.iterations):
        columns = wanted / np.einsum("bn,bnm->bm", rows, kernel)
        rows = 1 / np.einsum("bnm,bm->bn", kernel, columns)
    expected = rows[..., None] * kernel * columns[:, None]

    found = transport_masses(params, images, CONFIG)
    # Float32 against float64, features of order 1 after two blocks.
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-6)
    # What the dustbin takes and what is kept make the patch's mass.
    np.testing.assert_allclose(found.sum(axis=-1), 1, rtol=1e-5)


def test_a_model_without_salad_transports_nothing(params):
    config = dataclasses.replace(
        CONFIG,
        aggregator="class-token",
        cross_image="none",
    )
    bare = dataclasses.replace(params, aggregator=None, cross_image=None)
    with pytest.raises(
        InputError, match=r"^aggregator: found class-token, expected one that transp"
    ):
        transport_masses(bare, pictures(2), config)


def test_an_image_that_may_attend_to_none_attends_to_itself_and_spoils_no_other(params):
    mask = np.eye(3, dtype=bool)
    mask[2, 2] = False
    descriptors = describe(params, pictures(3), CONFIG, mask=mask)
    assert_equal(descriptors, describe(params, pictures(3), CONFIG, mask=self_mask(3)))


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("shape", [(3,), (2, 2), (3, 1)])
def test_a_mask_of_another_shape_is_refused(params, shape):
    words = re.escape(f"mask: found shape {shape}, expected (3, 3), a row and a column for each")
    with pytest.raises(InputError, match=words):
        describe(params, pictures(3), CONFIG, mask=np.ones(shape, bool))


@pytest.mark.parametrize("version", [(0, 10, 2), (0, 11, 0)])
def test_an_old_compiler_for_cpus_gets_no_weights_to_widen(params, monkeypatch, version) -> None:
    monkeypatch.setattr(jax, "__version_info__", version)
    config = dataclasses.replace(CONFIG, compute_dtype="bfloat16")
    with lowering_for(CPU):
        cast = cast_params(params, config)
    expected = "float32" if version < (0, 11) else "bfloat16"
    assert cast.backbone.blocks.mlp.fc1.weight.dtype == expected


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_weights_cast_once_change_no_bit(params, dtype: str) -> None:
    config = dataclasses.replace(CONFIG, compute_dtype=dtype)  # pyright: ignore
    with lowering_for(GPU):  # as on a CPU from jax 0.11 on
        cast = cast_params(params, config)
    assert cast.backbone.blocks.mlp.fc1.weight.dtype == dtype
    assert cast.backbone.blocks.mlp.fc1.bias.dtype == jnp.float32
    found, expected = (describe(each, pictures(4), config) for each in (cast, params))
    np.testing.assert_array_equal(found, expected)
