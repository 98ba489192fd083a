"""Losses and miner against pytorch-metric-learning 2.9.0: values and gradients.

Values agree to 1e-5 relative and gradients to 1e-4: float32 inner products of order 1 times
50 or 80 in an exponent carry 50 x 6e-8 each.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from pytorch_metric_learning.distances import CosineSimilarity, DotProductSimilarity, LpDistance
from pytorch_metric_learning.losses import (
    CircleLoss,
    ContrastiveLoss,
    CosFaceLoss,
    FastAPLoss,
    MultiSimilarityLoss,
    SupConLoss,
    TripletMarginLoss,
)
from pytorch_metric_learning.miners import MultiSimilarityMiner

from crisalad_jax.training.losses import (
    LossBatch,
    LossConfig,
    LossResult,
    LossValue,
    all_pairs,
    metric_loss,
    mine,
)
from crisalad_jax.training.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.training.losses.pairwise import (
    CircleConfig,
    ContrastiveConfig,
    FastAPConfig,
    MultiSimilarityConfig,
    SupConConfig,
    TripletConfig,
)
from crisalad_jax.utils.errors import InputError

PAPER = LossConfig()


def unit(x: np.ndarray) -> np.ndarray:
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def random_batch(seed: int, images: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Places of different sizes and tightness, so that miners find many, few or no pairs."""
    generator = np.random.default_rng(seed)
    places, drawn = int(generator.integers(1, 9)), int(generator.integers(2, 24))
    images = drawn if images is None else images
    labels = generator.integers(0, places, images)
    centres = generator.standard_normal((places, 6))
    noise = generator.choice([0.05, 1.0, 2.0])
    return unit(centres[labels] + noise * generator.standard_normal((images, 6))), labels


def library_loss(config: LossConfig) -> torch.nn.Module:
    """The library's loss with our constants, on unit vectors as they are."""
    dot = DotProductSimilarity(normalize_embeddings=False)
    match config.kind:
        case MultiSimilarityConfig(alpha, beta, base):
            return MultiSimilarityLoss(alpha, beta, base, distance=dot)
        case ContrastiveConfig(positive_margin, negative_margin):
            return ContrastiveLoss(positive_margin, negative_margin)
        case TripletConfig(margin):
            return TripletMarginLoss(margin)
        case CircleConfig(margin, scale):
            return CircleLoss(margin, scale)
        case SupConConfig(temperature):
            return SupConLoss(temperature)
        case FastAPConfig(bins):
            return FastAPLoss(bins, distance=LpDistance(power=2))
    raise AssertionError(config.kind)


def theirs(
    x: np.ndarray, labels: np.ndarray, config: LossConfig
) -> tuple[float, np.ndarray, tuple[torch.Tensor, ...]]:
    tensor = torch.tensor(x, requires_grad=True)
    miner = MultiSimilarityMiner(config.miner_margin, distance=CosineSimilarity())
    pairs = miner(tensor, torch.tensor(labels))
    chosen = pairs if config.miner == "multi-similarity" else None
    loss = library_loss(config)(tensor, torch.tensor(labels), chosen)
    loss.backward()
    return float(loss.detach()), tensor.grad.numpy(), pairs


@functools.partial(jax.jit, static_argnames="config")
def ours(x: jax.Array, labels: jax.Array, config: LossConfig):
    return jax.value_and_grad(lambda x: metric_loss(x, labels, config).loss)(x)


@pytest.mark.parametrize("base", [0.0, 0.5])
@pytest.mark.parametrize("margin", [0.1, 0.0])
def test_value_gradient_and_pairs_equal_the_library(base: float, margin: float) -> None:
    kind = MultiSimilarityConfig(base=base)
    config = LossConfig(kind=kind, miner_margin=margin, pml_compat=True)
    nonzero = 0
    for seed in range(40):
        x, labels = random_batch(seed, images=(2, 7, 16, 23)[seed % 4])
        loss, gradient, (a1, p, a2, n) = theirs(x, labels, config)
        pairs = mine(jnp.asarray(x @ x.T), all_pairs(jnp.asarray(labels)), margin=margin)
        for mask, (anchors, others) in zip(pairs, ((a1, p), (a2, n)), strict=True):
            found = {tuple(pair) for pair in np.argwhere(np.asarray(mask))}
            assert found == set(zip(anchors.tolist(), others.tolist(), strict=True))
        value, our_gradient = ours(jnp.asarray(x), jnp.asarray(labels), config)
        np.testing.assert_allclose(value, loss, rtol=1e-5, atol=1e-7)
        scale = max(np.abs(gradient).max(), 1e-6)
        np.testing.assert_allclose(our_gradient / scale, gradient / scale, atol=1e-4)
        nonzero += loss > 0
    assert nonzero > 10  # the comparison is not of zeros alone


