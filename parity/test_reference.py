"""Compare the torch reference with the public implementations: outputs, gradients and names.

If a library has the same layer, the library is the reference: torch's transformer layers,
pytorch-metric-learning's miner and loss. Errors are the norm of the difference over the norm. Both
sides are torch's float32 kernels: bounds are ten to twenty of its roundings of 6e-8, and ten times
that on gradients; a wrong constant or axis shows at 1e-2 and more.
"""

import dataclasses
import itertools
import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
import pytest
import torch
from pytorch_metric_learning.distances import DotProductSimilarity
from pytorch_metric_learning.losses import MultiSimilarityLoss
from pytorch_metric_learning.miners import MultiSimilarityMiner
from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.nn.aggregators import Aggregator, TokenShape
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.gem import GemPyramidConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.sinkhorn import SinkhornConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.training.schedules import LinearSchedule
from crisalad_jax.utils.errors import InputError
from parity.reference.adapter import ConvNorm, MultiResolutionAdapter
from parity.reference.cross_image import CrossImageEncoder
from parity.reference.gem import UnitPatches
from parity.reference.losses import mine, multi_similarity_loss
from parity.reference.model import Crisalad
from parity.reference.pyramid import GemPyramid
from parity.reference.salad import Salad
from parity.reference.sinkhorn import assign_with_dustbin
from parity.reference.tokens import Tokens
from parity.reference.training import clip_gradients, freeze, learning_rate_factor, train
from parity.reference.vit import Features, ViT, grid_of

HERE = pathlib.Path(__file__).parent
OUTPUT_BOUND, GRADIENT_BOUND = 1e-6, 1e-5
NO_ADAPTER = "none"

MODEL = ModelConfig(
    image_size=(42, 56),
    backbone=ViTConfig(dim=32, depth=2, heads=2, position_grid=3),
    aggregator=SaladConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16, dropout=0.0),
    cross_image=CrossImageConfig(heads=2, feedforward=16, dropout=0.0),
)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Use one thread: the arrays are so small that splitting them takes longer than the work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def golden_of(name: str) -> dict[str, Tensor]:
    with np.load(HERE / "goldens" / f"{name}.npz") as file:
        return {key: torch.from_numpy(np.asarray(file[key])) for key in file}


def under(golden: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in golden.items() if k.startswith(prefix)}


def relative_error(ours: Tensor, theirs: Tensor) -> float:
    assert ours.shape == theirs.shape
    difference = (ours.double() - theirs.double()).norm() / theirs.double().norm()
    return difference.item()


def golden_loss(outputs: Mapping[str, Tensor]) -> Tensor:
    return torch.stack([torch.sin(3 * output).sum() for output in outputs.values()]).sum()


def check(
    module: nn.Module,
    golden: Mapping[str, Tensor],
    inputs: Mapping[str, Tensor],
    outputs: Mapping[str, Tensor],
    exempt: tuple[str, ...] = (),
) -> None:
    """Compare outputs, and the gradients to every parameter and input."""
    for name, output in outputs.items():
        assert relative_error(output, golden[f"out.{name}"]) < OUTPUT_BOUND, name
    golden_loss(outputs).backward()
    actual = {n: p.grad for n, p in module.named_parameters() if p.grad is not None}
    expected = under(golden, "grad.")
    assert actual.keys() == expected.keys()
    for name in expected.keys() - set(exempt):
        assert relative_error(actual[name], expected[name]) < GRADIENT_BOUND, name
    for name, x in inputs.items():
        assert x.grad is not None
        assert relative_error(x.grad, golden[f"gradin.{name}"]) < GRADIENT_BOUND, name


