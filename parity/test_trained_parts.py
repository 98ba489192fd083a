"""Compare partially trained models over DINOv2: BoQ's last block, EDTformer's side adapters.

Descriptors, and the gradients of only that part, are compared with torch, with the rest frozen. In
float64 both sides agree up to some hundred roundings of 1e-16; a gradient that runs through a
frozen block, or stops at one that trains, is wrong by its own size.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax import describe
from crisalad_jax.checkpoints.formats import to_params, to_state
from crisalad_jax.nn.adapters import Adapter
from crisalad_jax.nn.adapters.bottleneck import SideConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig, EdtFormerConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.trainable import merge_params, split_params
from parity.cases.case import LAYOUT
from parity.cases.weights import random_state
from parity.reference.edtformer import EdtFormer
from parity.reference.model import Crisalad

BOUND = 1e-11
"""Three thousand times the float64 error here, 3e-15; the float32 error would be 1e-7."""
SIZE = (42, 56)


def model_of(aggregator: Any, adapter: Adapter | str) -> ModelConfig:
    return ModelConfig(
        image_size=SIZE,
        backbone=ViTConfig(dim=64, depth=2, heads=1, position_grid=3, adapter=adapter),
        aggregator=aggregator,
        cross_image="none",
        compute_dtype="float64",
    )


BOQ = model_of(BoqConfig(channels=64, queries=3, layers=1, rows=5), "none")
EDTFORMER = model_of(
    EdtFormerConfig(width=32, heads=4, queries=6, channels=10, rows=5),
    SideConfig(bottleneck=4 / 64, alpha=0.5),
)
MODELS = {
    "BoQ": (BOQ, "last-1-blocks,norm,head", lambda: Crisalad(BOQ)),
    "EDTformer": (
        EDTFORMER,
        "adapters,head",
        lambda: EdtFormer(EDTFORMER.backbone, EDTFORMER.aggregator),
    ),
}
TRAINED = {
    "last-1-blocks,norm,head": ("backbone.norm.", "backbone.blocks.1."),
    "adapters,head": ("backbone.adapters.",),
}
"""The part of the backbone that trains. BoQ doesn't use the last norm, so it has no gradient."""


@pytest.mark.parametrize("name", MODELS)
def test_gradients_of_what_trains_are_torchs(name: str) -> None:
    config, trainable, make = MODELS[name]
    rng = np.random.default_rng(0)
    model = make().double().eval()
    shapes = {key: tuple(tensor.shape) for key, tensor in model.state_dict().items()}
    state = random_state(shapes, rng)
    model.load_state_dict({key: torch.from_numpy(array) for key, array in state.items()})
    for key, parameter in model.named_parameters():
        parameter.requires_grad_(
            not key.startswith("backbone.") or key.startswith(TRAINED[trainable])
        )
    images = rng.normal(size=(2, *SIZE, 3))
    slopes = rng.normal(size=(2, config.descriptor_dim))
    theirs = model(torch.from_numpy(images).permute(0, 3, 1, 2))
    (theirs * torch.from_numpy(slopes)).sum().backward()
    expected = {n: p.grad.numpy() for n, p in model.named_parameters() if p.grad is not None}

    with jax.enable_x64(True):
        wide = {key: array.astype(np.float64) for key, array in state.items()}
        params, _ = to_params(wide, config, LAYOUT, source="the torch reference")
        trained, frozen = split_params(jax.tree.map(jnp.asarray, params), config, trainable)

        def weighed(trained: Any) -> tuple[jax.Array, jax.Array]:
            found = describe(merge_params(trained, frozen, config), jnp.asarray(images), config)
            return (found * slopes).sum(), found

        gradients, found = jax.jit(jax.grad(weighed, has_aux=True))(trained)
        whole = merge_params(gradients, jax.tree.map(jnp.zeros_like, frozen), config)
        ours = to_state(whole, config, LAYOUT, {})
    np.testing.assert_allclose(found, theirs.detach().numpy(), rtol=0, atol=BOUND)
    assert {key for key, array in ours.items() if array.any()} == expected.keys()
    for key, gradient in expected.items():
        error = np.linalg.norm(ours[key] - gradient)
        assert error < BOUND * np.linalg.norm(gradient), key
