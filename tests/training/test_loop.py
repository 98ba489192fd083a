"""A run and its files: resumed bit for bit, stopped early, stopped by NaN, claimed by one run."""

import dataclasses
import json
import logging
import pathlib
import re
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from tensorboardX.proto import event_pb2

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.io import read_config
from crisalad_jax.config.plugins import sources_of
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.loader import ImageCache
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.resize import resize_image
from crisalad_jax.data.samplers.base import epoch_batches
from crisalad_jax.evaluation.evaluate import GroupingResult, evaluate
from crisalad_jax.nn.config import with_aggregator
from crisalad_jax.nn.model import Crisalad, Model, extract_tokens
from crisalad_jax.nn.tokens import TransportStatistics
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.training import run_files, trainer, validation
from crisalad_jax.training.batches import PlaceBatches
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import MetricsLog, read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.run_files import (
    RunFiles,
    RunRecord,
    RunState,
    check_run,
    checksum,
    checksum_of_places,
)
from crisalad_jax.training.step import init_train_state, step_config, train_step
from crisalad_jax.training.trainable import merge_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.temporaries import temporary_beside
from tests.conftest import RECIPE, STEPS, random_params

ENDLESS = dataclasses.replace(RECIPE, patience=None)


class Interrupted(Exception):
    """Stands for a kill: nothing is saved on its way out."""


def metrics_of(out: pathlib.Path) -> list[dict[str, Any]]:
    """All that a run logs, except for its times."""
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    times = "images_per_second", "waited_for_images"
    return [{k: v for k, v in line.items() if k not in times} for line in lines]


def assert_same_params(found: Crisalad, expected: Crisalad) -> None:
    found_leaves, expected_leaves = named_leaves(found), named_leaves(expected)
    assert found_leaves.keys() == expected_leaves.keys()
    for name, leaf in found_leaves.items():
        np.testing.assert_array_equal(leaf, expected_leaves[name], err_msg=name)


def assert_same_run(found: pathlib.Path, expected: pathlib.Path) -> None:
    assert metrics_of(found) == metrics_of(expected)
    for name in ("last.safetensors", "best.safetensors"):
        assert_same_params(load_weights(found / name)[0], load_weights(expected / name)[0])


def save_steps(config, places, out, params, steps: tuple[int, ...] = (0,)) -> None:
    """Save a state for each of these steps, with the files of a run as `fit` opens them."""
    weights = checksum(jax.tree.leaves(params))
    checksums = {"places": checksum_of_places(places), "validation": 0, "weights": weights}
    record = RunRecord(checksums, {name: [*each] for name, each in sources_of(config).items()})
    static = step_config(config, steps=STEPS)
    state, _ = init_train_state(params, config.trainable, static)
    files = RunFiles(out, config, record)
    state = files.load(RunState(state, None))
    for files.record.step in steps:
        files.save(state, lambda: params)
    files.close()


PLACES_OF = {"train_step": trainer, "evaluate": validation, "save_weights": run_files}


def fail_at(monkeypatch: pytest.MonkeyPatch, name: str, call: int) -> None:
    """Let the given call, counted from 1, of a function that `fit` uses end the process."""
    function, calls = getattr(PLACES_OF[name], name), []

    def counted(*args, **kwargs):
        calls.append(None)
        if len(calls) == call:
            raise Interrupted
        return function(*args, **kwargs)

    monkeypatch.setattr(PLACES_OF[name], name, counted)


def interrupt(
    monkeypatch: pytest.MonkeyPatch, name: str, call: int, *arguments: Any, **options: Any
) -> None:
    """Start a run that saves after every step, and end it at a call; see `fail_at`."""
    with monkeypatch.context() as patch:
        patch.setattr(run_files, "SAVE_SECONDS", -1.0)
        fail_at(patch, name, call)
        with pytest.raises(Interrupted):
            fit(*arguments, **options)


def transport_of(model: Model, benchmark: Benchmark) -> dict[str, Any]:
    """Means of the transport's statistics of the queries, which are read here again."""
    size = model.config.image_size
    queries = np.stack([resize_image(read_image(q), size) for q in benchmark.queries])
    transport = extract_tokens(model.params, queries, model.config).transport
    assert transport is not None
    # Of a batch of another size: float32 rounding of means of numbers below 100.
    return {
        name: pytest.approx(float(each.mean()), rel=1e-5)
        for name, each in transport._asdict().items()
    }


