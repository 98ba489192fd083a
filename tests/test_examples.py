"""The examples: each runs, and what it computes is held against an independent source."""

import ast
import csv
import json
import os
import pathlib
import subprocess
import sys
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config import plugins
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.sinkhorn import (
    SinkhornConfig,
    SinkhornResult,
    SinkhornStep,
    assign_with_dustbin,
    solve,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"
PLUGINS = sorted((EXAMPLES / "plugins").glob("*.py"))


pytestmark = pytest.mark.usefixtures("own_parts")


def example(name: str) -> ModuleType:
    """Load an example as --plugin does."""
    path = (EXAMPLES / f"{name}.py").resolve()
    plugins.load_plugin(str(path))
    return sys.modules[plugins._LOADED[str(path)]]


def plan_of(result: SinkhornResult) -> np.ndarray:
    return np.asarray(jnp.exp(result.log_plan))


# The five examples


def test_an_example_is_a_script() -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / "sinkhorn_step.py"], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert done.stdout.startswith("masses of the columns: 3.000, ")


@pytest.mark.parametrize("path", [*EXAMPLES.glob("*.py"), *PLUGINS], ids=lambda path: path.stem)
def test_every_example_says_how_it_is_run(path: pathlib.Path) -> None:
    text = path.read_text(encoding="utf-8")
    words = ast.get_docstring(ast.parse(text)) or ""
    name = path.relative_to(EXAMPLES.parent).as_posix()
    is_script = 'if __name__ == "__main__":' in text
    assert is_script == (path.parent == EXAMPLES)
    assert f"python {name}" in words or not is_script
    assert f"--plugin {name}" in words or "register" not in text
    assert name.removeprefix("examples/") in (EXAMPLES / "README.md").read_text(encoding="utf-8")


def test_the_steps_columns_are_priced_where_they_are_full(capsys) -> None:
    """The conditions of the optimum: of a concave problem they are enough."""
    result, gradient = example("sinkhorn_step").main()
    plan, price = plan_of(result), np.asarray(result.potentials.column)
    np.testing.assert_allclose(plan.sum(axis=1), 1, rtol=1e-6)  # met last, to float32's rounding
    masses = plan.sum(axis=0)
    # A hundred iterations of a problem that converges by a digit in fewer than ten.
    np.testing.assert_allclose(masses[0], 3, rtol=1e-5)
    assert (masses[1:] < 2.9).all()
    assert price[0] < -0.1
    np.testing.assert_array_equal(price[1:], 0)
    assert np.isfinite(gradient).all()
    assert "3.000" in capsys.readouterr().out


def test_the_aggregator_averages_as_numpy_does() -> None:
    module = example("aggregator")
    _, config, descriptors = module.main()
    assert descriptors.shape == (2, config.descriptor_dim)
    generator = np.random.default_rng(0)
    patches = generator.normal(size=(2, 5, 6))
    queries = generator.normal(size=(6, 3))
    scores = np.exp(patches @ queries)
    shares = scores / scores.sum(axis=1, keepdims=True)
    expected = np.concatenate([(shares[..., h, None] * patches).sum(axis=1) for h in range(3)], 1)
    part = module.AttentionPool(heads=3)
    features = Features(jnp.zeros((2, 6)), jnp.asarray(patches, jnp.float32))
    tokens = part.apply({"queries": jnp.asarray(queries)}, features, (1, 5), key=None)
    np.testing.assert_allclose(tokens.global_token, expected, atol=1e-5)  # ten roundings of float32
    assert tokens.local.shape == (2, 0, 18)


def test_the_loss_is_that_of_loops() -> None:
    module = example("loss")
    losses = module.main()
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < losses[0] / 10
    generator = np.random.default_rng(1)
    units = generator.normal(size=(7, 4))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    labels = [0, 0, 0, 1, 1, 2, 2]  # the last is not valid: place 2 has no pair
    expected = []
    for i in range(5):
        others = [j for j in range(6) if j != i]
        same = [units[i] @ units[j] for j in others if labels[j] == labels[i]]
        unlike = [units[i] @ units[j] for j in others if labels[j] != labels[i]]
        expected.append(np.log1p(np.exp(10 * (max(unlike) - min(same)))))
    found = module.cj.metric_loss(
        jnp.asarray(units, jnp.float32),
        jnp.array(labels),
        module.cj.LossConfig(kind="soft-triplet", miner="none"),
        valid=jnp.arange(7) < 6,
    ).loss
    # Gaps of a rounding of float32, times the scale of 10.
    np.testing.assert_allclose(found, np.mean(expected), rtol=1e-5)


def test_the_losss_gradient_is_finite_without_pairs() -> None:
    cj = example("loss").cj
    config = cj.LossConfig(kind="soft-triplet")

    def loss(units: Any) -> Any:
        return cj.metric_loss(units, jnp.arange(3), config).loss

    value, gradient = jax.value_and_grad(loss)(jnp.eye(3))
    assert value == 0
    np.testing.assert_array_equal(gradient, 0)