OTHERS = [
    LossConfig(kind=ContrastiveConfig(0.2, 1.1)),
    LossConfig(kind="contrastive", miner="none"),
    LossConfig(kind=TripletConfig(0.3)),
    LossConfig(kind="triplet", miner="none"),
    LossConfig(kind=CircleConfig(0.25, 20.0)),
    LossConfig(kind="circle", miner="none"),
    LossConfig(kind=SupConConfig(0.2)),
    LossConfig(kind="supcon", miner="none"),
    LossConfig(kind="fast-ap", miner="none"),
    LossConfig(kind=FastAPConfig(7), miner="none"),
]


def _name(config: LossConfig) -> str:
    return f"{config.kind.part_name}, miner {config.miner}"


EACH_KIND = pytest.mark.parametrize("config", [PAPER, *OTHERS[::2]], ids=_name)
"""Once, with a miner or without."""


@pytest.mark.parametrize("config", OTHERS, ids=_name)
def test_every_loss_and_its_gradient_equal_the_librarys(config: LossConfig) -> None:
    """In float64: float32 tells little of the distance of descriptors that are nearly equal."""
    # The library's triplets know no such zero, and its FastAP none either.
    few_are_zero = isinstance(config.kind, ContrastiveConfig | CircleConfig | SupConConfig)
    config = dataclasses.replace(config, pml_compat=few_are_zero)
    nonzero = 0
    for seed in range(40):
        x, labels = random_batch(seed, images=5 if seed % 2 else 16)
        x = x.astype(np.float64)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        loss, gradient, _ = theirs(x, labels, config)
        with jax.enable_x64(True):
            value, our_gradient = ours(jnp.asarray(x), jnp.asarray(labels), config)
        # Squares of distances of 1e-2 and more are off by 2e-16, and exponents by 80 times that.
        np.testing.assert_allclose(value, loss, rtol=1e-11, atol=1e-13, err_msg=str(seed))
        # Along the sphere: a gradient along the descriptor itself does nothing to a unit vector,
        # and the library takes distances of vectors that it normalises once more.
        found, expected = (along_sphere(np.asarray(g), x) for g in (our_gradient, gradient))
        np.testing.assert_allclose(found, expected, atol=1e-10 * max(1, np.abs(expected).max()))
        nonzero += loss > 1e-6
    assert nonzero > 10  # the comparison is not of zeros alone


def along_sphere(gradient: np.ndarray, x: np.ndarray) -> np.ndarray:
    return gradient - (gradient * x).sum(axis=1, keepdims=True) * x


@EACH_KIND
def test_every_loss_has_finite_gradients_where_images_are_the_same_or_pairs_are_missing(
    config: LossConfig,
) -> None:
    same = np.full((6, 4), 0.5, np.float32)
    apart = np.eye(4, dtype=np.float32)
    for x, labels in (
        (same, [0, 0, 1, 1, 2, 2]),
        (apart, [0, 0, 0, 0]),
        (apart, [0, 1, 2, 3]),
        (apart, [0, 0, 1, 2]),
    ):
        value, gradient = ours(jnp.asarray(x), jnp.asarray(labels), config)
        loss, _, _ = theirs(x, np.array(labels), config)
        np.testing.assert_allclose(value, loss, rtol=1e-5, atol=1e-6)
        assert np.isfinite(gradient).all()


@EACH_KIND
def test_images_that_are_not_valid_take_no_part_in_any_loss(config: LossConfig) -> None:
    x, labels = random_batch(2)
    padded = np.concatenate([x, unit(np.random.default_rng(9).standard_normal((3, 6)))])
    padded_labels = jnp.asarray(np.concatenate([labels, labels[:3]]))
    valid = jnp.arange(len(padded)) < len(x)
    alone = metric_loss(jnp.asarray(x), jnp.asarray(labels), config)

    def loss(padded: jax.Array, valid: jax.Array = valid) -> tuple[jax.Array, LossResult]:
        result = metric_loss(padded, padded_labels, config, valid=valid)
        return result.loss, result

    (_, found), gradient = jax.value_and_grad(loss, has_aux=True)(jnp.asarray(padded))
    assert alone.loss > 0
    # Sums of other lengths round otherwise.
    np.testing.assert_allclose(found.loss, alone.loss, rtol=1e-6)
    np.testing.assert_allclose(found.easy_anchor_fraction, alone.easy_anchor_fraction, rtol=1e-6)
    np.testing.assert_array_equal(gradient[len(x) :], 0)
    assert loss(jnp.asarray(padded), jnp.zeros(len(padded), bool))[0] == 0
    padded[-1] = np.nan  # padding may be anything
    np.testing.assert_allclose(loss(jnp.asarray(padded))[0], found.loss, rtol=1e-6)


