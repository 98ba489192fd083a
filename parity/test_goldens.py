"""Reproduce outputs and gradients of the public torch implementations from stored files.

Each file of goldens/ holds random weights and inputs, the public implementation's outputs, the loss
sum(sin(3 x)) over them and its gradients. Errors are the norm of the difference over the norm. The
bounds, 1e-5 on outputs and 1e-4 on gradients, are ten to a hundred times float32's rounding after
the few hundred additions of these layers; a wrong constant or axis shows at 1e-2 and more.
"""

import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.checkpoints.formats import to_params, to_state
from crisalad_jax.checkpoints.formats.families import HEADS, TABLES
from crisalad_jax.checkpoints.formats.rows import Form, Rows, expand
from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.adapters.bottleneck import MultiResolutionConfig
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.base import to_descriptor
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones import Features
from crisalad_jax.nn.backbones.vit import (
    NORM_EPSILON,
    ViTConfig,
    embed,
    run_blocks,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.layers import layer_norm
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.sinkhorn import SinkhornConfig, assign_with_dustbin
from crisalad_jax.utils.pytree import named_leaves

GOLDENS = pathlib.Path(__file__).parent / "goldens"
OUTPUT_BOUND, GRADIENT_BOUND = 1e-5, 1e-4
NO_GRADIENT = ("mask_token", "running_mean", "running_var")
"""Name endings of arrays that the public models store but do not differentiate."""

State = Mapping[str, np.ndarray]


class Names(NamedTuple):
    """Conversions from public names to our parameters, and from our gradients to public names."""

    ours: Callable[[State], Any]
    theirs: Callable[[Any], dict[str, np.ndarray]]


def part_names(rows: Rows, template: Any, prefix: str = "", public: str = "") -> Names:
    """Make the names of one part of a model, from its table and prefixes.

    Only the structure of `template` is used.
    """
    structure = jax.tree.structure(template)
    order = [prefix + name for name in named_leaves(template)]
    entries = [row for row in expand(rows, order) if isinstance(row.form, Form)]

    def ours(state: State) -> Any:
        found: dict[str, np.ndarray] = {}
        for entry in entries:
            arrays = (state[name.removeprefix(public)] for name in entry.theirs)
            found |= zip(entry.ours, entry.form.ours(*arrays), strict=True)
        return jax.tree.unflatten(structure, [jnp.asarray(found[name]) for name in order])

    def theirs(params: Any) -> dict[str, np.ndarray]:
        leaves = dict(zip(order, map(np.asarray, jax.tree.leaves(params)), strict=True))
        found: dict[str, np.ndarray] = {}
        for entry in entries:
            arrays = entry.form.theirs(*(leaves[name] for name in entry.ours))
            names = (name.removeprefix(public) for name in entry.theirs)
            found |= zip(names, arrays, strict=True)
        return found

    return Names(ours, theirs)


def load(name: str) -> dict[str, np.ndarray]:
    with np.load(GOLDENS / f"{name}.npz") as file:
        return dict(file)


def under(golden: State, prefix: str) -> dict[str, np.ndarray]:
    return {k.removeprefix(prefix): v for k, v in golden.items() if k.startswith(prefix)}


def relative_error(ours: Any, theirs: Any) -> float:
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    assert ours.shape == theirs.shape
    return float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))


def golden_loss(outputs: Any) -> jax.Array:
    return jnp.stack([jnp.sin(3 * leaf).sum() for leaf in jax.tree.leaves(outputs)]).sum()


def check(
    function: Callable[[Any, Any], dict[str, jax.Array]],
    golden: State,
    names: Names,
    inputs: dict[str, jax.Array],
    exempt: tuple[str, ...] = (),
) -> None:
    """Compare outputs, loss, and the gradients to every parameter and input."""
    params = names.ours(under(golden, "state."))
    outputs = jax.jit(function)(params, inputs)
    for name, output in outputs.items():
        assert relative_error(output, golden[f"out.{name}"]) < OUTPUT_BOUND, name
    loss, (params_grad, inputs_grad) = jax.jit(
        jax.value_and_grad(lambda p, x: golden_loss(function(p, x)), argnums=(0, 1))
    )(params, inputs)
    # The loss sums thousands of terms of both signs, so its rounding scales with their count.
    count = sum(output.size for output in outputs.values())
    assert abs(loss - golden["loss"]) < 1e-6 * count
    expected = under(golden, "grad.")
    actual = names.theirs(params_grad)
    assert {n for n in actual if n.rpartition(".")[2] not in NO_GRADIENT} == expected.keys()
    for name in expected.keys() - set(exempt):
        assert relative_error(actual[name], expected[name]) < GRADIENT_BOUND, name
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
        adapter="none",
    )
    model = ModelConfig(backbone=config, aggregator=ClassTokenConfig(), cross_image="none")

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        images = inputs["image"].transpose(0, 2, 3, 1)
        tokens = jax.vmap(lambda image: embed(params, image, config))(images)
        tokens, _ = run_blocks([params.blocks], tokens, config.grid(images.shape[1:3]), config)
        normed = layer_norm(params.norm, tokens, epsilon=NORM_EPSILON)
        outputs = {
            "x_norm_clstoken": normed[:, 0],
            "x_norm_patchtokens": normed[:, 1 + registers :],
            "x_prenorm": tokens,
        }
        if registers:
            outputs["x_norm_regtokens"] = normed[:, 1 : 1 + registers]
        return {k: v for k, v in outputs.items() if f"out.{k}" in golden}

    names = Names(
        lambda state: to_params(state, model, "dinov2", source=name)[0].backbone,
        lambda params: to_state(Crisalad(params, None, None), model, "dinov2", extras={}),
    )
    check(function, golden, names, {"image": jnp.asarray(golden["in.image"])})


