"""Triplets of Sinkhorn divergences against numpy's iterations, in float64."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.training.losses import LossConfig, metric_loss
from crisalad_jax.training.losses.divergence import SinkhornDivergenceLoss
from crisalad_jax.training.step import init_train_state, named_scalars, step_config, train_step
from crisalad_jax.utils.errors import InputError
from tests.conftest import RECIPE
from tests.nn.test_model import pictures

KIND = SinkhornDivergenceLoss(weight=0.7, margin=0.3, epsilon=0.2)
CONFIG = LossConfig(kind=KIND, miner="none")
LABELS = np.array([0, 0, 0, 1, 1, 2, 1])
VALID = np.array([True] * 6 + [False])


def batch(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors and local tokens of seven images, those of the last lost."""
    generator = np.random.default_rng(seed)
    descriptors = generator.standard_normal((7, 5))
    tokens = generator.standard_normal((7, 4, 3))
    tokens[6] = np.nan
    return descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True), tokens


def cost(x: np.ndarray, y: np.ndarray) -> float:
    """OT of uniform masses at its dual's maximum, by 400 iterations on potentials."""
    costs, size = ((x[:, None] - y) ** 2).sum(axis=-1), len(x)
    kernel = np.exp(-costs / KIND.epsilon)
    u, v = np.ones(size), np.ones(size)
    for _ in range(400):
        u = 1 / (kernel @ v / size)
        v = 1 / (kernel.T @ u / size)
    return KIND.epsilon * (np.log(u).mean() + np.log(v).mean())


def triplets(descriptors: np.ndarray, tokens: np.ndarray) -> tuple[float, list[list[int]]]:
    """The mean violation, and the triplets: image 5 has no positive, and 6 takes no part."""
    tokens = tokens / np.linalg.norm(tokens, axis=-1, keepdims=True)
    similarities, chosen, total = descriptors @ descriptors.T, [], 0.0
    for a in range(5):
        others = [i for i in range(6) if i != a]
        positive = min((i for i in others if LABELS[i] == LABELS[a]), key=similarities[a].item)
        negative = max((i for i in others if LABELS[i] != LABELS[a]), key=similarities[a].item)
        chosen.append([a, positive, negative])
        x, y, z = tokens[chosen[-1]]
        near = cost(x, y) - (cost(x, x) + cost(y, y)) / 2
        far = cost(x, z) - (cost(x, x) + cost(z, z)) / 2
        total += max(KIND.margin + near - far, 0) / 5
    return total, chosen


@pytest.fixture
def _float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.mark.usefixtures("_float64")
def test_value_and_gradient_by_a_loop() -> None:
    descriptors, tokens = map(jnp.asarray, batch())
    plain = LossConfig(kind="multi-similarity", miner="none")
    shared = {"valid": jnp.asarray(VALID)}

    @jax.jit
    @jax.value_and_grad
    def added(tokens):
        arrays = descriptors, jnp.asarray(LABELS)
        found = metric_loss(*arrays, CONFIG, tokens=tokens, **shared)
        return (found.loss - metric_loss(*arrays, plain, **shared).loss) / KIND.weight

    found, gradient = added(tokens)
    expected, chosen = triplets(*batch())
    assert len(chosen) == 5
    # The solver stops at a marginal error of 1e-4, of which the dual's is the square; 1e-3 is far
    # below what another pair, mass or margin would change.
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_array_equal(gradient[6], 0)
    generator = np.random.default_rng(1)
    towards = 1e-5 * generator.standard_normal(tokens.shape)
    ends = [triplets(np.asarray(descriptors), np.asarray(tokens) + s * towards)[0] for s in (1, -1)]
    # Danskin's gradient is off by as much as the marginals are.
    slope = float((gradient * towards)[:6].sum())
    assert abs(slope) > 1e-7
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2, rtol=1e-3)


def test_what_it_cannot_compare_is_told() -> None:
    descriptors, tokens = (np.asarray(part[:6], np.float32) for part in batch())
    for given in (None, jnp.asarray(tokens[:, :0])):
        with pytest.raises(
            InputError, match=r"^loss sinkhorn-divergence: found no tokens, expected the agg"
        ):
            metric_loss(jnp.asarray(descriptors), jnp.asarray(LABELS[:6]), CONFIG, tokens=given)
    assert KIND.from_scratch() == dataclasses.replace(KIND, base=0.5)


@pytest.mark.slow
def test_a_step_trains_the_tokens() -> None:
    """SALAD's clusters; the global token has no gradient of the triplets, whose margin is large."""
    loss = LossConfig(kind=SinkhornDivergenceLoss(weight=1e3, margin=10.0), miner="none")
    config = dataclasses.replace(RECIPE, loss=loss, trainable="aggregator,-adapters,-cross_image")
    static = step_config(config, steps=2)
    params = cj.init_crisalad(jax.random.key(0), config.model)
    state, frozen = init_train_state(params, config.trainable, static)
    images, labels = pictures(4), jnp.array([0, 0, 1, 1])
    _, metrics = train_step(
        state, frozen, images, labels, np.ones(4, bool), jax.random.key(1), static
    )
    numbers = named_scalars(metrics)
    gap = numbers["loss.positive_divergence"] - numbers["loss.negative_divergence"]
    assert numbers["loss.negative_divergence"] > 0
    # All margins of 10 are violated, so that the mean is of the differences: the rest is the
    # multi-similarity loss, of order 1, next to 1e4.
    assert numbers["loss"] == pytest.approx(1e3 * (10 + gap), abs=5)
    assert numbers["gradient_norm"] > 1