def test_a_run_leaves_its_files(run: pathlib.Path, benchmark: Benchmark):
    names = "config.json metrics.jsonl tensorboard state last.safetensors best.safetensors"
    assert {path.name for path in run.iterdir()} == set(names.split())
    assert read_config(TrainConfig, run / "config.json") == ENDLESS
    lines = metrics_of(run)
    steps = [line for line in lines if "loss" in line]
    epochs = [(line["step"], line["epoch"]) for line in steps]
    assert epochs == [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (6, 3)]
    # Linear from 1e-3 to 0 over six steps; float32 keeps seven digits.
    np.testing.assert_allclose(
        [line["learning_rate"] for line in steps], 1e-3 * (1 - np.arange(6) / 6), rtol=1e-6
    )
    validations = [line for line in lines if "R@5" in line]
    assert [(line["step"], line["epoch"]) for line in validations] == [(2, 1), (4, 2), (6, 3)]
    params, config = load_weights(run / "last.safetensors")
    (result,) = evaluate(
        Model(params, config), benchmark, groupings=("single",), reading=Reading(quiet=True)
    )
    recalls = {f"R@{k}": recall for k, recall in result.recalls.items()}
    expected = {"step": 6, "epoch": 3} | recalls | transport_of(Model(params, config), benchmark)
    assert validations[-1] == expected
    assert all(set(TransportStatistics._fields) < line.keys() for line in steps)


def test_tensorboard_has_the_same_numbers(run: pathlib.Path):
    """Records: 8 bytes of length, 4 of its checksum, an event, 4 of its checksum."""
    (path,) = (run / "tensorboard").iterdir()
    data, position, found = path.read_bytes(), 0, {}
    while position < len(data):
        length = int.from_bytes(data[position : position + 8], "little")
        event = event_pb2.Event.FromString(data[position + 12 : position + 12 + length])
        position += length + 16
        for value in event.summary.value:
            found[event.step, value.tag] = value.simple_value
    expected = {}
    for line in read_metrics(run / "metrics.jsonl"):
        # The name of the set without what tags may not have: town/test (@UTM, 25 m).
        before = "" if "loss" in line else "town/test___UTM__25_m_/"
        for name, value in line.items():
            if name not in ("step", "epoch"):
                # TensorBoard's values are float32.
                expected[line["step"], before + name.replace("@", "")] = np.float32(value)
    assert found == expected


def test_training_changes_every_parameter_and_leaves_the_initial_ones_to_the_caller(
    run: pathlib.Path, params: Crisalad
):
    trained, _ = load_weights(run / "last.safetensors")
    before, after = named_leaves(params), named_leaves(trained)
    for name, leaf in before.items():
        assert not leaf.is_deleted()
        if leaf.size:  # what has no gradient (see `Salad`) still decays
            assert not np.array_equal(leaf, after[name]), name


@pytest.mark.parametrize(
    ("function", "call", "saved_step"),
    [
        ("train_step", 4, 3),
        # The last step of an epoch is done and saved, its validation is not, and is to come first.
        ("evaluate", 2, 4),
        ("save_weights", 5, 2),  # before the state that would follow
    ],
)
def test_an_interrupted_run_goes_on_as_if_it_had_not_been(
    tmp_path, places, params, benchmark, run, monkeypatch, function, call, saved_step
):
    given = {"validation": benchmark, "initial": params, "quiet": True}
    interrupt(monkeypatch, function, call, ENDLESS, places, tmp_path / "run", **given)
    assert max(int(p.name) for p in (tmp_path / "run" / "state").iterdir()) == saved_step
    result = fit(ENDLESS, places, tmp_path / "run", **given)
    assert_same_run(tmp_path / "run", run)
    assert result.steps == STEPS
    assert_same_params(result.params, load_weights(run / "last.safetensors")[0])


def scripted(
    monkeypatch: pytest.MonkeyPatch,
    recalls_at_5: list[float],
    of: Callable[[Model], Any] = lambda model: jax.device_get(model.params),
) -> list[Any]:
    """Validations that find these recalls; returned: the parameters that each was asked about."""
    seen = []

    def fake(model, benchmark, *, groupings, reading):
        assert groupings == ("single",)
        seen.append(of(model))
        recall = recalls_at_5[len(seen) - 1]
        neighbours = Neighbours(np.zeros((1, 1), np.int64), np.zeros((1, 1), np.float32))
        return [GroupingResult("single", {1: 1 - recall, 5: recall, 10: 1.0}, neighbours)]

    monkeypatch.setattr(validation, "evaluate", fake)
    return seen


