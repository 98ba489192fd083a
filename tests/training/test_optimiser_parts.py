"""Optimisers and schedules as parts: a user's, optax's by name, and an average of the weights."""

import dataclasses
import functools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch

import crisalad_jax as cj
from crisalad_jax.checkpoints.train_state import StateStore
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli import train as train_command
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.training import run_files
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.optimiser import averaged_weights, make_optimiser
from crisalad_jax.training.step import TrainState
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import RECIPE, assert_equal
from tests.training.test_loop import assert_same_params, assert_same_run, interrupt

WEIGHTS = {"matrix": (4, 3), "vector": (3,)}


def numbers(steps: int) -> list[dict[str, np.ndarray]]:
    """The first weights, and a gradient for each step."""
    generator = np.random.default_rng(0)
    return [
        {name: generator.standard_normal(shape) for name, shape in WEIGHTS.items()}
        for _ in range(steps + 1)
    ]


def steps_of(config: OptimiserConfig, steps: int, per_epoch: int = 1):
    """The weights after each step, in float64, and the optimiser's last state."""
    weights, *gradients = numbers(steps)
    with jax.enable_x64(True):
        optimiser = make_optimiser(config, steps, per_epoch)
        weights = jax.tree.map(jnp.asarray, weights)
        state, found = optimiser.init(weights), []
        for gradient in gradients:
            updates, state = jax.jit(optimiser.update)(gradient, state, weights)
            weights = optax.apply_updates(weights, updates)
            found.append(jax.tree.map(np.asarray, weights))
        return found, jax.device_get(averaged_weights(state, weights))


def test_a_function_of_optax_has_its_arguments_as_settings() -> None:
    """Muon by its name is optax's own, called with them."""
    part = cj.make_part("optimiser", "optax.contrib.muon", ns_steps=3, adam_b2=0.9)
    found, _ = steps_of(OptimiserConfig(kind=part, learning_rate=0.1, schedule="constant"), 3)
    with jax.enable_x64(True):
        muon = optax.contrib.muon(
            lambda _: 0.1, ns_steps=3, adam_b2=0.9, weight_decay=OptimiserConfig.weight_decay
        )
        weights, *gradients = [jax.tree.map(jnp.asarray, each) for each in numbers(3)]
        state = muon.init(weights)
        for gradient, ours in zip(gradients, found, strict=True):
            updates, state = jax.jit(muon.update)(gradient, state, weights)
            weights = optax.apply_updates(weights, updates)
            # The same program in float64, but for the rate's place in it.
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), ours, weights)


def test_muon_takes_the_matrices_of_stacked_blocks_one_by_one() -> None:
    """Against Muon of each block's matrix by itself, and Adam of what has one axis in a block."""
    shapes = {
        "cls_token": (8,),
        "register_tokens": (2, 8),
        "pos_embed": (3, 3, 8),
        "blocks": {"norm1": (3, 8), "qkv": {"weight": (3, 8, 24), "bias": (3, 24)}},
        "head": (8, 5),
    }
    generator = np.random.default_rng(0)
    weights, gradient = (
        jax.tree.map(
            lambda shape: jnp.asarray(generator.standard_normal(shape), jnp.float32),
            {"backbone": shapes},
            is_leaf=lambda x: isinstance(x, tuple),
        )
        for _ in range(2)
    )
    config = OptimiserConfig(kind="optax.contrib.muon", learning_rate=0.1, schedule="constant")
    ours = make_optimiser(config, 3, 1)
    found, _ = ours.update(gradient, ours.init(weights), weights)
    decay = config.weight_decay

    def expected(leaf: jax.Array, step: jax.Array, *, is_matrix: bool) -> jax.Array:
        muon = optax.contrib.muon(0.1, weight_decay=decay)
        adam = optax.adamw(0.1, weight_decay=0.0, nesterov=True)
        optimiser = muon if is_matrix else adam
        return optimiser.update(step, optimiser.init(leaf), leaf)[0]

    leaves = zip(*(named_leaves(each).items() for each in (found, weights, gradient)), strict=True)
    for (name, update), (_, leaf), (_, step) in leaves:
        one = functools.partial(expected, is_matrix=name.endswith(("qkv.weight", "head")))
        rows = "blocks" in name
        each = jax.vmap(one)(leaf, step) if rows else one(leaf, step)
        # Newton-Schulz iterations of float32, batched and not.
        np.testing.assert_allclose(update, each, rtol=2e-4, atol=1e-6, err_msg=name)