def test_a_nan_is_not_taken_for_a_perfect_batch() -> None:
    x, labels = random_batch(0)
    x[0] = np.nan
    assert jnp.isnan(metric_loss(jnp.asarray(x), jnp.asarray(labels), PAPER).loss)


@pytest.mark.parametrize(
    ("upper", "labels", "mined"),
    [
        # Anchor 0 alone has a positive, at 0.6, less similar than a negative, at 0.55, plus 0.1;
        # the pairs of anchor 1 are in order, and anchor 2 has no positive.
        ((0.60, 0.55, 0.10), [0, 0, 1], (1, 1)),
        # Its positive at 0.6, negatives at 0.55 and 0.58.
        ((0.60, 0.55, 0.58, 0.10, 0.10, 0.30), [0, 0, 1, 2], (1, 2)),
        # Its positives at 0.6 and 0.58, a negative at 0.55.
        ((0.60, 0.58, 0.55, 0.50, 0.10, 0.10), [0, 0, 0, 1], (2, 1)),
    ],
)
def test_the_librarys_zero_needs_few_pairs_on_both_sides(upper, labels, mined) -> None:
    """One positive and one negative pair mined in the whole batch: the library says 0."""
    similarities = np.eye(len(labels))
    similarities[np.triu_indices(len(labels), 1)] = upper
    similarities = np.maximum(similarities, similarities.T)
    x = jnp.asarray(np.linalg.cholesky(similarities), jnp.float32)
    pairs = mine(x @ x.T, all_pairs(jnp.asarray(labels)), margin=0.1)
    assert (pairs.positives.sum(), pairs.negatives.sum()) == mined
    loss, _, _ = theirs(np.array(x), np.array(labels), LossConfig())
    assert (loss == 0) == (mined == (1, 1))
    value, plain = (
        metric_loss(x, jnp.asarray(labels), LossConfig(pml_compat=option)).loss
        for option in (True, False)
    )
    np.testing.assert_allclose(value, loss, rtol=1e-5)
    if mined == (1, 1):
        by_hand = (np.log1p(np.exp(-0.60)) + np.log1p(np.exp(50 * 0.55)) / 50) / 3
        np.testing.assert_allclose(plain, by_hand, rtol=1e-6)


def test_ties_with_the_margin_mine_nothing() -> None:
    """Strict on both sides: similarity minus (plus) margin equal to the hardest other is easy."""
    similarities = jnp.array([[1.0, 0.75, 0.5], [0.75, 1.0, 0.5], [0.5, 0.5, 1.0]])
    labels = jnp.array([0, 0, 1])
    tied = mine(similarities, all_pairs(labels), margin=0.25)
    assert not tied.positives.any()
    assert not tied.negatives.any()
    wider = mine(similarities, all_pairs(labels), margin=0.3125)
    assert wider.positives.sum() == 2
    assert wider.negatives.sum() == 2


def test_the_easy_anchor_fraction_counts_anchors_without_a_hard_positive() -> None:
    """Two tight places far apart are easy but for one image that strayed to the other place."""
    x = np.array([[1, 0], [1, 0], [0, 1], [1, 0]], np.float32)
    labels = jnp.array([0, 0, 1, 1])
    # Anchors 2 and 3 each have the other as a hard positive; 0 and 1 have each other at similarity
    # 1, while the stray is as similar: within the margin, so hard too.
    assert metric_loss(jnp.asarray(x), labels, PAPER).easy_anchor_fraction == 0
    x[3] = [0, 1]
    assert metric_loss(jnp.asarray(x), labels, PAPER).easy_anchor_fraction == 1
    for alone in (jnp.zeros(4, int), jnp.arange(4)):  # without negatives, without positives
        assert metric_loss(jnp.asarray(x), alone, PAPER).easy_anchor_fraction == 1


def large_margin_cosine_loss(
    x: jax.Array, labels: jax.Array, weights: jax.Array, *, valid=None, classes=None, **constants
) -> LossValue:
    valid = jnp.ones(len(labels), bool) if valid is None else valid
    batch = LossBatch(x, labels, valid, all_pairs(labels), classes)
    return LargeMarginCosineConfig(**constants).apply(weights, batch)