@pytest.mark.parametrize(
    ("found", "best", "stopped"),
    [
        ([0.5, 0.4, 0.5], 0, True),  # equal is not better
        ([0.5, 0.6, 0.55], 1, False),
        ([0.5, 0.4, 0.6], 2, False),  # gain starts the count again
    ],
)
def test_early_stop_and_best_weights(
    tmp_path, places, params, benchmark, monkeypatch, found, best, stopped
):
    seen = scripted(monkeypatch, found)
    result = fit(RECIPE, places, tmp_path, validation=benchmark, initial=params, quiet=True)
    assert len(seen) == 3
    assert result.stopped_early == stopped
    assert result.best_recall == found[best]
    assert_same_params(load_weights(tmp_path / "best.safetensors")[0], seen[best])
    assert_same_params(load_weights(tmp_path / "last.safetensors")[0], seen[-1])


def test_early_stop_ends_training_and_stays_so(tmp_path, places, params, benchmark, monkeypatch):
    impatient = dataclasses.replace(RECIPE, patience=1)
    scripted(monkeypatch, [0.5, 0.5])
    for config in impatient, impatient, dataclasses.replace(impatient, epochs=9):
        result = fit(config, places, tmp_path, validation=benchmark, initial=params, quiet=True)
        assert (result.steps, result.stopped_early) == (4, True)
    assert [line["step"] for line in metrics_of(tmp_path) if "loss" in line] == [1, 2, 3, 4]


def test_validations_come_every_so_many_epochs_and_at_the_end(
    tmp_path, places, params, benchmark, monkeypatch
):
    seen = scripted(monkeypatch, [0.5, 0.5])
    config = dataclasses.replace(RECIPE, validate_every=2)
    fit(config, places, tmp_path, validation=benchmark, initial=params, quiet=True)
    assert [line["epoch"] for line in metrics_of(tmp_path) if "R@5" in line] == [2, 3]
    assert len(seen) == 2


def test_a_validation_has_its_own_size(params, benchmark, monkeypatch):
    """And watches the transport at that size."""
    seen = scripted(monkeypatch, [0.5], of=lambda model: model.config)
    config = dataclasses.replace(RECIPE, validation_size=(56, 84))
    metrics = validated(config, params, benchmark).metrics
    larger = dataclasses.replace(RECIPE.model, image_size=(56, 84))
    assert seen == [larger]
    watched = transport_of(Model(params, larger), benchmark)
    assert {name: metrics[name] for name in watched} == watched


def validated(config: TrainConfig, params: Crisalad, benchmark: Benchmark) -> validation.Validation:
    reading = Reading(cache=ImageCache(), quiet=True)
    return validation.Validator(config, benchmark, reading).validate(params)


@pytest.mark.parametrize(
    ("monitor", "best"),
    # Of R@5 0.25 and 0.75 the R@1 are 0.75 and 0.25, and the sums equal: the first counts.
    [("R@1", [0.75, 1]), ("R@5", [0.75, 2]), ("R@1+R@5", [1.0, 1])],
)
def test_the_best_weights_are_chosen_by_the_recall_that_is_named(
    params, benchmark, monkeypatch, monitor, best
):
    scripted(monkeypatch, [0.25, 0.75])
    config = dataclasses.replace(RECIPE, monitor=monitor)
    record = RunRecord({}, {})
    for record.step in (1, 2):
        record.add_validation(validated(config, params, benchmark).monitored, config)
    assert record.best == [best]


def test_without_salad_a_validation_has_no_transport_to_watch(benchmark, monkeypatch):
    scripted(monkeypatch, [0.5])
    model = with_aggregator(RECIPE.model, "class-token", "tiny")
    found = validated(dataclasses.replace(RECIPE, model=model), random_params(model), benchmark)
    assert found.metrics.keys() == {"R@1", "R@5", "R@10"}


@pytest.mark.slow
def test_nothing_is_compiled_after_the_first_step_and_validation(
    tmp_path, places, params, benchmark, monkeypatch
):
    compiled, after_step = [], []

    def count(name: str, *_: object, **__: object) -> None:
        if name.endswith("backend_compile_duration"):
            compiled.append(name)

    def step(*args):
        result = train_step(*args)
        after_step.append(len(compiled))
        return result

    jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(count)
    monkeypatch.setattr(trainer, "train_step", step)
    fit(ENDLESS, places, tmp_path, validation=benchmark, initial=params, quiet=True)
    jax.monitoring.unregister_event_duration_listener(count)
    assert len(after_step) == STEPS
    assert 0 < after_step[0] == after_step[1] < after_step[2]  # a validation is between
    assert len(compiled) == after_step[2]


