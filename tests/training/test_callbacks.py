"""Callbacks: the numbers that they get, a run that one stops, and what they write elsewhere."""

import csv
import dataclasses
import sys
import types
from typing import Any
from unittest import mock

import pytest

import crisalad_jax as cj
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli import train as train_command
from crisalad_jax.data.loader import ImageCache
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.training import callbacks as module
from crisalad_jax.training import validation
from crisalad_jax.training.callbacks import CALLBACKS, Callback, Callbacks, make_callback
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.utils.errors import InputError
from tests.training.test_loop import (
    ENDLESS,
    assert_same_params,
    assert_same_run,
    metrics_of,
)


class Recorder(Callback):
    """Keeps what it gets, and stops the run at some steps and validations."""

    def __init__(self, *stops: tuple[str, int]) -> None:
        self.stops, self.got = stops, []

    def take(self, kind: str, numbers: Any) -> None:
        self.got.append((kind, dict(numbers)))
        if (kind, numbers["step"]) in self.stops:
            raise cj.StopTraining

    def on_start(self, out, config, step) -> None:
        self.got.append(("start", {"step": step}))

    def on_step(self, numbers) -> None:
        self.take("step", numbers)

    def on_validation(self, numbers) -> None:
        self.take("validation", numbers)

    def on_end(self, result) -> None:
        self.got.append(("end", {"step": result.steps, "stopped": result.stopped_early}))


