"""Plant deliberate faults on our side: each must make a row of `python -m parity` miss."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import crisalad_jax.nn.adapters.bottleneck
import crisalad_jax.nn.backbones.vit
import crisalad_jax.nn.torch_layers
import parity.cases.case
import parity.cases.parts
import parity.cases.run
from crisalad_jax.nn import layers
from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.backbones import vit
from crisalad_jax.nn.cross_image import TransformerEncoder
from crisalad_jax.nn.layers import Linear, at_least_float32
from parity.cases import checks
from parity.compare import OWN_STEP, STEP

Patch = pytest.MonkeyPatch
FORWARD = {"forward"}


@pytest.fixture(autouse=True)
def fresh_constants() -> Iterator[None]:
    """Clear cached constants, which would ignore a fault, and later its removal."""
    vit.bicubic_weights.cache_clear()
    yield
    vit.bicubic_weights.cache_clear()


@pytest.fixture(autouse=True, scope="module")
def hasty_programs() -> Iterator[None]:
    """Compile with fewer optimisations: faults are larger than rounding, and still show."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def fresh_programs() -> Iterator[None]:
    """Clear compiled functions, such as `train_step`, which would ignore a fault too."""
    jax.clear_caches()
    yield
    jax.clear_caches()


def missed(name: str, precision: str = "float32") -> set[str]:
    return {row.quantity for row in checks(precision, 0)[name]() if not row.passed}


def swap(first: str, second: str) -> Callable[[Patch], None]:
    """Swap two arrays of the state during conversion."""

    def fault(patch: Patch) -> None:
        right = parity.cases.case.to_params

        def wrong(state: dict[str, np.ndarray], *rest: Any, **more: Any) -> Any:
            swapped = {**state, first: state[second], second: state[first]}
            return right(swapped, *rest, **more)

        patch.setattr(parity.cases.case, "to_params", wrong)

    return fault


def replace(module: Any, name: str, make: Callable[[Any], Any]) -> Callable[[Patch], None]:
    """Replace a function or constant by `make` of it."""
    return lambda patch: patch.setattr(module, name, make(getattr(module, name)))


def _without_layer_scale(block: Any) -> Any:
    def wrong(params: vit.Block, *rest: Any) -> Any:
        ones = jnp.ones_like(params.ls1)
        return block(dataclasses.replace(params, ls1=ones, ls2=ones), *rest)

    return wrong


def _special_tokens_once(mlp_update: Any) -> Any:
    def wrong(self: Any, params: Any, tokens: Any, info: TokenInfo) -> Any:
        # Without bias, halving what counts twice makes it count once.
        special = tokens.shape[-2] - math.prod(info.grid)
        adapted, updated = mlp_update(self, params, tokens, info)
        return adapted.at[..., :special, :].multiply(0.5), updated

    return wrong


def _an_iteration_short(assign: Any) -> Any:
    def wrong(*args: Any, config: Any, **more: Any) -> Any:
        short = dataclasses.replace(config, iterations=config.iterations - 1)
        return assign(*args, config=short, **more)

    return wrong


def _constant_first_layer(feed_forward: Any) -> Any:
    def wrong(params: vit.Mlp, x: Any) -> Any:
        constant = jax.lax.stop_gradient(params.fc1)
        return feed_forward(dataclasses.replace(params, fc1=constant), x)

    return wrong


def _constant_input(feed_forward: Any) -> Any:
    return lambda params, x: feed_forward(params, jax.lax.stop_gradient(x))


def _all_positives(mine: Any) -> Any:
    def wrong(similarities: Any, pairs: Any, *, margin: float) -> Any:
        return mine(similarities, pairs, margin=margin)._replace(positives=pairs.positives)

    return wrong


def _another_mean(normalise: Any) -> Any:
    def wrong(image: Any, how: Any) -> Any:
        return normalise(image, dataclasses.replace(how, mean=(0.485, 0.456, 0.407)))

    return wrong


def _transposed_mask(encoder: Any) -> Any:
    def wrong(*args: Any, mask: Any, **more: Any) -> Any:
        return encoder(*args, mask=mask.T, **more)

    return wrong