def test_one_without_a_weight_decay_gets_it_through_its_gradient() -> None:
    """As torch's RMSprop, which optax's has no weight decay for."""
    part = cj.make_part("optimiser", "optax.rmsprop", decay=0.99, eps_in_sqrt=False)
    config = OptimiserConfig(kind=part, learning_rate=0.1, schedule="constant", weight_decay=0.3)
    start, *gradients = numbers(4)
    tensors = {name: torch.tensor(each) for name, each in start.items()}
    theirs = torch.optim.RMSprop(tensors.values(), lr=0.1, alpha=0.99, weight_decay=0.3)
    for gradient, ours in zip(gradients, steps_of(config, 4)[0], strict=True):
        for name, tensor in tensors.items():
            tensor.grad = torch.tensor(gradient[name])
        theirs.step()
        for name, tensor in tensors.items():
            # Four steps of order 1 in float64, each rounded to 1e-16.
            np.testing.assert_allclose(ours[name], tensor.numpy(), rtol=0, atol=1e-13)


@pytest.mark.parametrize("accumulate", [1, 2])
def test_the_average_is_of_the_weights_after_each_step(accumulate: int) -> None:
    config = OptimiserConfig(learning_rate=0.1, ema=0.75, accumulate=accumulate)
    found, average = steps_of(config, 6, per_epoch=6)
    expected = numbers(0)[0]
    for after in found[accumulate - 1 :: accumulate]:
        expected = {name: 0.75 * expected[name] + 0.25 * after[name] for name in expected}
    for name in expected:
        # Six sums in float64.
        np.testing.assert_allclose(average[name], expected[name], rtol=0, atol=1e-14)
        assert np.abs(average[name] - found[-1][name]).max() > 0.01
    none, weights = steps_of(OptimiserConfig(learning_rate=0.1), 2)
    assert_equal(none[-1], weights)


def test_schedule_free_weights_are_those_of_its_paper() -> None:
    """x of Defazio et al. (2024), eq. 4 to 6, by hand for SGD; validations are of x, not of y."""
    part = cj.make_part("optimiser", "optax.contrib.schedule_free_sgd", b1=0.9)
    config = OptimiserConfig(kind=part, learning_rate=0.1, schedule="constant", weight_decay=0.0)
    _, average = steps_of(config, 5)
    start, *gradients = numbers(5)
    for name in start:
        x = z = start[name]
        for step, gradient in enumerate(gradients):
            z = z - 0.1 * gradient[name]
            x = x + (z - x) / (step + 1)
        # Five steps of order 1 in float64; x comes from y and z by a division by 0.9.
        np.testing.assert_allclose(average[name], x, rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:.seed. is deprecated")
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("optax.contrib.muon", {}),
        ("optax.contrib.schedule_free_adamw", {}),
        ("optax.contrib.prodigy", {}),
        ("optax.adafactor", {"min_dim_size_to_factor": 2}),
        ("optax.noisy_sgd", {"seed": 3}),
        ("optax.lamb", {}),
    ],
)
def test_any_state_is_saved_and_resumed(tmp_path, name, settings) -> None:
    part = cj.make_part("optimiser", name, **settings)
    config = OptimiserConfig(kind=part, learning_rate=0.1, ema=0.9, accumulate=2)
    assert from_plain(OptimiserConfig, to_plain(config), source="file") == config
    assert pickle.loads(pickle.dumps(config)) == config
    weights, gradient = jax.tree.map(jnp.float32, numbers(1))
    optimiser = make_optimiser(config, 4)
    state = optimiser.init(weights)
    update = jax.jit(optimiser.update)
    for _ in range(3):
        _, state = update(gradient, state, weights)
    store = StateStore(tmp_path / "state")
    store.save(3, TrainState(jnp.int32(3), weights, state), {})
    saved = store.load(TrainState(jnp.int32(0), weights, optimiser.init(weights)))
    store.close()
    assert saved is not None
    assert_equal(saved.state.optimiser, state)
    # The next step is the same.
    again = update(gradient, saved.state.optimiser, weights)
    assert_equal(again, update(gradient, state, weights))