@pytest.mark.slow
def test_the_loop_learns_to_tell_places_apart(capsys) -> None:
    module = example("training_loop")
    losses, trained, _ = module.main()
    assert len(capsys.readouterr().out.splitlines()) == len(losses) == module.STEPS
    assert losses[-1] < losses[0] / 4
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(trained))


def test_a_layer_is_torchs() -> None:
    pytest.importorskip("torch")
    differences = example("parity_layer").main()
    assert len(differences) == 13
    # Relative to the largest number; sums of 64 products in float32, in another order.
    assert max(differences.values()) < 5e-6


# The plug-ins


def problem_of(epsilon: float = 1.0) -> tuple[Any, Any, Any]:
    """Scores of two problems, over epsilon, and masses that are not all alike."""
    scores = jax.random.normal(jax.random.key(3), (2, 12, 5)) / epsilon
    return scores, jnp.zeros(12), jnp.log(jnp.array([1.0, 2, 2, 3, 4]))


@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_without_momentum_a_step_is_sinkhorns(domain: Any) -> None:
    step = example("plugins/momentum").Momentum(1.0)
    scores, *masses = problem_of()
    weights = jax.random.normal(jax.random.key(4), scores.shape)

    def weighted(scores: Any, how: SinkhornConfig) -> Any:
        log_plan = solve(scores, *masses, config=how).log_plan
        return (log_plan * weights).sum(), log_plan

    slopes = jax.value_and_grad(weighted, has_aux=True)
    (_, expected), slope = slopes(scores, SinkhornConfig(domain=domain))
    (_, found), gradient = slopes(scores, SinkhornConfig(step=step, domain=domain))
    # Roundings of logarithms up to 5, of three iterations, in another order.
    np.testing.assert_allclose(found, expected, atol=5e-6)
    np.testing.assert_allclose(gradient, slope, atol=5e-6)


def test_momentum_takes_fewer_iterations_of_a_hard_problem() -> None:
    """Of an eigenvalue of 1 - x it makes 1 - 2x, to first order: half as many."""
    momentum = example("plugins/momentum").Momentum
    steps = (momentum(1.0), momentum(1.5), "sinkhorn")
    until = {"tolerance": 1e-4, "iterations": 5000, "gradient": "stop"}
    results = [solve(*problem_of(0.1), config=SinkhornConfig(step, **until)) for step in steps]
    assert all(result.converged[0] for result in results)
    plain, half, sinkhorns = (int(result.iterations[0]) for result in results)
    assert plain == sinkhorns
    assert plain > 100
    assert half < 0.6 * plain


def test_momentum_arrives_where_sinkhorn_does() -> None:
    momentum = example("plugins/momentum").Momentum
    converged = {"tolerance": 1e-6, "iterations": 500, "gradient": "implicit"}
    found, expected = (
        solve(*problem_of(), config=SinkhornConfig(step=step, **converged))
        for step in (momentum(), SinkhornStep())
    )
    # Ten times the tolerance, relative.
    np.testing.assert_allclose(plan_of(found), plan_of(expected), rtol=1e-5)


def test_a_learnt_epsilon_is_epsilon() -> None:
    example("plugins/learnt_epsilon")
    config = SinkhornConfig(step="learnt-epsilon", iterations=20)
    params = {"log_epsilon": jnp.log(jnp.float32(0.3))}
    found = solve(*problem_of(), config=config, step_params=params)
    expected = solve(*problem_of(), epsilon=0.3, config=SinkhornConfig(iterations=20))
    # Scores up to 10 over epsilon, in float32.
    np.testing.assert_allclose(plan_of(found), plan_of(expected), rtol=5e-5)


IMPLICIT = {"iterations": 500, "tolerance": 1e-12, "gradient": "implicit"}


@pytest.mark.parametrize("how", [{"iterations": 4}, IMPLICIT], ids=["unrolled", "implicit"])
def test_a_learnt_epsilons_gradient_is_a_finite_difference(how: Any) -> None:
    example("plugins/learnt_epsilon")
    with jax.enable_x64(True):
        scores, log_mu, log_nu = (jnp.asarray(each, jnp.float64) for each in problem_of())
        config = SinkhornConfig(step="learnt-epsilon", **how)

        def value(log_epsilon: Any) -> Any:
            params = {"log_epsilon": log_epsilon}
            result = solve(scores, log_mu, log_nu, config=config, step_params=params)
            return (jnp.exp(result.log_plan) * scores).sum()

        at, by = jnp.asarray(-0.5), 1e-4
        difference = (value(at + by) - value(at - by)) / (2 * by)
        gradient = jax.grad(value)(at)
    assert abs(gradient) > 0.1
    np.testing.assert_allclose(gradient, difference, rtol=1e-6)  # the square of the difference


