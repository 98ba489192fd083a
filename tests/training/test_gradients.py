"""Norms of a gradient, part by part, against `jax.grad` and a step of training."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from crisalad_jax.nn.model import describe
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.gradients import gradient_norms
from crisalad_jax.training.losses import LossConfig, metric_loss
from crisalad_jax.training.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.training.step import init_train_state, make_train_step, step_config
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import MODEL, random_params
from tests.nn.test_model import pictures

LOSS = LossConfig(kind=MultiSimilarityConfig(base=0.5))
CONFIG = TrainConfig(model=MODEL, loss=LOSS, trainable="all")
PARAMS, IMAGES, LABELS = random_params(MODEL), pictures(6), np.array([0, 0, 1, 1, 2, 2])
CUT = "adapters,head,backbone.blocks.1.attn,backbone.cls_token"
ADAPTERS = ["backbone.blocks.0.adapter", "backbone.blocks.1.adapter"]
BLOCKS = ["backbone.blocks.0", "backbone.blocks.1", *ADAPTERS, "backbone.norm"]
HEAD = ["aggregator", "cross_image"]


@pytest.fixture(scope="module")
def gradient() -> dict[str, np.ndarray]:
    """Of the whole model, without dropout."""

    def loss(params):
        return metric_loss(describe(params, IMAGES, MODEL), jnp.asarray(LABELS), LOSS).loss

    return {name: np.asarray(leaf) for name, leaf in named_leaves(jax.grad(loss)(PARAMS)).items()}


def by_hand(gradient: dict[str, np.ndarray], part: str, of_block: str) -> float:
    """The norm of a part; of a block only of its parameters below `of_block`."""
    block = re.fullmatch(r"backbone\.blocks\.(\d+)(\.adapter)?", part)
    start, rows = part, ...
    if block is not None:
        start, rows = f"backbone.blocks{block[2] or of_block}", int(block[1])
    total = 0.0
    for name, leaf in gradient.items():
        is_other = start == "backbone.blocks" and ".adapter." in name
        if f"{name}.".startswith(f"{start}.") and not is_other:
            total += np.sum(leaf[rows].astype(float) ** 2)
    return float(np.sqrt(total))


@pytest.mark.parametrize(
    ("trainable", "parts", "of_block"),
    [
        pytest.param(
            *("all", ["backbone.patch_embed", "backbone.cls_token", *BLOCKS, *HEAD], ""),
            marks=pytest.mark.slow,
        ),
        (CUT, ["backbone.cls_token", "backbone.blocks.1", *ADAPTERS, *HEAD], ".attn"),
    ],
)
def test_norms_are_those_of_jax_grad(gradient, trainable, parts, of_block) -> None:
    """All blocks in one stack, and a stack that is cut where blocks differ in what trains."""
    config = dataclasses.replace(CONFIG, trainable=trainable)
    found = gradient_norms(PARAMS, IMAGES, LABELS, config)
    assert [part for part in found if not part.startswith("backbone.pos_embed")] == parts
    expected = {part: by_hand(gradient, part, of_block) for part in found}
    assert min(expected.values()) > 1e-6
    # Sums of float32 products that two programs take in other orders.
    assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_squares_add_up_to_those_of_a_steps_gradient() -> None:
    """With the step's dropout, whose key is folded with the step's number."""
    config, key = dataclasses.replace(CONFIG, trainable="adapters,head"), jax.random.key(1)
    static = step_config(config, steps=1, optimiser=optax.sgd(0.1))
    state, frozen = init_train_state(PARAMS, config.trainable, static)
    _, metrics = make_train_step(static)(state, frozen, IMAGES, LABELS, key)
    found = gradient_norms(PARAMS, IMAGES, LABELS, config, key=jax.random.fold_in(key, 0))
    total = np.sqrt(np.sum(np.square(list(found.values()))))
    assert total == pytest.approx(float(metrics.gradient_norm), rel=1e-5)


def test_a_loss_with_classes_is_refused() -> None:
    config = dataclasses.replace(CONFIG, loss=LossConfig(kind=LargeMarginCosineConfig()))
    with pytest.raises(InputError, match="and, where it classifies"):
        gradient_norms(PARAMS, IMAGES, LABELS, config, key=jax.random.key(0))