def ready(module: nn.Module, golden: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Load exactly the stored state, and return the inputs."""
    module.load_state_dict(under(golden, "state."), strict=True)
    module.eval()
    return {name: x.requires_grad_() for name, x in under(golden, "in.").items()}


@pytest.mark.parametrize(
    ("name", "registers"),
    [("dinov2_native_grid", 0), ("dinov2_interpolated_grid", 0), ("dinov2_registers", 4)],
)
def test_vit(name: str, registers: int) -> None:
    golden = golden_of(name)
    vit = ViT(
        ViTConfig(
            dim=48, depth=2, heads=3, registers=registers, position_grid=5, adapter=NO_ADAPTER
        )
    )
    inputs = ready(vit, golden)
    image = inputs["image"]
    features = vit(image)
    prenorm = vit.run_blocks(vit.embed(image), grid_of(image))
    outputs = {
        "x_norm_clstoken": features.class_token,
        "x_norm_patchtokens": features.patches.flatten(2).mT,
        "x_prenorm": prenorm,
        "x_norm_regtokens": vit.norm(prenorm)[:, 1 : 1 + registers],
    }
    check(vit, golden, inputs, {n: x for n, x in outputs.items() if f"out.{n}" in golden})


def test_multi_resolution_adapter() -> None:
    golden = golden_of("multiconv_adapter")
    adapter = MultiResolutionAdapter(48, 24)
    # The stored adapter narrows 24 channels to 4, not to a sixteenth.
    adapter.branch2 = nn.Sequential(ConvNorm(24, 4, 1), ConvNorm(4, 6, 3))
    adapter.branch3 = nn.Sequential(ConvNorm(24, 4, 1), ConvNorm(4, 6, 5))
    inputs = ready(adapter, golden)
    check(adapter, golden, inputs, {"tokens": adapter(inputs["tokens"], (5, 5))})


def test_salad() -> None:
    golden = golden_of("salad")
    config = SaladConfig(clusters=6, cluster_dim=8, token_dim=16, hidden=512)
    salad = Salad(48, config)
    inputs = ready(salad, golden)
    tokens = salad(Features(inputs["token"], inputs["features"]))
    model = Crisalad(
        ModelConfig(
            image_size=(56, 84),
            backbone=ViTConfig(dim=48, depth=1, heads=3, position_grid=5, adapter=NO_ADAPTER),
            aggregator=config,
            cross_image="none",
        )
    )
    # A cluster's potential absorbs a constant added to its scores: the dustbin's score and the
    # score network's last bias have no effect, and their gradients are rounding noise.
    dead = ("dust_bin", "score.3.bias")
    check(salad, golden, inputs, {"descriptor": model.attend_across_images(tokens)}, exempt=dead)
    plan = salad.transport(inputs["features"]).exp()
    assert relative_error(plan, golden["aux.assignment_with_dustbin"]) < OUTPUT_BOUND
    # float64 separates noise, which falls from 5e-7 to 1e-15, from a small effect, which remains.
    salad.double()
    salad.zero_grad()
    tokens = salad(Features(inputs["token"].double(), inputs["features"].double()))
    golden_loss({"descriptor": model.attend_across_images(tokens)}).backward()
    for name in dead:
        gradient = salad.get_parameter(name).grad
        assert gradient is not None
        assert gradient.abs().max() < 1e-13


@pytest.mark.parametrize("case", range(5))
def test_sinkhorn(case: int) -> None:
    golden = under(golden_of("sinkhorn"), f"{case}.")
    config, epsilon = SinkhornConfig(iterations=int(golden["num_iters"])), float(golden["reg"])
    scores, dust_bin = golden["scores"].requires_grad_(), torch.ones((), requires_grad=True)
    log_plan = assign_with_dustbin(scores, dust_bin, epsilon=epsilon, config=config)
    # With a regularisation of 0.1, scores and their roundings are ten times as large.
    assert relative_error(log_plan, golden["log_p"]) < OUTPUT_BOUND / min(epsilon, 1)
    golden_loss({"plan": log_plan.exp()}).backward()
    assert scores.grad is not None
    assert dust_bin.grad is not None
    assert relative_error(scores.grad, golden["grad_scores"]) < GRADIENT_BOUND
    # Noise around 0: the dustbin's potential absorbs its constant score.
    assert dust_bin.grad.abs() < 1e-5 * golden["grad_scores"].abs().sum()


def test_cross_image_encoder() -> None:
    golden = golden_of("cross_image_encoder")
    encoder = CrossImageEncoder(16, CrossImageConfig(layers=2, heads=4, feedforward=40))
    inputs = ready(encoder, golden)
    check(encoder, golden, inputs, {"tokens": encoder(inputs["tokens"])})


def test_masked_encoder_is_torchs() -> None:
    torch.manual_seed(0)
    config = CrossImageConfig(layers=2, heads=4, feedforward=40)
    layer = nn.TransformerEncoderLayer(16, 4, 40, activation="gelu")
    theirs = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).eval()
    ours = CrossImageEncoder(16, config).eval()
    ours.load_state_dict(theirs.state_dict(), strict=True)
    tokens = torch.randn(5, 7, 16)
    mask = torch.eye(5, dtype=torch.bool) | (torch.rand(5, 5) < 0.5)
    # Torch's mask marks the pairs that may not attend.
    assert relative_error(ours(tokens, mask), theirs(tokens, mask=~mask)) < OUTPUT_BOUND
    assert relative_error(ours(tokens, mask), ours(tokens)) > 1e-2


def test_dropout_is_drawn_in_training_alone() -> None:
    torch.manual_seed(0)
    encoder = CrossImageEncoder(16, CrossImageConfig(layers=1, heads=4, feedforward=40))
    salad = Salad(16, SaladConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16))
    tokens, features = torch.randn(3, 5, 16), Features(torch.randn(2, 16), torch.randn(2, 16, 3, 4))
    for module, x in ((encoder, tokens), (salad, features)):
        module.train()
        assert not torch.equal(torch.cat(outputs(module(x))), torch.cat(outputs(module(x))))
        module.eval()
        assert torch.equal(torch.cat(outputs(module(x))), torch.cat(outputs(module(x))))


def outputs(x: Tensor | Tokens) -> list[Tensor]:
    return [x.flatten()] if isinstance(x, Tensor) else [part.flatten() for part in x]


def test_pyramid_of_the_published_grid() -> None:
    """Cuts of 16 at 8, and at 5 and 11; each mean by its definition, in float64."""
    torch.manual_seed(0)
    patches = torch.randn(2, 6, 16, 16)
    # An exponent that is not an integer.
    pyramid = GemPyramid()
    nn.init.constant_(pyramid.p, 2.5)
    found = pyramid(UnitPatches()(patches))
    assert found.shape == (2, 13, 6)
    x = patches.double().numpy()
    x = np.maximum(x / np.sqrt((x**2).sum(axis=1, keepdims=True)), 1e-6)
    regions = [
        (x[:, :, top:bottom, left:right] ** 2.5).mean(axis=(2, 3)) ** 0.4
        for edges in ((0, 8, 16), (0, 5, 11, 16))
        for top, bottom in itertools.pairwise(edges)
        for left, right in itertools.pairwise(edges)
    ]
    assert relative_error(found, torch.from_numpy(np.stack(regions, axis=1))) < OUTPUT_BOUND


SIZES = {"s": (384, 12, 6), "b": (768, 12, 12), "l": (1024, 24, 16), "g": (1536, 40, 24)}
NO_ENCODER = "none"


def dinov2(size: str, registers: int = 0, adapter: str = NO_ADAPTER) -> ViTConfig:
    dim, depth, heads = SIZES[size]
    ffn = "swiglu" if size == "g" else "mlp"
    return ViTConfig(dim, depth, heads, ffn=ffn, registers=registers, adapter=adapter)


# The published model of each layout, and the reference's names in it.
PUBLIC: dict[str, tuple[ModelConfig, dict[str, str]]] = {
    f"dinov2_vit{size}14{suffix}": (
        ModelConfig(
            backbone=dinov2(size, registers), aggregator=ClassTokenConfig(), cross_image=NO_ENCODER
        ),
        {"backbone.": ""},
    )
    for size in SIZES
    for suffix, registers in (("", 0), ("_reg4", 4))
}
PUBLIC["dino_salad"] = (
    ModelConfig(backbone=dinov2("b"), cross_image=NO_ENCODER),
    {"backbone.": "backbone.model."},
)
PUBLIC["CricaVPR"] = (
    ModelConfig(
        backbone=dinov2("b", adapter="multi-resolution"),
        aggregator=GemPyramidConfig(),
    ),
    {"": "model_state_dict/module."},
)


@pytest.mark.parametrize("layout", PUBLIC)
def test_names_and_shapes_are_the_public_ones(layout: str) -> None:
    config, prefixes = PUBLIC[layout]
    with torch.device("meta"):
        model = Crisalad(config)
    shapes = {name: list(x.shape) for name, x in model.state_dict().items()}
    for ours, theirs in prefixes.items():
        shapes = {
            theirs + n.removeprefix(ours) if n.startswith(ours) else n: shape
            for n, shape in shapes.items()
        }
    assert shapes == json.loads((HERE / "layouts" / f"{layout}.json").read_text())


def random_batch(seed: int) -> tuple[Tensor, Tensor]:
    """Draw places with different sizes and spreads, so that miners find many, few or no pairs."""
    generator = torch.Generator().manual_seed(seed)
    images = int(torch.randint(2, 24, (), generator=generator))
    labels = torch.randint(0, 1 + seed % 8, (images,), generator=generator)
    centres = torch.randn(8, 6, generator=generator)
    noise = (0.05, 1.0, 2.0)[seed % 3] * torch.randn(images, 6, generator=generator)
    return F.normalize(centres[labels] + noise, dim=1).requires_grad_(), labels


@pytest.mark.parametrize("base", [0.0, 0.5])
def test_miner_and_loss_are_the_librarys(base: float) -> None:
    config = LossConfig(pml_compat=True, kind=MultiSimilarityConfig(base=base))
    distance = DotProductSimilarity(normalize_embeddings=False)
    miner = MultiSimilarityMiner(config.miner_margin, distance=distance)
    # Any: a type checker would infer int from the library's defaults.
    constants: Any = dataclasses.astuple(config.kind)
    loss_of = MultiSimilarityLoss(*constants, distance=distance)
    nonzero = 0
    for seed in range(30):
        x, labels = random_batch(seed)
        a1, p, a2, n = pairs = miner(x, labels)
        positives, negatives = mine(x @ x.T, labels, margin=config.miner_margin)
        assert set(zip(a1.tolist(), p.tolist(), strict=True)) == entries(positives)
        assert set(zip(a2.tolist(), n.tolist(), strict=True)) == entries(negatives)
        theirs = loss_of(x, labels, pairs)
        ours, easy_anchor_fraction = multi_similarity_loss(x, labels, config)
        # An exponent of 50 times a similarity amplifies rounding 50 times.
        torch.testing.assert_close(ours, theirs.reshape(()), rtol=1e-5, atol=1e-7)
        assert easy_anchor_fraction.item() == pytest.approx(1 - len(set(a1.tolist())) / len(x))
        (expected,) = torch.autograd.grad(theirs, x)
        (actual,) = torch.autograd.grad(ours, x)
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-6)
        nonzero += ours.item() > 0
    assert nonzero > 10  # the comparison is not only of zeros


def entries(pairs: Tensor) -> set[tuple[int, ...]]:
    return {tuple(pair) for pair in pairs.nonzero().tolist()}


def batch() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(6, 3, 42, 56, generator=generator), torch.tensor([0, 0, 0, 1, 1, 1])


Kind = Literal["depthwise", "multi-resolution"]


@pytest.mark.parametrize(
    ("trainable", "moving"),
    [
        ("all", ("backbone.", "aggregator.", "encoder.")),
        (
            "adapters,head",
            ("backbone.blocks.0.adapter.", "backbone.blocks.1.adapter.", "aggr", "enc"),
        ),
        ("last-1-blocks,norm,head", ("backbone.blocks.1.", "backbone.norm.", "aggr", "enc")),
        ("head,-adapters", ("aggr", "enc")),
    ],
)
@pytest.mark.parametrize("kind", ["depthwise", "multi-resolution"])
def test_only_what_trains_moves(trainable: str, moving: tuple[str, ...], kind: Kind) -> None:
    torch.manual_seed(0)
    backbone = ViTConfig(dim=32, depth=2, heads=2, position_grid=3, adapter=kind)
    model = Crisalad(dataclasses.replace(MODEL, backbone=backbone))
    # Weight decay would not move a parameter at 0, nor a gradient one after a dead ReLU.
    for parameter in model.parameters():
        nn.init.uniform_(parameter, 0, 0.1)
    before = {name: x.clone() for name, x in model.state_dict().items()}
    config = TrainConfig(trainable=trainable, optimiser=OptimiserConfig(learning_rate=1e-3))
    train(model, [batch()] * 2, config, steps=4)
    moved = {name for name, x in model.state_dict().items() if not torch.equal(x, before[name])}
    # Batch norms update with their batches, frozen or not.
    buffers = {name for name, _ in model.named_buffers()}
    assert len(buffers) == (0 if kind == "depthwise" else 2 * 5 * 3)
    assert buffers <= moved
    # The mask token affects no output: it has no gradient, and does not decay.
    expected = {
        name
        for name, _ in model.named_parameters()
        if name.startswith(moving) and name != "backbone.mask_token"
    }
    assert moved - buffers == expected


def test_loss_falls() -> None:
    torch.manual_seed(0)
    model = Crisalad(MODEL)
    config = TrainConfig(trainable="all", optimiser=OptimiserConfig(learning_rate=1e-3))
    losses = train(model, [batch()] * 20, config, steps=20)
    assert len(losses) == 20
    assert losses[-1] < 0.5 * losses[0]


def test_clipping_makes_the_norm_what_is_asked() -> None:
    one, two = (nn.Parameter(torch.ones(n)) for n in (9, 16))
    (3 * one.sum() + 3 * two.sum()).backward()
    clip_gradients([one, two], 20.0)
    assert one.grad is not None
    assert one.grad[0] == 3  # the norm is 15
    clip_gradients([one, two], 5.0)
    assert one.grad[0] == pytest.approx(1, rel=1e-6)


def test_schedule() -> None:
    plain = OptimiserConfig(schedule=LinearSchedule(0.2))
    assert [learning_rate_factor(plain, step, 4) for step in (0, 2, 4, 9)] == pytest.approx(
        [1, 0.6, 0.2, 0.2]
    )
    warm = OptimiserConfig(warmup_steps=2)
    factors = [learning_rate_factor(warm, step, 6) for step in range(7)]
    assert factors == [0.5, 1, 1, 0.75, 0.5, 0.25, 0]


@pytest.mark.parametrize("trainable", ["last-3-blocks,norm,head", "tail"])
def test_what_cannot_train(trainable: str) -> None:
    with pytest.raises(InputError, match=r"found '.*', expected head,-adapters, adapters,head"):
        freeze(Crisalad(MODEL), trainable)


class Other(Aggregator):
    """An aggregator as from a plug-in."""

    part_name = "other"

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token."""
        return TokenShape(dim, 0, dim)

    def apply(self, *args: Any, **more: Any) -> Any:
        """Never runs, because the reference raises first."""


def test_an_aggregator_of_a_plug_in_is_not_held() -> None:
    with pytest.raises(InputError, match="aggregator: found other, expected one that comes with"):
        Crisalad(dataclasses.replace(MODEL, aggregator=Other()))