def test_a_dustbin_network_of_zeros_is_a_constant() -> None:
    """Columns are relaxed: else a constant would change nothing at all."""
    module = example("plugins/learnt_dustbin")
    part = module.NetworkDustbin(hidden=3)
    params = part.init(jax.random.key(0), 7)
    scores, patches = (jax.random.normal(jax.random.key(k), (2, 9, n)) for k, n in ((1, 4), (2, 7)))
    relaxed = {"column_tau": 0.7}
    found = assign_with_dustbin(scores, params, part, patches=patches, **relaxed)
    expected = assign_with_dustbin(scores, jnp.float32(1), "column", **relaxed)
    np.testing.assert_array_equal(found.log_plan, expected.log_plan)
    other = assign_with_dustbin(scores, jnp.float32(2), "column", **relaxed)
    assert abs(other.log_plan - expected.log_plan).max() > 0.1
    # And else it is the score that numpy's network gives each patch.
    params |= {"out": jnp.array([1.0, -2, 0.5])}
    hidden = np.maximum(np.asarray(patches) @ np.asarray(params["hidden"]), 0)
    column = jnp.asarray(hidden @ np.asarray(params["out"]) + 1)
    found = assign_with_dustbin(scores, params, part, patches=patches)
    expected = assign_with_dustbin(scores, column, "token")
    np.testing.assert_allclose(found.log_plan, expected.log_plan, atol=1e-5)  # float32's products


@pytest.mark.parametrize(
    ("step", "dustbin"), [("learnt-epsilon", "network"), ("momentum", "column")]
)
def test_gradients_are_finite_in_a_model(step: str, dustbin: str) -> None:
    """Of all that SALAD learns; what a plug-in learns has a gradient, too."""
    for path in PLUGINS:
        example(f"plugins/{path.stem}")
    salad = SaladConfig(
        clusters=4,
        cluster_dim=8,
        token_dim=16,
        hidden=16,
        sinkhorn=SinkhornConfig(step=step),
        dustbin=dustbin,
    )
    params = salad.init(jax.random.key(0), ViTConfig(dim=12), (3, 3))
    keys = jax.random.split(jax.random.key(1))
    features = Features(
        *(jax.random.normal(k, (2, *n, 12)) for k, n in zip(keys, ((), (9,)), strict=True))
    )
    weights = jax.random.normal(jax.random.key(2), (2, 4, 8))

    @jax.jit
    def value(params: Any) -> Any:
        tokens = salad.apply(params, features, (3, 3), key=None)
        return (tokens.local * weights).sum(), tokens.transport

    (_, statistics), gradient = jax.value_and_grad(value, has_aux=True)(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((gradient, statistics)))
    leaves = named_leaves(gradient).items()
    learnt = [leaf for name, leaf in leaves if "log_eps" in name or ".out" in name]
    assert len(learnt) == (2 if dustbin == "network" else 0)
    assert all(abs(leaf).max() > 1e-4 for leaf in learnt)
    assert abs(gradient.score.fc2.weight).max() > 1e-3


def test_a_step_that_learns_asks_for_its_parameters() -> None:
    example("plugins/learnt_epsilon")
    words = "^step learnt-epsilon: found no step_params, expected those of its init_params"
    with pytest.raises(InputError, match=words):
        solve(*problem_of(), config=SinkhornConfig(step="learnt-epsilon"))


def test_the_search_says_what_it_needs(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert example("prune").main() is None
    assert capsys.readouterr().out == "optuna is not installed: pip install optuna\n"


def test_the_sweep_says_what_it_needs(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert example("sweep").main() is None
    assert capsys.readouterr().out == "Ray Tune is not installed: pip install 'ray[tune]'\n"


@pytest.mark.slow
def test_the_sweep_reports_the_recalls_of_its_runs(tmp_path) -> None:
    """As a program, since Tune changes signals and folders; the runs' own tables have the same."""
    code = f"""
import json
import sweep
results = sweep.main({str(tmp_path)!r})
json.dump([[r.config["learning_rate"], r.metrics["trial_id"], r.metrics["epoch"],
    r.metrics["recall"]] for r in results], open({str(tmp_path / "found.json")!r}, "w"))
"""
    # Workers look for modules where this says, too.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(EXAMPLES), str(EXAMPLES.parent)])
    }
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "found.json").read_text())
    assert [rate for rate, *_ in found] == [1e-2, 1e-3, 1e-5]
    for _, trial, epoch, recall in found:
        with (tmp_path / "runs" / trial / "validations.csv").open() as file:
            recalls = {row["epoch"]: row["R@1"] for row in csv.DictReader(file)}
        assert float(recalls[str(epoch)]) == recall
    assert max(epoch for _, _, epoch, _ in found) == 4


@pytest.mark.slow
def test_the_search_prunes_runs_that_fall_behind() -> None:
    optuna = pytest.importorskip("optuna")
    study = example("prune").main()
    first, *others = (trial.state for trial in study.trials)
    assert first == optuna.trial.TrialState.COMPLETE  # there is nothing to compare it with
    assert optuna.trial.TrialState.PRUNED in others