@pytest.mark.slow
def test_a_run_resumes_with_its_average(places, benchmark, tmp_path, monkeypatch) -> None:
    optimiser = OptimiserConfig(
        kind="optax.contrib.muon", learning_rate=1e-3, schedule="cosine", ema=0.5
    )
    config = dataclasses.replace(RECIPE, optimiser=optimiser, epochs=2, save_top_k=9)
    options = {"validation": benchmark, "quiet": True}
    whole = fit(config, places, tmp_path / "whole", **options)
    interrupt(monkeypatch, "train_step", 4, config, places, tmp_path / "cut", **options)
    resumed = fit(config, places, tmp_path / "cut", **options)
    assert_same_run(tmp_path / "cut", tmp_path / "whole")
    assert_same_params(resumed.params, whole.params)
    last, _ = load_weights(tmp_path / "whole" / "last.safetensors")
    assert_same_params(last, whole.params)
    # The validation after the last step is of the same weights.
    best, _ = load_weights(tmp_path / "whole" / "best" / "step-00000004.safetensors")
    assert_same_params(best, last)
    store = run_files.StateStore(tmp_path / "whole" / "state")
    step = store._manager.latest_step()
    leaves = store._manager.restore(step)["state"]
    store.close()
    name = "aggregator.score.fc1.weight"
    averages = [n for n in leaves if n.endswith(f"weights.{name}") and "optimiser" in n]
    assert len(averages) == 1
    np.testing.assert_array_equal(named_leaves(last)[name], leaves[averages[0]])
    assert (leaves[averages[0]] != leaves[f"training.trainable.{name}"]).any()


def parsed(*flags: str) -> OptimiserConfig:
    return train_command.parse("train", ["--data", "d", "--out", "o", *flags]).settings.optimiser


def test_flags_name_parts_and_their_settings() -> None:
    kind = "optax.contrib.muon"
    found = parsed(
        *("--optimiser.kind", kind, "--optimiser.kind.ns-steps", "3", "--optimiser.ema", "0.99"),
        *("--optimiser.schedule", "cosine", "--optimiser.schedule.end-fraction", "0.1"),
    )
    assert found.kind == cj.make_part("optimiser", kind, ns_steps=3)
    assert found.schedule == cj.make_part("schedule", "cosine", end_fraction=0.1)
    assert (found.ema, found.learning_rate) == (0.99, 6e-5)
    assert parsed("--recipe", "salad+optax.lion").kind.part_name == "optax.lion"
    assert parsed("--recipe", "salad+cosine").weight_decay == 9.5e-9


def test_plain_functions_are_parts() -> None:
    @cj.register_schedule("test-half")
    def half(step, steps):
        return 1 - step / (2 * steps)

    @cj.register_optimiser("test-signs")
    def signs(learning_rate):
        return optax.sign_sgd(learning_rate)

    config = OptimiserConfig(
        kind="test-signs", schedule="test-half", learning_rate=0.1, weight_decay=0.0
    )
    found, _ = steps_of(config, 4)
    start, *gradients = numbers(4)
    moved = [0.1 * (1 - step / 8) * np.sign(each["vector"]) for step, each in enumerate(gradients)]
    # A float32 learning rate of 0.1 is right to 4e-9.
    np.testing.assert_allclose(found[-1]["vector"], start["vector"] - sum(moved), atol=1e-7)


@cj.register_optimiser("test-rate")
def rate_itself(learning_rate, weight_decay):
    return learning_rate


@cj.register_schedule("test-vector")
def vector(step, steps):
    return jnp.ones(2)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"kind": "test-rate"}, "optimiser test-rate: found to return function, expected a transf"),
        ({"schedule": "test-vector"}, r"schedule test-vector: found to return shape \(2,\), exp"),
    ],
)
def test_what_a_part_returns_is_checked(config, words) -> None:
    with pytest.raises(InputError, match=words):
        steps_of(OptimiserConfig(**config), 1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cj.make_part("optimizer", "sgd"), "kind: found 'optimizer', expected one of "),
        (lambda: cj.make_part("schedule", "linear", end=1.0), "found a setting end, expected one"),
        (lambda: cj.make_part("optimiser", "sgd", momentum=2.0), r"Sgd\.momentum: found 2\.0"),
        (
            lambda: cj.make_part("optimiser", "optax.contrib.muon", preconditioning="x"),
            "optimiser optax.contrib.muon: cannot step .* preconditioning",
        ),
    ],
)
def test_parts_that_do_not_fit_are_refused(make, words) -> None:
    with pytest.raises(InputError, match=words):
        make()