def cosine_batch(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Descriptors and classes' vectors of any length, and labels, in float64."""
    generator = np.random.default_rng(seed)
    classes, images = 5, 7
    labels = generator.integers(0, classes, images)
    weights = generator.standard_normal((classes, 6)) * generator.uniform(0.1, 3, (classes, 1))
    return weights[labels] + generator.standard_normal((images, 6)), labels, weights


def cosine_loss(
    x: np.ndarray, labels: np.ndarray, weights: np.ndarray, **changes
) -> tuple[float, np.ndarray, np.ndarray]:
    """Ours: value and both gradients."""

    def loss(x: jax.Array, weights: jax.Array) -> jax.Array:
        constants = {"scale": 30.0, "margin": 0.4} | changes
        return large_margin_cosine_loss(x, jnp.asarray(labels), weights, **constants).loss

    with jax.enable_x64(True):
        value, gradients = jax.value_and_grad(loss, (0, 1))(jnp.asarray(x), jnp.asarray(weights))
        return float(value), *map(np.asarray, gradients)


@pytest.mark.parametrize(("scale", "margin"), [(30.0, 0.4), (100.0, 0.4), (4.0, 0.0)])
def test_the_large_margin_cosine_loss_is_the_librarys(scale, margin) -> None:
    """And its gradients, of float64, which leaves 1e-16 times 100."""
    for seed in range(8):
        x, labels, weights = cosine_batch(seed)
        images = torch.tensor(x, requires_grad=True)
        library = CosFaceLoss(len(weights), 6, margin=margin, scale=scale)
        library.W = torch.nn.Parameter(torch.tensor(weights.T))
        expected = library(images, torch.tensor(labels))
        expected.backward()
        found = cosine_loss(x, labels, weights, scale=scale, margin=margin)
        np.testing.assert_allclose(found[0], expected.item(), rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(found[1], images.grad, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(found[2], library.W.grad.T, rtol=1e-9, atol=1e-11)


def test_images_that_are_not_valid_and_rows_beyond_the_classes_take_no_part() -> None:
    x, labels, weights = cosine_batch(3)
    alone = cosine_loss(x, labels, weights)
    more = np.random.default_rng(1).standard_normal((2, 6))
    padded = np.concatenate([weights, 3 * x[:1], np.zeros((1, 6))])
    found = cosine_loss(
        np.concatenate([x, more]),
        np.concatenate([labels, [0, -1]]),
        padded,
        valid=jnp.arange(len(x) + 2) < len(x),
        classes=len(weights),
    )
    # Sums of other lengths round otherwise.
    np.testing.assert_allclose(found[0], alone[0], rtol=1e-13)
    np.testing.assert_allclose(found[1][: len(x)], alone[1], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(found[2][: len(weights)], alone[2], rtol=1e-10, atol=1e-13)
    for gradient, rows in ((found[1], len(x)), (found[2], len(weights))):
        np.testing.assert_array_equal(gradient[rows:], 0)


def test_accuracy_is_the_share_of_valid_images_nearest_to_their_class() -> None:
    weights = jnp.eye(3)
    # Nearest to 0, 1, 1, 2 and 0; the margin, larger than what is between, does not count.
    x = jnp.array([[1, 0.9, 0], [0, 1, 0.9], [0.9, 1, 0], [0, 0, 2.0], [1, 0, 0]])
    labels, valid = jnp.array([0, 1, 0, 2, 1]), jnp.array([True, True, True, True, False])

    def accuracy(**options) -> float:
        found = large_margin_cosine_loss(x, labels, weights, scale=30.0, margin=0.4, **options)
        return float(found.accuracy)

    assert accuracy(valid=valid) == 3 / 4
    assert accuracy() == pytest.approx(3 / 5)
    assert accuracy(valid=valid, classes=1) == 2 / 4  # of one class all are nearest to it


def test_a_descriptor_of_zeros_has_a_finite_gradient_and_a_nan_is_told() -> None:
    x, labels, weights = cosine_batch(4)
    x[0] = 0
    value, *gradients = cosine_loss(x, labels, weights)
    assert np.isfinite(value)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    x[0] = np.nan
    assert np.isnan(cosine_loss(x, labels, weights)[0])


def test_a_loss_without_its_parameters_is_told() -> None:
    config = LossConfig(kind="large-margin-cosine", miner="none")
    with pytest.raises(InputError, match=r"^loss large-margin-cosine: found no params, expected"):
        metric_loss(jnp.eye(4), jnp.array([0, 0, 1, 1]), config)
