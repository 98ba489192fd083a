"""Outputs and gradients of the public torch implementations, reproduced from stored files.

Each file of goldens/ holds random weights and inputs, the public implementation's outputs, the loss
sum(sin(3 x)) over them and its gradients. Errors are the norm of the difference over the norm. The
bounds, 1e-5 on outputs and 1e-4 on gradients, are ten to a hundred times float32's rounding after
the few hundred additions of these layers; a wrong constant or axis shows at 1e-2 and more.
"""

import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config import (
    AdapterConfig,
    CrossImageConfig,
    SaladConfig,
    SinkhornConfig,
    ViTConfig,
)
from crisalad_jax.nn.cross_image import cross_image_encoder
from crisalad_jax.nn.layers import layer_norm
from crisalad_jax.nn.salad import join, salad, transport
from crisalad_jax.nn.vit import NORM_EPSILON, Features, embed, grid_of, run_blocks
from crisalad_jax.pytree import named_leaves
from crisalad_jax.sinkhorn import assign
from parity.torch_names import encoder_from_torch, salad_from_torch, vit_from_torch

GOLDENS = pathlib.Path(__file__).parent / "goldens"
OUTPUT_BOUND, GRADIENT_BOUND = 1e-5, 1e-4


def load(name: str) -> dict[str, np.ndarray]:
    with np.load(GOLDENS / f"{name}.npz") as file:
        return dict(file)


def under(golden: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {k.removeprefix(prefix): v for k, v in golden.items() if k.startswith(prefix)}


def relative_error(ours: Any, theirs: Any) -> float:
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    assert ours.shape == theirs.shape
    return float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))


def golden_loss(outputs: Any) -> jax.Array:
    return sum(jnp.sin(3 * leaf).sum() for leaf in jax.tree.leaves(outputs))


def check(
    function: Callable[[Any, Any], dict[str, jax.Array]],
    golden: dict[str, np.ndarray],
    params: Any,
    inputs: dict[str, jax.Array],
    params_of: Callable[[dict[str, np.ndarray]], Any],
    exempt: tuple[str, ...] = (),
) -> None:
    """Compare outputs, loss, and the gradients to every parameter and input."""
    outputs = jax.jit(function)(params, inputs)
    for name, output in outputs.items():
        assert relative_error(output, golden[f"out.{name}"]) < OUTPUT_BOUND, name
    loss, (params_grad, inputs_grad) = jax.jit(
        jax.value_and_grad(lambda p, x: golden_loss(function(p, x)), argnums=(0, 1))
    )(params, inputs)
    # The loss is a sum of thousands of terms of both signs: its rounding scales with their count.
    count = sum(output.size for output in outputs.values())
    assert abs(loss - golden["loss"]) < 1e-6 * count
    expected = named_leaves(params_of(under(golden, "grad.")))
    actual = named_leaves(params_grad)
    assert actual.keys() == expected.keys()
    for name, gradient in actual.items():
        if name not in exempt and gradient.size:
            assert relative_error(gradient, expected[name]) < GRADIENT_BOUND, name
    for name, gradient in inputs_grad.items():
        assert relative_error(gradient, golden[f"gradin.{name}"]) < GRADIENT_BOUND, name


@pytest.mark.parametrize(
    ("name", "registers"),
    [("dinov2_native_grid", 0), ("dinov2_interpolated_grid", 0), ("dinov2_registers", 4)],
)
def test_vit(name: str, registers: int) -> None:
    golden = load(name)
    config = ViTConfig(
        dim=48,
        depth=2,
        heads=3,
        registers=registers,
        position_grid=5,
        adapter=AdapterConfig(kind="none"),
    )

    def one(params: Any, image: jax.Array) -> dict[str, jax.Array]:
        image = image.transpose(1, 2, 0)
        tokens = run_blocks(params, embed(params, image, config), grid_of(image), config)
        normed = layer_norm(params.norm, tokens, epsilon=NORM_EPSILON)
        outputs = {
            "x_norm_clstoken": normed[0],
            "x_norm_patchtokens": normed[1 + registers :],
            "x_prenorm": tokens,
        }
        if registers:
            outputs["x_norm_regtokens"] = normed[1 : 1 + registers]
        return outputs

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        outputs = jax.vmap(one, in_axes=(None, 0))(params, inputs["image"])
        return {k: v for k, v in outputs.items() if f"out.{k}" in golden}

    def from_torch(state: dict[str, np.ndarray]) -> Any:
        return vit_from_torch(state, depth=2)

    check(
        function,
        golden,
        from_torch(under(golden, "state.")),
        {"image": jnp.asarray(golden["in.image"])},
        from_torch,
    )