def test_without_validation_there_is_no_best(tmp_path, places, params, run):
    result = fit(RECIPE, places, tmp_path, initial=params, quiet=True)
    assert (result.steps, result.best_recall, result.stopped_early) == (STEPS, None, False)
    # As a run that is validated, to the bit.
    assert_same_params(result.params, load_weights(run / "last.safetensors")[0])
    assert not (tmp_path / "best.safetensors").exists()


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_good_state(
    tmp_path, places, params, monkeypatch
):
    """The step after it has begun when its loss is read, and must change nothing."""
    config = dataclasses.replace(RECIPE, trainable="adapters,head")
    good = []

    def step(state, frozen, *args):
        if len(good) == 2:
            frozen = jax.tree.map(lambda leaf: leaf * np.nan, frozen)
        state, metrics = train_step(state, frozen, *args)
        good.append(jax.device_get(merge_params(state.trainable, frozen, config.model)))
        return state, metrics

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "train_step", step)
        with pytest.raises(InputError, match=r"loss nan.* at step 3,.* after step 2 is saved"):
            fit(config, places, tmp_path, initial=params, quiet=True)
    assert len(good) == 4
    assert [line["step"] for line in metrics_of(tmp_path)] == [1, 2]
    last, _ = load_weights(tmp_path / "last.safetensors")
    assert_same_params(last, good[1])
    assert_same_params(last, good[3])
    # The state is whole: the run goes on from it.
    assert fit(config, places, tmp_path, initial=params, quiet=True).steps == STEPS


def test_a_step_is_started_before_the_one_before_is_read_in_one_fetch(
    tmp_path, places, params, monkeypatch
):
    """Or the devices would wait while its numbers are fetched, one by one, and logged."""
    config, events = dataclasses.replace(RECIPE, epochs=1), []

    def recorded(name, function=lambda *args, **options: None):
        def call(*args, **options):
            events.append(name)
            return function(*args, **options)

        return call

    monkeypatch.setattr(trainer, "train_step", recorded("step", train_step))
    monkeypatch.setattr(trainer.jax, "device_get", recorded("fetch", jax.device_get))
    monkeypatch.setattr(RunFiles, "log", recorded("line"))
    monkeypatch.setattr(RunFiles, "save", recorded("save"))
    fit(config, places, tmp_path, initial=params, quiet=True)
    found = events[events.index("step") :]
    assert found == ["step", "step", "fetch", "line", "fetch", "line", "save"]


def test_an_error_of_the_system_that_is_none_of_writing_is_not_told_as_one(
    tmp_path, places, params, monkeypatch
):
    def batches(self, step):
        raise OSError("network is unreachable")
        yield

    monkeypatch.setattr(PlaceBatches, "batches", batches)
    with pytest.raises(OSError, match=r"^network is unreachable$"):
        fit(RECIPE, places, tmp_path, initial=params, quiet=True)


def test_a_log_that_cannot_be_written_is_one_line(tmp_path, places, params, monkeypatch):
    def write(self, values, *, of=""):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(MetricsLog, "write", write)
    with pytest.raises(InputError, match=f"^{tmp_path}: cannot be written: No space left"):
        fit(RECIPE, places, tmp_path, initial=params, quiet=True)


def test_a_plan_without_mass_has_no_statistics_and_ends_nothing(
    tmp_path, places, params, monkeypatch
):
    def step(*args):
        state, metrics = train_step(*args)
        transport = metrics.transport._replace(dustbin_share=np.float32(np.nan))
        return state, metrics._replace(transport=transport)

    monkeypatch.setattr(trainer, "train_step", step)
    assert fit(RECIPE, places, tmp_path, initial=params, quiet=True).steps == STEPS
    for line in metrics_of(tmp_path):
        assert "dustbin_share" not in line
        assert line["marginal_error"] >= 0


