"""The terms of distillation and their gradients, compared with torch's, written from their papers.

Values agree to 1e-5 relative and gradients to 1e-4 of the largest: float32 similarities of order 1
are divided by a temperature of 0.05.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from crisalad_jax.nn.layers import Linear
from crisalad_jax.training.losses import LossConfig, metric_loss
from crisalad_jax.training.losses.distil import DistilConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.utils.errors import InputError

IMAGES, DIM, TEACHER = 9, 6, 11


def only(**given: float) -> DistilConfig:
    """The loss with these weights, and no other term."""
    weights = {"cosine": 0.0, "relations": 0.0, "neighbours": 0.0} | given
    return DistilConfig(teacher_dim=TEACHER, **weights)  # pyright: ignore


LABELS = np.array([0, 0, 1, 1, 2, 2, 3, 3, 3])


def unit(seed: int, width: int) -> np.ndarray:
    x = np.random.default_rng(seed).standard_normal((IMAGES, width))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def loss_of(kind: DistilConfig, descriptors: jax.Array, **more: object) -> jax.Array:
    params = projection() if kind.cosine else None
    given = {"params": params, "targets": jnp.asarray(unit(1, TEACHER))} | more
    return metric_loss(descriptors, jnp.asarray(LABELS), LossConfig(kind=kind), **given).loss  # pyright: ignore


def projection() -> Linear:
    draw = np.random.default_rng(2).standard_normal
    weight, bias = (jnp.asarray(draw(shape), jnp.float32) for shape in ((DIM, TEACHER), TEACHER))
    return Linear(weight, bias)


def by_torch(term: str, ours: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
    others = ~torch.eye(IMAGES, dtype=torch.bool)
    if term == "cosine":
        weight, bias = (torch.from_numpy(np.array(x)) for x in jax.tree.leaves(projection()))
        return 1 - F.cosine_similarity(ours @ weight + bias, theirs, dim=1).mean()
    if term == "relations":  # Park et al. 2019, equations 5 and 6
        pairs = [F.pdist(x) for x in (ours, theirs)]
        return F.smooth_l1_loss(*(each / each.mean() for each in pairs))
    shares = [
        torch.log_softmax((x @ x.T)[others].reshape(IMAGES, -1) / 0.05, dim=1)
        for x in (ours, theirs)
    ]
    return F.kl_div(*shares, log_target=True, reduction="batchmean")


@pytest.mark.parametrize("term", ["cosine", "relations", "neighbours"])
def test_a_term_is_torchs(term: str) -> None:
    kind = only(**{term: 0.7})
    raw = 3 * unit(0, DIM)  # our distances are those of unit vectors alone

    def loss(raw: jax.Array) -> jax.Array:
        return loss_of(kind, raw / jnp.linalg.norm(raw, axis=1, keepdims=True))

    found, gradient = jax.value_and_grad(loss)(jnp.asarray(raw))
    ours = torch.from_numpy(raw).requires_grad_()
    expected = 0.7 * by_torch(term, F.normalize(ours), torch.from_numpy(unit(1, TEACHER)))
    expected.backward()
    assert float(found) == pytest.approx(expected.item(), rel=1e-5)
    assert ours.grad is not None
    slope = ours.grad.numpy()
    np.testing.assert_allclose(gradient, slope, atol=1e-4 * np.abs(slope).max())


def test_labels_weigh_the_multi_similarity_loss() -> None:
    descriptors = jnp.asarray(unit(0, DIM))
    kind = LossConfig(kind=MultiSimilarityConfig(base=0.5))
    expected = metric_loss(descriptors, jnp.asarray(LABELS), kind).loss
    found = loss_of(only(labels=3.0), descriptors)
    assert float(found) == pytest.approx(3 * float(expected), rel=1e-6)  # one more product


def test_a_student_that_is_its_teacher_has_nothing_to_learn() -> None:
    kind = dataclasses.replace(only(relations=1.0, neighbours=1.0), teacher_dim=DIM)
    same = jnp.asarray(unit(0, DIM))
    value, gradient = jax.value_and_grad(lambda x: loss_of(kind, x, targets=same))(same)
    assert abs(float(value)) < 1e-6  # a difference of logarithms of order 10, in float32
    assert np.abs(gradient).max() < 1e-5


@pytest.mark.parametrize("term", ["cosine", "relations", "neighbours", "labels"])
def test_what_is_not_valid_takes_no_part(term: str) -> None:
    """Whatever its descriptors and targets are, NaN included."""
    kind, valid = only(**{term: 1.0}), np.arange(IMAGES) < 6
    ours, theirs = unit(0, DIM), unit(1, TEACHER)
    expected = metric_loss(
        jnp.asarray(ours[:6]),
        jnp.asarray(LABELS[:6]),
        LossConfig(kind=kind),
        params=projection() if kind.cosine else None,
        targets=jnp.asarray(theirs[:6]),
    ).loss
    ours[6:], theirs[6:] = np.nan, np.nan
    found, gradient = jax.value_and_grad(
        lambda x: loss_of(kind, x, targets=jnp.asarray(theirs), valid=jnp.asarray(valid))
    )(jnp.asarray(ours))
    assert float(found) == pytest.approx(float(expected), rel=1e-5)  # other sums, in float32
    assert np.isfinite(gradient).all()


def test_a_teacher_is_asked_for() -> None:
    with pytest.raises(InputError, match="loss distil: found no targets, expected a teacher's"):
        loss_of(DistilConfig(), jnp.asarray(unit(0, DIM)), targets=None)


def test_a_width_that_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match=r"targets: found shape \(9, 11\), expected \(9, 12\)"):
        loss_of(DistilConfig(teacher_dim=TEACHER + 1), jnp.asarray(unit(0, DIM)))
    with pytest.raises(InputError, match=r"DistilConfig.cosine: found 0.0, expected above 0, or"):
        only()