def test_a_run_that_callbacks_stop_resumes_to_the_same_bits(
    places, params, benchmark, run, tmp_path
) -> None:
    """First at a step, then at a validation; `run` was not stopped. Its epochs have two steps."""
    out, tables = tmp_path / "run", []
    arguments = ENDLESS, places, out
    options = {"validation": benchmark, "initial": params, "quiet": True}
    # The step after the one that is logged is under way, and is finished.
    for stop, taken in ((("step", 1), 2), (("validation", 4), 4), (None, 6)):
        recorder = Recorder(*([stop] if stop else []))
        result = fit(*arguments, **options, callbacks=[recorder, "csv"])
        assert (result.steps, result.stopped_early) == (taken, stop is not None)
        assert recorder.got[-1] == ("end", {"step": taken, "stopped": stop is not None})
        tables.append(recorder)
    assert_same_run(out, run)
    starts = [recorder.got[0] for recorder in tables]
    assert starts == [("start", {"step": step}) for step in (0, 2, 4)]
    # All of its lines, each once, in their order.
    found = [each for recorder in tables for each in recorder.got[1:-1]]
    lines = read_metrics(out / "metrics.jsonl")
    assert found == [("step" if "loss" in line else "validation", line) for line in lines]
    for name, kind in (("steps", "step"), ("validations", "validation")):
        with (out / f"{name}.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        expected = [numbers for each, numbers in found if each == kind]
        assert rows == [{key: str(value) for key, value in each.items()} for each in expected]


@pytest.mark.slow
def test_a_run_whose_batches_depend_on_the_model_resumes_to_the_same_bits(
    places, params, tmp_path
) -> None:
    """Stopped within its second epoch, whose batches the weights of its beginning have drawn."""
    plain, how = dataclasses.replace(ENDLESS, places_per_batch=2, epochs=2), {"quiet": True}
    config = dataclasses.replace(plain, sampler="hard-negatives")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    fit(config, places, whole, initial=params, **how)
    # The step after the one that is logged is under way, and is finished.
    for stop, taken in ((("step", 5), 6), (None, 8)):
        recorder = Recorder(*([stop] if stop else []))
        result = fit(config, places, parts, initial=params, callbacks=[recorder], **how)
        assert result.steps == taken
    assert metrics_of(parts) == metrics_of(whole)
    assert_same_params(load_weights(parts / "last.safetensors")[0], result.params)
    assert_same_params(load_weights(whole / "last.safetensors")[0], result.params)
    fit(plain, places, tmp_path / "plain", initial=params, **how)
    assert metrics_of(tmp_path / "plain")[0]["loss"] != metrics_of(whole)[0]["loss"]


class Skipped(tuple):
    """Of a validation that skips nothing."""

    def rest_of(self, benchmark):
        return benchmark


def test_parts_own_numbers_are_those_of_a_validation(monkeypatch, benchmark, params):
    result = types.SimpleNamespace(recalls={1: 0.25, 5: 0.5}, skipped=Skipped())
    monkeypatch.setattr(validation, "evaluate", lambda *_, **__: [result])
    monkeypatch.setattr(validation.Validator, "_watch_transport", lambda *_: {})
    monkeypatch.setattr(SaladConfig, "numbers", lambda _, own: {"dust_bin": own.dust_bin})
    monkeypatch.setattr(CrossImageConfig, "numbers", lambda _, own: {"layers": len(own.layers)})
    reading = Reading(cache=ImageCache(0))
    found = validation.Validator(ENDLESS, benchmark, reading).validate(params)
    own = {"dust_bin": float(params.aggregator.dust_bin), "layers": 2}
    assert found.metrics == {"R@1": 0.25, "R@5": 0.5, **own}


def test_a_table_drops_what_comes_again(tmp_path) -> None:
    table = make_callback("csv")
    table.on_start(tmp_path, ENDLESS, 0)
    for step in (1, 2, 3):
        table.on_step({"step": step, "loss": 0.5, "accuracy": step})
    again = make_callback("csv")
    again.on_start(tmp_path, ENDLESS, 2)
    again.on_step({"step": 3, "accuracy": 7})  # a loss that is not logged leaves its cell empty
    assert (tmp_path / "steps.csv").read_text().split() == [
        *("step,loss,accuracy", "1,0.5,1", "2,0.5,2", "3,,7")
    ]


def test_other_processes_than_the_primary_call_none(monkeypatch) -> None:
    monkeypatch.setattr(module, "is_primary", lambda: False)
    recorder = Recorder(("step", 1))
    others = Callbacks([recorder])
    others.call("on_step", {"step": 1})
    assert (recorder.got, others.stopped) == ([], False)


def test_weights_and_biases_gets_the_numbers(monkeypatch, tmp_path) -> None:
    fake: Any = mock.MagicMock(__spec__=None)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for step in (0, 4):
        each = make_callback("wandb")
        each.on_start(tmp_path / "run" if step is None else tmp_path, ENDLESS, step)
    each.on_step({"step": 5, "loss": 0.5})
    each.on_validation({"step": 5, "R@1": 0.25})
    each.on_end(None)
    # A run that resumes is the same one.
    first, second = (call.kwargs["id"] for call in fake.init.call_args_list)
    assert first == second
    assert len(first) == 8
    assert fake.init.call_args.kwargs["resume"] == "allow"
    assert fake.init.call_args.kwargs["config"]["epochs"] == ENDLESS.epochs
    logged = [(call.args[0], call.kwargs["step"]) for call in fake.log.call_args_list]
    assert logged == [({"step": 5, "loss": 0.5}, 5), ({"step": 5, "R@1": 0.25}, 5)]
    fake.finish.assert_called_once_with()


def test_mlflow_gets_the_numbers(monkeypatch, tmp_path) -> None:
    fake: Any = mock.MagicMock(__spec__=None)
    fake.start_run.return_value = types.SimpleNamespace(info=types.SimpleNamespace(run_id="7"))
    monkeypatch.setitem(sys.modules, "mlflow", fake)
    for step in (0, 4):
        each = make_callback("mlflow")
        each.on_start(tmp_path, ENDLESS, step)
    each.on_validation({"step": 5, "R@1": 0.25})
    each.on_end(None)
    runs = [call.kwargs for call in fake.start_run.call_args_list]
    assert runs == [{"run_name": tmp_path.name}, {"run_id": "7"}]
    # No name of a metric may have an @.
    fake.log_metrics.assert_called_once_with({"step": 5, "R1": 0.25}, step=5)
    fake.end_run.assert_called_once_with()


@pytest.mark.usefixtures("_unchecked")
def test_callbacks_that_do_not_fit_are_refused(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(InputError, match=r"^callback wandb: found no module wandb, .* pip install"):
        make_callback("wandb")
    with pytest.raises(InputError, match=r"^callback: found 'x', expected .* one of csv, mlflow"):
        make_callback("x")
    with pytest.raises(InputError, match=r"^callback: found 3, expected a Callback object or one"):
        make_callback(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"name taken by crisalad_jax.training.callbacks"):
        cj.register_callback("csv")(Recorder)
    with pytest.raises(InputError, match=r"register_callback 'mine': found 3, expected a Callback"):
        cj.register_callback("mine")(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"Mine: found a method on_steps, .* expected on_end"):
        type("Mine", (Callback,), {"on_steps": lambda self, numbers: None})
    assert "mine" not in CALLBACKS


def test_flags_name_callbacks() -> None:
    given = ["--data", "d", "--out", "o", "--callback", "csv", "wandb"]
    assert train_command.parse("train", given).callback == ("csv", "wandb")


def test_a_run_that_is_stopped_before_its_first_step_has_no_curves(shared, tmp_path) -> None:
    class Never(Callback):
        def on_start(self, out, config, step):
            raise cj.StopTraining

    result = cj.train(ENDLESS, shared / "city", tmp_path / "run", callbacks=[Never()], quiet=True)
    assert (result.steps, result.stopped_early) == (0, True)
    assert not (tmp_path / "run" / "curves.png").exists()
    assert cj.train(ENDLESS, shared / "city", tmp_path / "run", quiet=True).steps == 6
    assert (tmp_path / "run" / "curves.png").exists()
