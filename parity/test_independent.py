"""Compare with independent libraries: Hugging Face's transformers and torch's encoder.

Weights are random and reach transformers through files, both ways, so that transformers supplies
the public names. Errors are the norm of the difference over the norm, array by array. In float32
the bounds are those of the stored outputs (test_goldens.py), 1e-5, and 1e-4 on gradients: eight and
twenty times the errors measured here, 1.2e-6 and 5e-6, from roundings of 6e-8 along two blocks and
back. A wrong constant or axis shows at 1e-3 and more.
"""

import copy
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from pytorch_metric_learning.distances import CosineSimilarity, DotProductSimilarity
from pytorch_metric_learning.losses import MultiSimilarityLoss
from pytorch_metric_learning.miners import MultiSimilarityMiner
from safetensors.numpy import load_file
from torch import Tensor, nn
from torch.nn import functional as F
from transformers import (
    Dinov2Config,
    Dinov2Model,
    Dinov2WithRegistersConfig,
    Dinov2WithRegistersModel,
)

from crisalad_jax.checkpoints.formats import to_state
from crisalad_jax.checkpoints.formats.families import TABLES
from crisalad_jax.checkpoints.public import read_checkpoint, write_checkpoint
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.training.trainable import merge_params
from parity.test_goldens import (
    GRADIENT_BOUND,
    NO_GRADIENT,
    OUTPUT_BOUND,
    golden_loss,
    part_names,
    relative_error,
)

PATCH = 14
SIDE = 6
"""Side of the stored grid of positions; 4 x 9 is another grid with the same number of patches."""
FILE = "model.safetensors"


class Kind(NamedTuple):
    """A model of transformers, and our configuration fields for it."""

    registers: int
    gated: bool


KINDS = [Kind(registers, gated) for registers in (0, 4) for gated in (False, True)]
GRIDS = [(4, 9), (9, 7), (3, 4)]
NATIVE = (SIDE, SIDE)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Use one thread, because the arrays are too small to split."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def hugging_face(kind: Kind) -> Any:
    """Make a model of two blocks with random parameters, none at its initial value."""
    torch.manual_seed(0)
    sizes: dict[str, Any] = {
        "hidden_size": 128,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "image_size": SIDE * PATCH,
        "patch_size": PATCH,
        "use_swiglu_ffn": kind.gated,
        "attn_implementation": "eager",
    }
    if kind.registers:
        config = Dinov2WithRegistersConfig(**sizes, num_register_tokens=kind.registers)
        model: Any = Dinov2WithRegistersModel(config)
    else:
        model = Dinov2Model(Dinov2Config(**sizes))
    shake(model)
    return model.eval()


