"""Compare AnyLoc's facets, ours and the torch reference's, with Hugging Face's Dinov2Model."""

import dataclasses
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.checkpoints.formats import to_state
from crisalad_jax.checkpoints.public import read_checkpoint
from crisalad_jax.nn.backbones import Features, FeatureSpec
from crisalad_jax.nn.model import Crisalad
from parity.reference.model import Crisalad as TorchCrisalad
from parity.test_goldens import OUTPUT_BOUND
from parity.test_independent import (
    NATIVE,
    Kind,
    hugging_face,
    one_thread,  # noqa: F401  (used by itself)
    pixels,
    saved,
)


def their_facets(model: Any, images: torch.Tensor, number: int) -> dict[str, np.ndarray]:
    """Return outputs of its linear layers and its block, with class token and registers."""
    layer = model.encoder.layer[number]
    found: dict[str, np.ndarray] = {}

    def keep(name: str) -> Any:
        def hook(_: Any, __: Any, output: Any) -> None:
            tokens = output[0] if isinstance(output, tuple) else output
            found[name] = tokens.detach().numpy()

        return hook

    inner = layer.attention
    sources = {"query": inner.q_proj, "key": inner.k_proj, "value": inner.v_proj, "token": layer}
    handles = [part.register_forward_hook(keep(name)) for name, part in sources.items()]
    with torch.no_grad():
        model(images.permute(0, 3, 1, 2))
    for handle in handles:
        handle.remove()
    return found


def assert_close(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.shape == expected.shape
    error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    assert error < OUTPUT_BOUND  # the bound of all stored outputs: roundings along two blocks


@pytest.mark.parametrize(
    ("kind", "number"), [(Kind(0, gated=False), 1), (Kind(4, gated=True), 0)], ids=str
)
def test_facets_are_transformers(kind: Kind, number: int, tmp_path: pathlib.Path) -> None:
    model = hugging_face(kind)
    checkpoint = read_checkpoint(saved(model, tmp_path))
    params, config = checkpoint.params, checkpoint.config
    images = pixels(NATIVE)
    theirs = their_facets(model, torch.from_numpy(images), number)
    reference = reference_of(params, config)
    first = 1 + kind.registers

    @jax.jit
    def all_of(images: jax.Array) -> dict[str, Features]:
        def one(name: Any) -> Features:
            request = FeatureSpec((number + 1,), name, norm=False)
            return config.backbone.apply(params.backbone, images, request)[0]

        return {name: one(name) for name in theirs}

    ours = all_of(jnp.asarray(images))
    channels_first = torch.from_numpy(images).permute(0, 3, 1, 2)
    for name, expected in theirs.items():
        assert_close(np.asarray(ours[name].patches), expected[:, first:])
        assert_close(np.asarray(ours[name].class_token), expected[:, 0])
        with torch.no_grad():
            again = reference.backbone.facet(channels_first, number, name)
        assert_close(again.patches.flatten(2).mT.numpy(), expected[:, first:])
        assert_close(again.class_token.numpy(), expected[:, 0])


def reference_of(params: Crisalad, config: Any) -> TorchCrisalad:
    reference = TorchCrisalad(dataclasses.replace(config, image_size=(84, 84)))
    state = to_state(params, config, "reference", {})
    reference.load_state_dict({name: torch.tensor(array) for name, array in state.items()})
    return reference.eval()