PARTS, VIT = parity.cases.parts, crisalad_jax.nn.backbones.vit
TORCH, ADAPTERS = crisalad_jax.nn.torch_layers, crisalad_jax.nn.adapters.bottleneck
FAULTS: dict[str, tuple[str, set[str], Callable[[Patch], None]]] = {
    "blocks swapped": (
        "attention",
        FORWARD,
        swap("backbone.blocks.0.attn.proj.weight", "backbone.blocks.1.attn.proj.weight"),
    ),
    "norms swapped": (
        "block, no adapter",
        FORWARD,
        swap("backbone.blocks.1.norm1.weight", "backbone.blocks.1.norm2.weight"),
    ),
    "networks of SALAD swapped": (
        "SALAD",
        FORWARD,
        swap("aggregator.cluster_features.0.weight", "aggregator.score.0.weight"),
    ),
    "statistics swapped": (
        "block, multi-resolution adapter",
        FORWARD,
        swap(
            "backbone.blocks.1.adapter.branch1.bn.weight",
            "backbone.blocks.1.adapter.branch1.bn.running_var",
        ),
    ),
    "epsilon of the backbone's norms": (
        "block, no adapter",
        FORWARD,
        replace(VIT.ViTConfig, "norm_epsilon", lambda _: 1e-5),
    ),
    "epsilon of the encoder's norms": (
        "cross-image encoder",
        FORWARD,
        replace(TORCH, "layer_norm", lambda norm: functools.partial(norm, epsilon=1e-6)),
    ),
    "epsilon of batch norm": (
        "block, multi-resolution adapter",
        FORWARD,
        replace(ADAPTERS, "BATCH_NORM_EPSILON", lambda _: 1e-5),
    ),
    "tanh GELU": (
        "MLP",
        FORWARD,
        replace(VIT, "gelu", lambda _: functools.partial(jax.nn.gelu, approximate=True)),
    ),
    "no LayerScale": ("block, no adapter", FORWARD, replace(PARTS, "block", _without_layer_scale)),
    "special tokens count once": (
        "block, depthwise adapter",
        FORWARD,
        replace(ADAPTERS.DepthwiseConfig, "mlp_update", _special_tokens_once),
    ),
    "bicubic with a = -0.5": (
        "positions: square, up",
        FORWARD,
        replace(VIT, "_cubic", lambda cubic: lambda x, _: cubic(x, -0.5)),
    ),
    "an iteration of Sinkhorn short": (
        "Sinkhorn: 3 iterations, epsilon 1.0",
        FORWARD,
        replace(PARTS, "assign_with_dustbin", _an_iteration_short),
    ),
    "mask transposed": (
        "cross-image encoder, masked",
        FORWARD,
        replace(TransformerEncoder, "apply", _transposed_mask),
    ),
    "margin of the miner": (
        "miner",
        {"choices"},
        replace(PARTS, "mine", lambda mine: lambda *x, margin: mine(*x, margin=2 * margin)),
    ),
    "positives all mined": ("miner", {"choices"}, replace(PARTS, "mine", _all_positives)),
    "mean of ImageNet": (
        "pixels to numbers",
        FORWARD,
        replace(PARTS, "normalise", _another_mean),
    ),
    "a weight without gradient": (
        "MLP",
        {"gradients"},
        replace(PARTS, "feed_forward", _constant_first_layer),
    ),
    "an input without gradient": (
        "MLP",
        {"gradients"},
        replace(PARTS, "feed_forward", _constant_input),
    ),
    "epsilon of Adam": (
        "MLP",
        {STEP, OWN_STEP},
        replace(optax, "adamw", lambda adamw: functools.partial(adamw, eps=2e-8)),
    ),
    "no weight decay": (
        "attention",
        {STEP, OWN_STEP},
        replace(
            optax, "adamw", lambda adamw: lambda *x, **more: adamw(*x, **more | {"weight_decay": 0})
        ),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_misses(fault: str, monkeypatch: Patch) -> None:
    name, quantities, plant = FAULTS[fault]
    plant(monkeypatch)
    assert quantities <= missed(name)


@jax.custom_vjp
def _add_bias(y: Any, bias: Any) -> Any:
    return (at_least_float32(y) + bias).astype(y.dtype)


def _sum_in_8_bits(_: None, slope: Any) -> Any:
    def add(total: Any, x: Any) -> Any:
        return jax.lax.reduce_precision(total + x, exponent_bits=8, mantissa_bits=7), None

    rows = at_least_float32(slope).reshape(-1, slope.shape[-1])
    return slope, jax.lax.scan(add, jnp.zeros(slope.shape[-1]), rows)[0]


_add_bias.defvjp(lambda *x: (_add_bias(*x), None), _sum_in_8_bits)


def _bias_in_8_bits(_: Any) -> Any:
    return lambda params, x: _add_bias(x @ params.weight.astype(x.dtype), params.bias)


def _two_bits_short(linear: Any) -> Any:
    def wrong(params: Linear, x: Any) -> Any:
        return jax.lax.reduce_precision(linear(params, x), exponent_bits=8, mantissa_bits=5)

    return wrong


@pytest.mark.parametrize(
    ("fault", "quantities"),
    [
        # The result of a bias added in bfloat16 on a processor with native bfloat16.
        (_bias_in_8_bits, {"gradients, from float64"}),
        (_two_bits_short, {"forward, from float64", "gradients, from float64"}),
    ],
)
def test_a_fault_of_bfloat16_shows_beside_float64_alone(
    fault: Callable[[Any], Any], quantities: set[str], monkeypatch: Patch
) -> None:
    assert not missed("MLP", "bfloat16")
    replace(layers, "linear", fault)(monkeypatch)
    assert missed("MLP", "bfloat16") == quantities


RUN = parity.cases.run


@pytest.mark.slow
def test_a_frozen_parameter_that_moves_misses(monkeypatch: Patch) -> None:
    def fault(merge_params: Any) -> Any:
        def wrong(trainable: Any, frozen: Any, *rest: Any) -> Any:
            positions = frozen.backbone.pos_embed * (1 + 2e-7)
            backbone = dataclasses.replace(frozen.backbone, pos_embed=positions)
            return merge_params(trainable, dataclasses.replace(frozen, backbone=backbone), *rest)

        return wrong

    replace(RUN, "merge_params", fault)(monkeypatch)
    assert missed("training CriSALAD's adapters and head") == {"frozen"}


@pytest.mark.slow
def test_padding_that_counts_misses(monkeypatch: Patch) -> None:
    def fault(train_step: Any) -> Any:
        def wrong(state: Any, frozen: Any, images: Any, labels: Any, valid: Any, *rest: Any) -> Any:
            return train_step(state, frozen, images, labels, jnp.ones_like(valid), *rest)

        return wrong

    replace(RUN, "train_step", fault)(monkeypatch)
    assert {"losses", "parameters at the end"} <= missed("training CriSALAD's adapters and head")


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_programs")
def test_a_learning_rate_that_does_not_decay_misses(monkeypatch: Patch) -> None:
    monkeypatch.setattr(optax, "linear_schedule", lambda peak, *_: lambda _: peak)
    assert {"losses", "parameters at the end"} <= missed("training CriSALAD's adapters and head")
