"""Compare FoL with a torch model under the public names, and its attention with transformers'."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax import describe
from crisalad_jax.checkpoints.formats import infer, to_params, to_state
from crisalad_jax.checkpoints.public import read_checkpoint
from crisalad_jax.nn.aggregators.salad import FolConfig
from crisalad_jax.nn.backbones import FeatureSpec
from crisalad_jax.nn.backbones.vit import ViTConfig
from parity.reference.vit import Block, ViT, grid_of
from parity.test_goldens import OUTPUT_BOUND, relative_error
from parity.test_independent import (
    KINDS,
    NATIVE,
    Kind,
    hugging_face,
    one_thread,  # noqa: F401  (used by itself)
    pixels,
    saved,
    shake,
)

BACKBONE = ViTConfig(dim=128, depth=3, heads=2, position_grid=5, adapter="none")
HEAD = FolConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=24, local_hidden=12, local=8)


class TorchFol(nn.Module):
    """The whole network, with the names of the public file."""

    def __init__(self) -> None:
        super().__init__()
        dim, hidden = BACKBONE.dim, HEAD.hidden

        def network(d_out: int) -> nn.Sequential:
            first, last = nn.Conv2d(dim, hidden, 1), nn.Conv2d(hidden, d_out, 1)
            return nn.Sequential(first, nn.Dropout(), nn.ReLU(), last)

        self.backbone = nn.ModuleDict({"model": ViT(BACKBONE)})
        self.aggregator = nn.ModuleDict(
            {
                "token_features": nn.Sequential(
                    nn.Linear(dim, hidden), nn.ReLU(), nn.Linear(hidden, HEAD.token_dim)
                ),
                "cluster_features": network(HEAD.cluster_dim),
                "score": network(HEAD.clusters),
            }
        )
        self.upconv = nn.ConvTranspose2d(dim, HEAD.local_hidden, 3, stride=2, padding=1)
        self.upconv2 = nn.ConvTranspose2d(HEAD.local_hidden, HEAD.local, 3, stride=2, padding=1)

    def attention(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the class token's attention to each patch in the last block, and its output."""
        model, grid = self.backbone["model"], grid_of(images)
        assert isinstance(model, ViT)
        tokens = model.embed(images)
        for block in model.blocks[:-1]:
            tokens = block(tokens, grid)
        last = model.blocks[-1]
        assert isinstance(last, Block)
        query, key, _ = last.attn.qkv(last.norm1(tokens)).chunk(3, dim=-1)
        found = torch.zeros(len(images), tokens.shape[1])
        for of_head in range(BACKBONE.heads):
            here = slice(of_head * 64, (of_head + 1) * 64)
            scores = torch.einsum("bd,bnd->bn", query[:, 0, here], key[:, :, here]) / 8
            found += scores.softmax(dim=-1)
        return found[:, 1:], model.norm(last(tokens, grid))

    def forward(self, images: Tensor) -> Tensor:
        """Map (batch, 3, height, width) to unit descriptors."""
        attention, tokens = self.attention(images)
        maps = tokens[:, 1:].mT.unflatten(-1, grid_of(images))
        score = self.aggregator["score"](maps).flatten(2)
        dustbin = 1 - attention * (attention >= 0.01)
        # Sinkhorn in the scaling domain: one row per cluster, the dustbin last.
        kernel = torch.cat([score, dustbin[:, None]], dim=1).double().exp()
        clusters, patches = score.shape[1:]
        masses = torch.tensor([1.0] * clusters + [patches - clusters]).double()
        of_patch = torch.ones(len(images), patches).double()
        for _ in range(3):
            of_row = masses / torch.einsum("bkn,bn->bk", kernel, of_patch)
            of_patch = 1 / torch.einsum("bkn,bk->bn", kernel, of_row)
        plan = (of_row[..., None] * kernel * of_patch[:, None])[:, :-1].float()
        local = self.aggregator["cluster_features"](maps).flatten(2)
        sums = F.normalize(torch.einsum("bdn,bkn->bdk", local, plan), dim=1)
        whole = F.normalize(self.aggregator["token_features"](tokens[:, 0]), dim=-1)
        return F.normalize(torch.cat([whole, sums.flatten(1)], dim=1), dim=1)


@pytest.mark.parametrize("dust_bin", [True, False])
def test_descriptors_are_torchs_and_tensors_come_back(dust_bin: bool) -> None:
    torch.manual_seed(0)
    model = TorchFol().eval()
    shake(model)
    state = {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}
    if dust_bin:  # as in some files, where it is before the networks
        names = list(state)
        at = names.index("aggregator.token_features.0.weight")
        names.insert(at, "aggregator.dust_bin")
        state["aggregator.dust_bin"] = np.array(0.7, np.float32)
        state = {name: state[name] for name in names}
    layout, config = infer(state, source="FoL")
    assert layout == "fol"
    assert (config.backbone, config.image_size) == (BACKBONE, (504, 504))
    assert config.aggregator == dataclasses.replace(HEAD, dropout=config.aggregator.dropout)

    params, extras = to_params(state, config, layout, source="FoL")
    back = to_state(params, config, layout, extras)
    assert list(back) == list(state)
    for name, array in state.items():
        np.testing.assert_array_equal(back[name], array)

    images = pixels((4, 9))
    channels_first = torch.from_numpy(images).permute(0, 3, 1, 2)
    with torch.no_grad():
        expected = model(channels_first).numpy()
        attention, _ = model.attention(channels_first)
    # Some patches are below the threshold, and some above.
    assert 0 < (attention < 0.01).float().mean() < 1
    params = jax.tree.map(jnp.asarray, params)
    found = describe(params, jnp.asarray(images), config)
    assert relative_error(found, expected) < OUTPUT_BOUND


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_the_class_tokens_attention_is_transformers(kind: Kind, tmp_path: pathlib.Path) -> None:
    model = hugging_face(kind)
    checkpoint = read_checkpoint(saved(model, tmp_path))
    images = pixels(NATIVE)
    with torch.no_grad():
        weights = model(torch.from_numpy(images).permute(0, 3, 1, 2), output_attentions=True)
    expected = weights.attentions[-1][:, :, 0, 1 + kind.registers :].sum(dim=1).numpy()
    request = FeatureSpec(class_attention=True)
    backbone: ViTConfig = checkpoint.config.backbone  # pyright: ignore[reportAssignmentType]

    @jax.jit
    def features(images: jax.Array) -> tuple[jax.Array, ...]:
        asked, _ = backbone.apply(checkpoint.params.backbone, images, request)
        plain, _ = backbone.apply(checkpoint.params.backbone, images)
        assert asked.class_attention is not None
        assert plain.class_attention is None
        return asked.class_attention, asked.patches - plain.patches

    found, change = features(jnp.asarray(images))
    assert relative_error(found, expected) < OUTPUT_BOUND
    # Returning attention changes features only by float32 rounding of a differently split program.
    assert float(jnp.abs(change).max()) < 1e-4