def test_multi_resolution_adapter() -> None:
    golden = load("multiconv_adapter")
    # The stored adapter narrows 24 channels to 4, not to a sixteenth: our configuration gives the
    # names and the structure, not the widths.
    config = MultiResolutionConfig(bottleneck=1.0, alpha=1.0)
    shape = ViTConfig(dim=48, heads=3).block_shape
    template = jax.eval_shape(lambda key: config.init(key, shape), jax.random.key(0))

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return {"tokens": config.mlp_update(params, inputs["tokens"], TokenInfo((5, 5)))[0]}

    names = part_names(TABLES["adapter"], template)
    check(function, golden, names, {"tokens": jnp.asarray(golden["in.tokens"])})


def test_salad() -> None:
    golden = load("salad")
    config = SaladConfig(clusters=6, cluster_dim=8, token_dim=16, hidden=512)
    model = ModelConfig(aggregator=config, cross_image="none")

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        batch, channels = inputs["features"].shape[:2]
        patches = inputs["features"].reshape(batch, channels, -1).transpose(0, 2, 1)

        tokens = config.apply(params, Features(inputs["token"], patches), (4, 6), key=None)
        descriptors = jax.vmap(functools.partial(to_descriptor, aggregator=config))(tokens)
        return {"descriptor": descriptors}

    template = jax.eval_shape(
        lambda key: config.init(key, model.backbone, (4, 6)), jax.random.key(0)
    )
    names = part_names(HEADS["salad"].rows, template)
    inputs = {name: jnp.asarray(golden[f"in.{name}"]) for name in ("features", "token")}
    # A column's potential absorbs a constant added to its scores: the dustbin's score and the score
    # network's last bias have no effect, and their gradients are rounding noise.
    dead = ("dust_bin", "score.3.bias")
    check(function, golden, names, inputs, exempt=dead)
    params = names.ours(under(golden, "state."))
    gradients = names.theirs(jax.grad(lambda p: golden_loss(function(p, inputs)))(params))
    for name in dead:
        # Sums of 3 x 24 terms that cancel, whose absolute values sum to 17: times float32's 6e-8.
        assert np.abs(gradients[name]).max() < 1e-6
        assert np.abs(golden[f"grad.{name}"]).max() < 1e-6

    patches = inputs["features"].reshape(3, 48, -1).transpose(0, 2, 1)
    plan = jnp.exp(config.transport(params, Features(inputs["token"], patches), key=None).log_plan)
    stored = golden["aux.assignment_with_dustbin"].transpose(0, 2, 1)
    assert relative_error(plan, stored) < OUTPUT_BOUND


@pytest.mark.parametrize("case", range(5))
def test_sinkhorn(case: int) -> None:
    golden = under(load("sinkhorn"), f"{case}.")
    config, epsilon = SinkhornConfig(iterations=int(golden["num_iters"])), float(golden["reg"])

    def log_plan(scores: jax.Array, dustbin: jax.Array) -> jax.Array:
        by_patch = scores.transpose(0, 2, 1)
        result = assign_with_dustbin(by_patch, dustbin, epsilon=epsilon, config=config)
        return result.log_plan.transpose(0, 2, 1)

    def loss(scores: jax.Array, dustbin: jax.Array) -> jax.Array:
        return golden_loss(jnp.exp(log_plan(scores, dustbin)))

    scores, dustbin = jnp.asarray(golden["scores"]), jnp.ones(())
    assert relative_error(log_plan(scores, dustbin), golden["log_p"]) < OUTPUT_BOUND
    scores_grad, dustbin_grad = jax.grad(loss, argnums=(0, 1))(scores, dustbin)
    assert relative_error(scores_grad, golden["grad_scores"]) < GRADIENT_BOUND
    # Noise around 0 on both sides: the dustbin's potential absorbs its constant score.
    noise = 1e-5 * np.abs(golden["grad_scores"]).sum()
    assert abs(dustbin_grad) < noise
    assert abs(golden["grad_dustbin"]) < noise


def test_cross_image_encoder() -> None:
    golden = load("cross_image_encoder")
    config = CrossImageConfig(layers=2, heads=4, feedforward=40)

    def function(params: Any, inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return {"tokens": config.apply(params, inputs["tokens"], mask=None, key=None)}

    template = jax.eval_shape(lambda key: config.init(key, 16), jax.random.key(0))
    names = part_names(TABLES["encoder"], template, "cross_image.", "encoder.")
    check(function, golden, names, {"tokens": jnp.asarray(golden["in.tokens"])})