def test_unreadable_images_are_counted_each_time_they_come_up(tmp_path, city, params):
    places = read_places(city, min_images=2)
    bad = np.arange(0, len(places.files), 5)
    for image in bad:
        places.path(image).write_bytes(b"")
    drawn = [
        epoch_batches(
            places,
            places_per_batch=3,
            images_per_place=2,
            sampler="within-city",
            seed=5,
            epoch=epoch,
        )
        for epoch in range(3)
    ]
    expected = np.isin(np.concatenate(drawn).reshape(STEPS, 6), bad).sum(axis=1)
    assert expected.sum() > 0
    result = fit(RECIPE, places, tmp_path / "run", initial=params, on_bad_image="skip", quiet=True)
    assert result.skipped_images == expected.sum()
    assert [line["skipped_images"] for line in metrics_of(tmp_path / "run")] == expected.tolist()
    result = fit(RECIPE, places, tmp_path / "run", initial=params, on_bad_image="skip", quiet=True)
    assert result.skipped_images == expected.sum()


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [
        ({"trainable": "last-3-blocks,norm,head"}, {}, "found last-3-blocks, expected 1 to"),
        ({}, {"num_threads": -1}, "num_threads: found -1, expected at least 0"),
        ({}, {"shard_state": True}, "shard_state: found one device"),
    ],
)
def test_what_does_not_fit_is_found_before_anything_is_written(
    tmp_path, places, params, change, arguments, words
):
    config = dataclasses.replace(RECIPE, **change)
    with pytest.raises(InputError, match=words):
        fit(config, places, tmp_path / "run", initial=params, quiet=True, **arguments)
    assert not (tmp_path / "run").exists()


def test_a_run_resumes_only_from_the_same_weights_and_places(tmp_path, places, params):
    save_steps(RECIPE, places, tmp_path, params)
    other = jax.tree.map(lambda leaf: leaf + 1, params)
    with pytest.raises(InputError, match=f"{tmp_path}: the run started from other weights"):
        fit(RECIPE, places, tmp_path, initial=other)
    other = dataclasses.replace(places, files=(*places.files[:-1], "Images/Brill/another.jpg"))
    with pytest.raises(InputError, match=f"{tmp_path}: the run started from other places"):
        fit(RECIPE, other, tmp_path, initial=params)


@pytest.mark.parametrize("name", ["thesis.tex", ".bashrc", ".git"])
def test_a_folder_of_other_files_is_left_alone(tmp_path, name):
    """A home folder may hold hidden files alone."""
    (tmp_path / name).write_text("words")
    with pytest.raises(InputError, match=f"{tmp_path}: found files but no run"):
        check_run(tmp_path, RECIPE)
    with pytest.raises(InputError, match=f"{re.escape(name)}: found a file, expected a run or"):
        check_run(tmp_path / name, RECIPE)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_hidden_files_of_the_user_outlive_a_run(tmp_path, places, params):
    """A run once removed every hidden file of its folder."""
    hidden = {".env": "secret", ".gitignore": "*", ".bashrc": "alias"}
    run = tmp_path / "run"
    save_steps(RECIPE, places, run, params)
    cut_off = temporary_beside(run / "last.safetensors")
    for name, text in (hidden | {cut_off.name: "cut off"}).items():
        (run / name).write_text(text)
    save_steps(RECIPE, places, run, params, (1,))
    assert {p.name: p.read_text() for p in run.glob(".*")} == hidden


def test_the_log_drops_what_will_be_repeated_and_a_line_cut_off(tmp_path):
    path = tmp_path / "metrics.jsonl"
    first, second, third = ({"step": step, "loss": 0.5} for step in (1, 2, 3))
    validations = [{"step": 1, "R@5": 0.5}, {"step": 2, "R@5": 0.6}]
    lines = [first, validations[0], second, validations[1], third]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"st')
    log = MetricsLog(tmp_path, keep_up_to=2, validated=1)
    log.write({"step": 3, "loss": 0.1})
    log.close()
    assert read_metrics(path) == [first, validations[0], second, {"step": 3, "loss": 0.1}]


def test_a_step_that_does_not_fit_is_told_before_the_first_file(
    tmp_path, places, params, monkeypatch
):
    """A limit stands for a GPU's, which a CPU does not have."""
    monkeypatch.setattr(trainer, "memory_limit", lambda devices: 2**12)
    with pytest.raises(InputError, match=r"found a step that takes .* GB of each device, expected"):
        fit(RECIPE, places, tmp_path / "run", initial=params, quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_step_that_fits_is_compiled_once(tmp_path, places, params, monkeypatch, caplog):
    monkeypatch.setattr(trainer, "memory_limit", lambda devices: 2**34)
    jax.clear_caches()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        fit(dataclasses.replace(RECIPE, epochs=1), places, tmp_path, initial=params, quiet=True)
    compiled = re.findall(r"Finished XLA compilation of jit\((\w+)\)", caplog.text)
    assert compiled.count("train_step") == 1