def shake(module: nn.Module) -> None:
    """Add noise to every parameter, with gains around 1 and outputs of the size of their inputs."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)


def expected_config(kind: Kind) -> ModelConfig:
    backbone = ViTConfig(
        dim=128,
        depth=2,
        heads=2,
        ffn="swiglu" if kind.gated else "mlp",
        registers=kind.registers,
        position_grid=SIDE,
        adapter="none",
    )
    return ModelConfig(
        backbone=backbone,
        aggregator=ClassTokenConfig(),
        cross_image="none",
    )


def saved(model: Any, folder: pathlib.Path) -> pathlib.Path:
    """Save the file that transformers publishes; its names differ from those of the modules."""
    model.save_pretrained(folder)
    return folder / FILE


def gradients_by_public_name(model: Any, folder: pathlib.Path) -> dict[str, np.ndarray]:
    """Return gradients, saved in place of parameters so that transformers renames them."""
    holder = copy.deepcopy(model)
    with torch.no_grad():
        for target, source in zip(holder.parameters(), model.parameters(), strict=True):
            target.copy_(torch.zeros_like(source) if source.grad is None else source.grad)
    return load_file(saved(holder, folder))


def interpolate_as_published(model: Any) -> None:
    """Give transformers' model without registers the offset of DINOv2's.

    facebookresearch/dinov2 passes the scale (size + 0.1) / side to torch, so that a size is never
    rounded down; transformers passes the size, which means the scale size / side. With registers,
    both pass the size, with antialiasing.
    """

    def positions(_: Tensor, height: int, width: int) -> Tensor:
        first, rest = model.embeddings.position_embeddings.split([1, SIDE**2], dim=1)
        scale = tuple((side // PATCH + 0.1) / SIDE for side in (height, width))
        maps = rest.mT.unflatten(2, (SIDE, SIDE))
        maps = F.interpolate(maps, scale_factor=scale, mode="bicubic")
        return torch.cat([first, maps.flatten(2).mT], dim=1)

    model.embeddings.interpolate_pos_encoding = positions


def pixels(grid: tuple[int, int]) -> np.ndarray:
    shape = (2, grid[0] * PATCH, grid[1] * PATCH, 3)
    return np.random.default_rng(0).standard_normal(shape, np.float32)


def their_features(model: Any, images: Tensor, registers: int) -> dict[str, Tensor]:
    tokens = model(images.permute(0, 3, 1, 2)).last_hidden_state
    return {"class_token": tokens[:, 0], "patches": tokens[:, 1 + registers :]}


def our_features(params: Crisalad, images: Any, config: ModelConfig) -> dict[str, jax.Array]:
    return config.backbone.apply(params.backbone, images)[0]._asdict()


def torch_loss(outputs: dict[str, Tensor]) -> Tensor:
    """Compute `golden_loss` in torch."""
    return torch.stack([torch.sin(3 * output).sum() for output in outputs.values()]).sum()


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_names_are_transformers_own(kind: Kind, tmp_path: pathlib.Path) -> None:
    """Converting its file to ours and back is lossless, and it loads our file bit for bit."""
    model = hugging_face(kind)
    path = saved(model, tmp_path)
    theirs = load_file(path)
    found = read_checkpoint(path)
    assert found.format == "huggingface"
    assert found.config == expected_config(kind)
    state = to_state(found.params, found.config, "huggingface", found.extras)
    assert state.keys() == theirs.keys()
    for name, array in theirs.items():
        np.testing.assert_array_equal(state[name], array)

    path.unlink()
    write_checkpoint(path, found.params, found.config, "huggingface", found.extras)
    loaded, report = type(model).from_pretrained(
        tmp_path, local_files_only=True, output_loading_info=True
    )
    assert not any(report.values()), report
    parameters = dict(model.named_parameters())
    assert dict(loaded.named_parameters()).keys() == parameters.keys()
    for name, parameter in loaded.named_parameters():
        assert torch.equal(parameter, parameters[name]), name


@pytest.mark.parametrize(
    ("kind", "grid"),
    [(kind, NATIVE) for kind in KINDS]
    + [(Kind(registers, gated=False), grid) for registers in (0, 4) for grid in GRIDS],
    ids=str,
)
def test_vit_is_transformers(kind: Kind, grid: tuple[int, int], tmp_path: pathlib.Path) -> None:
    """Features and all gradients."""
    model = hugging_face(kind)
    found = read_checkpoint(saved(model, tmp_path))
    if not kind.registers and grid != NATIVE:
        interpolate_as_published(model)
    images = torch.tensor(pixels(grid), requires_grad=True)
    theirs = their_features(model, images, kind.registers)
    torch_loss(theirs).backward()
    assert images.grad is not None

    def loss(params: Crisalad, x: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        outputs = our_features(params, x, found.config)
        return golden_loss(outputs), outputs

    (params_gradient, gradient), ours = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(
        found.params, jnp.asarray(pixels(grid))
    )
    for name, output in theirs.items():
        assert relative_error(ours[name], output.detach()) < OUTPUT_BOUND, name
    assert relative_error(gradient, images.grad) < GRADIENT_BOUND
    expected = gradients_by_public_name(model, tmp_path)
    actual = to_state(params_gradient, found.config, "huggingface", extras={})
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        if name.endswith(NO_GRADIENT):
            assert not array.any()
        elif name.endswith("key.bias"):
            # Softmax absorbs it: rounding noise compared with the queries' bias.
            scale = np.linalg.norm(expected[name.replace("key", "query")])
            assert np.linalg.norm(array) < GRADIENT_BOUND * scale, name
            assert np.linalg.norm(actual[name]) < GRADIENT_BOUND * scale, name
        else:
            assert relative_error(actual[name], array) < GRADIENT_BOUND, name


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_transformers_interpolates_without_the_offset(
    grid: tuple[int, int], tmp_path: pathlib.Path
) -> None:
    """transformers deviates from DINOv2, and from ours, by more than a hundred times the bound.

    So the test above detects the offset that `interpolate_as_published` restores. If this test
    fails, transformers has adopted the offset, and neither is needed any more.
    """
    model = hugging_face(Kind(0, gated=False))
    found = read_checkpoint(saved(model, tmp_path))
    ours = our_features(found.params, jnp.asarray(pixels(grid)), found.config)
    images = torch.from_numpy(pixels(grid))
    with torch.no_grad():
        theirs = their_features(model, images, 0)
    for name, output in theirs.items():
        assert relative_error(ours[name], output) > 100 * OUTPUT_BOUND, name  # 3e-3 to 1e-2


def test_training_is_that_of_the_libraries(tmp_path: pathlib.Path) -> None:
    """Compare 20 steps of `train_step` with a training that uses none of our code.

    There, the model is from transformers, the miner and loss from pytorch-metric-learning, and
    AdamW and its linear decay from torch. It runs in float64, because AdamW would otherwise turn
    the signs of rounding noise into steps. Bytes of 0 and 255, and a rate and decay steps that are
    powers of 2, are exact in every precision.
    """
    steps, planned, rate, weight_decay = 20, 32, 2**-10, 0.5
    labels = np.array([0, 0, 1, 1, 2, 2], np.int32)
    rng = np.random.default_rng(0)
    shape = (SIDE * PATCH, SIDE * PATCH, 3)
    batches = []
    for _ in range(steps):
        places = rng.random((3, *shape))[labels]
        noise = rng.random((len(labels), *shape))
        batches.append(255 * (0.4 * places + 0.6 * noise > 0.5).astype(np.uint8))

    kind = Kind(4, gated=True)
    model = hugging_face(kind)
    found = read_checkpoint(saved(model, tmp_path))
    start = load_file(tmp_path / FILE)
    model.double()
    imagenet = [[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]]
    mean, deviation = torch.tensor(imagenet, dtype=torch.float64)
    miner = MultiSimilarityMiner(0.1, distance=CosineSimilarity())
    loss_of = MultiSimilarityLoss(
        1, 50, 0.5, distance=DotProductSimilarity(normalize_embeddings=False)
    )
    optimiser = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=weight_decay)
    decay = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.0, total_iters=planned)
    their_losses = []
    for images in batches:
        normalised = (torch.from_numpy(images).double() / 255 - mean) / deviation
        features = their_features(model, normalised, kind.registers)
        descriptors = F.normalize(features["class_token"], dim=-1)
        targets = torch.from_numpy(labels)
        loss = loss_of(descriptors, targets, miner(descriptors, targets))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        decay.step()
        their_losses.append(loss.item())
    theirs = load_file(saved(model, tmp_path))

    with jax.enable_x64(True):
        config = StepConfig(
            dataclasses.replace(found.config, compute_dtype="float64"),
            LossConfig(pml_compat=True, kind=MultiSimilarityConfig(base=0.5)),
            OptimiserConfig(learning_rate=rate, weight_decay=weight_decay),
            planned,
        )
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), found.params)
        state, frozen = init_train_state(params, "all", config)
        our_losses = []
        for images in batches:
            arrays = (jnp.asarray(x) for x in (images, labels, np.ones(len(labels), bool)))
            state, metrics = train_step(state, frozen, *arrays, jax.random.key(0), config)
            our_losses.append(float(metrics.loss))
        final = jax.tree.map(np.asarray, merge_params(state.trainable, frozen, config.model))
    ours = to_state(final, config.model, "huggingface", found.extras)
    # Measured 1e-14; float32 anywhere would show at 1e-8.
    np.testing.assert_allclose(our_losses, their_losses, rtol=1e-12)
    assert ours.keys() == theirs.keys()
    for name, array in theirs.items():
        way = np.linalg.norm(array - start[name])
        if name.endswith("mask_token"):
            assert way == 0
            np.testing.assert_array_equal(ours[name], array)
            continue
        # Relative to the distance from the start, at least 0.7% of the arrays' norms. Measured
        # 4e-13, and 1e-9 for what softmax absorbs: its gradients are noise, but not negligible
        # compared with AdamW's epsilon of 1e-8.
        assert way > 5e-3 * np.linalg.norm(array), name
        bound = 1e-7 if name.endswith("key.bias") else 1e-10
        assert np.linalg.norm(ours[name] - array) < bound * way, name


def test_masked_encoder_is_torchs() -> None:
    """Outputs and all gradients with an asymmetric mask; the goldens test it without a mask."""
    config = CrossImageConfig(layers=2, heads=4, feedforward=24)
    layer = nn.TransformerEncoderLayer(16, 4, 24, activation="gelu")
    encoder = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).eval()
    shake(encoder)
    template = jax.eval_shape(lambda key: config.init(key, 16), jax.random.key(0))
    names = part_names(TABLES["encoder"], template, "cross_image.", "encoder.")
    params = names.ours({name: x.numpy() for name, x in encoder.state_dict().items()})
    mask = np.tri(5, dtype=bool)
    mask[1, 3] = True
    start = np.random.default_rng(0).standard_normal((5, 3, 16), np.float32)

    tokens = torch.tensor(start, requires_grad=True)
    theirs = encoder(tokens, mask=torch.from_numpy(~mask))
    torch_loss({"tokens": theirs}).backward()
    assert tokens.grad is not None

    def loss(params: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        output = config.apply(params, x, mask=jnp.asarray(mask), key=None)
        return golden_loss(output), output

    (params_gradient, gradient), ours = jax.grad(loss, argnums=(0, 1), has_aux=True)(
        params, jnp.asarray(start)
    )
    assert relative_error(ours, theirs.detach()) < OUTPUT_BOUND
    assert relative_error(gradient, tokens.grad) < GRADIENT_BOUND
    actual = names.theirs(params_gradient)
    expected = dict(encoder.named_parameters())
    assert actual.keys() == expected.keys()
    for name, parameter in expected.items():
        assert parameter.grad is not None
        assert relative_error(actual[name], parameter.grad) < GRADIENT_BOUND, name