def test_salad() -> None:
    golden = load("salad")
    config = SaladConfig(clusters=6, cluster_dim=8, token_dim=16, hidden=512)

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        batch, channels = inputs["features"].shape[:2]
        patches = inputs["features"].reshape(batch, channels, -1).transpose(0, 2, 1)

        def one(token: jax.Array, local: jax.Array) -> jax.Array:
            return join(salad(params, Features(token, local), config, key=None))

        return {"descriptor": jax.vmap(one)(inputs["token"], patches)}

    params = salad_from_torch(under(golden, "state."))
    inputs = {name: jnp.asarray(golden[f"in.{name}"]) for name in ("features", "token")}
    # A constant added to a column of scores is absorbed by the column's potential: the dustbin's
    # score and the score network's last bias have no effect, their gradients are rounding noise.
    dead = {"dust_bin": "dust_bin", "score.fc2.bias": "score.3.bias"}
    check(function, golden, params, inputs, salad_from_torch, exempt=tuple(dead))
    gradients = named_leaves(jax.grad(lambda p: golden_loss(function(p, inputs)))(params))
    for ours, theirs in dead.items():
        # Sums of 3 x 24 terms below 0.1 that cancel: 72 x 0.1 x float32's 6e-8.
        assert np.abs(gradients[ours]).max() < 5e-7
        assert np.abs(golden[f"grad.{theirs}"]).max() < 5e-7

    patches = inputs["features"].reshape(3, 48, -1).transpose(0, 2, 1)
    plan = jax.vmap(lambda p: jnp.exp(transport(params, p, config, key=None).log_plan))(patches)
    stored = golden["aux.assignment_with_dustbin"].transpose(0, 2, 1)
    assert relative_error(plan, stored) < OUTPUT_BOUND


@pytest.mark.parametrize("case", range(5))
def test_sinkhorn(case: int) -> None:
    golden = under(load("sinkhorn"), f"{case}.")
    config = SinkhornConfig(int(golden["num_iters"]), float(golden["reg"]))

    def log_plan(scores: jax.Array, dustbin: jax.Array) -> jax.Array:
        return assign(scores.transpose(0, 2, 1), dustbin, config).log_plan.transpose(0, 2, 1)

    def loss(scores: jax.Array, dustbin: jax.Array) -> jax.Array:
        return golden_loss(jnp.exp(log_plan(scores, dustbin)))

    scores, dustbin = jnp.asarray(golden["scores"]), jnp.ones(())
    assert relative_error(log_plan(scores, dustbin), golden["log_p"]) < OUTPUT_BOUND
    scores_grad, dustbin_grad = jax.grad(loss, argnums=(0, 1))(scores, dustbin)
    assert relative_error(scores_grad, golden["grad_scores"]) < GRADIENT_BOUND
    # Noise around 0 on both sides: the dustbin's constant score is absorbed by its potential.
    noise = 1e-5 * np.abs(golden["grad_scores"]).sum()
    assert abs(dustbin_grad) < noise
    assert abs(golden["grad_dustbin"]) < noise


def test_cross_image_encoder() -> None:
    golden = load("cross_image_encoder")
    config = CrossImageConfig(layers=2, heads=4, feedforward=40)

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return {"tokens": cross_image_encoder(params, inputs["tokens"], config, key=None)}

    def from_torch(state: dict[str, np.ndarray]) -> Any:
        return encoder_from_torch(state, layers=2)

    inputs = {"tokens": jnp.asarray(golden["in.tokens"])}
    check(function, golden, from_torch(under(golden, "state.")), inputs, from_torch)
