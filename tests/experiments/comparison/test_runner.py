"""Comparisons that are carried out, interrupted, and gone on with."""

import contextlib
import dataclasses
import json
import os
import shutil
import socket
import statistics
import time
import types

import jax
import pytest

from crisalad_jax.checkpoints.weights import load_weights, model_hash, save_weights
from crisalad_jax.cli import main
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments import comparison
from crisalad_jax.experiments.comparison import (
    METHODS,
    ComparedMethod,
    ComparisonConfig,
    names_to_compare,
    plan,
    runner,
)
from crisalad_jax.experiments.comparison.results import runs_of
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Model, init_crisalad
from crisalad_jax.training import start
from crisalad_jax.utils import locks, temporaries
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.output import Note
from tests.cli.test_cli import fails, succeeds
from tests.conftest import BATCH, STEPS, assert_equal

pytestmark = pytest.mark.usefixtures("quick")


def run(config: ComparisonConfig, out) -> comparison.Summary:
    return comparison.compare(config, out, quiet=True)


def result_of(folder):
    return read_json(folder / "result.json", "a result")


def change(folder, **changes):
    write_json(folder / "result.json", result_of(folder) | changes)


def row_of(out):
    (row,) = json.loads((out / "results.json").read_text())["rows"]
    return row


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder for a comparison that one test makes and others copy."""
    return tmp_path_factory.mktemp("made") / "out"


@pytest.fixture
def finished(made, flags, tmp_path):
    """A comparison that was carried out, to spoil."""
    if not made.exists():
        assert main([*map(str, flags), "--out", str(made)]) == 0
    out = tmp_path / "out"
    shutil.copytree(made, out)
    return out


def reading() -> Reading:
    return Reading(batch_size=BATCH, quiet=True)


def stamps(out):
    """When each file of results and weights was written."""
    kept = (path for path in out.rglob("*") if path.suffix in (".json", ".safetensors"))
    return {
        path.relative_to(out): path.stat().st_mtime_ns for path in kept if "state" not in path.parts
    }


def test_recalls_are_those_of_the_weights_that_are_left(finished, benchmark):
    """Evaluated again, apart; the mean and the deviation by the statistics module."""
    row = row_of(finished)
    by_seed, digests = [], set()
    for seed in (0, 1):
        run_folder = finished / "crisalad" / f"seed-{seed}" / "run"
        params, model = whole = load_weights(run_folder / "last.safetensors")
        (result,) = evaluate(whole, benchmark, groupings=("single",), reading=reading())
        by_seed.append(result.recalls)
        assert json.loads((run_folder / "config.json").read_text())["seed"] == seed
        digests.add(model_hash(params, model))
    assert len(digests) == 2
    (found,) = row["recalls"].values()
    for k in (1, 5):
        values = [recalls[k] for recalls in by_seed]
        assert found[f"R@{k}"]["by_seed"] == values
        assert found[f"R@{k}"]["mean"] == pytest.approx(statistics.mean(values), abs=1e-15)
        assert found[f"R@{k}"]["spread"] == pytest.approx(statistics.stdev(values), abs=1e-15)
    leaves = sum(leaf.size for leaf in jax.tree.leaves(params))
    assert (row["dimension"], row["parameters"]) == (model.descriptor_dim, leaves)
    assert (row["speed"], row["images_per_second"]) == (1, None)
    # To itself: either run over either, so that its range is the runs' own.
    records = [result_of(finished / "crisalad" / f"seed-{n}")["training"] for n in (0, 1)]
    seconds = [record["steps"] * record["step_seconds"] for record in records]
    ratio = max(seconds) / min(seconds)
    assert list(row["training"].values()) == pytest.approx([1, 1 / ratio, ratio])
    assert list(row["training_seconds"].values()) == pytest.approx(
        [statistics.mean(seconds), min(seconds), max(seconds)]
    )


def test_only_what_is_missing_is_done_again(finished, flags, capfd, monkeypatch):
    folder = finished / "crisalad" / "seed-1"
    before, ranks = stamps(finished), result_of(folder)["ranks"]
    change(folder, ranks={})
    for name in ("fit", "race"):
        monkeypatch.delattr(runner, name)
    succeeds(capfd, *flags, "--out", finished)
    after = stamps(finished)
    changed = {str(path) for path in after if after[path] != before.get(path)}
    assert changed == {"crisalad/seed-1/result.json", "config.json", "results.json"}
    assert result_of(folder)["ranks"] == ranks


def test_interrupted_between_training_and_evaluation(finished, flags, capfd, tmp_path, monkeypatch):
    """Ctrl-C in the second run's evaluation: the first is left alone, the training not repeated."""
    out = tmp_path / "again"
    real, calls = runner.evaluate, []

    def interrupted(*args, **options):
        calls.append(options["seed"])
        if calls == [0, 1]:
            raise KeyboardInterrupt
        return real(*args, **options)

    monkeypatch.setattr(runner, "evaluate", interrupted)
    assert main([*map(str, flags), "--out", str(out)]) == 130
    capfd.readouterr()
    ranks = [result_of(path.parent)["ranks"] for path in sorted(out.rglob("result.json"))]
    assert [len(each) for each in ranks] == [1, 0]
    assert not (out / "results.json").exists()
    succeeds(capfd, *flags, "--out", out)
    assert calls == [0, 1, 1]
    assert row_of(out)["recalls"] == row_of(finished)["recalls"]


def test_a_run_that_was_cut_short_goes_on(finished, flags, capfd, tmp_path):
    """As a kill leaves it before the end of training is recorded: no step is taken again."""
    folder = finished / "crisalad" / "seed-0"
    weights = (folder / "run" / "last.safetensors").read_bytes()
    change(folder, training=None, ranks={})
    succeeds(capfd, *flags, "--out", finished)
    assert (folder / "run" / "last.safetensors").read_bytes() == weights
    assert result_of(folder)["training"]["steps"] == STEPS


@pytest.mark.parametrize("name", ["crisalad/seed-0/result.json", "speed.json"])
def test_a_damaged_file_of_results(finished, flags, capfd, name):
    path = finished / name
    path.write_text(path.read_text().replace('"device": "', '"device": "x'))
    words = (path, "found other bytes", "delete it, and the same command")
    fails(capfd, *flags, "--out", finished, words=words)


def test_another_comparison_is_refused(finished, flags, capfd):
    """Before its runs are trained on, as when they were interrupted."""
    folder = finished / "crisalad" / "seed-0"
    change(folder, training=None, ranks={})
    words = (folder, "other settings: training.epochs: was 3, is 4; give")
    fails(capfd, *flags, "--epochs", 4, "--out", finished, words=words)


def test_weights_that_change_behind_their_name_are_refused(
    shared, params, settings, tmp_path, monkeypatch
):
    """Their results would stand beside what is told of the others."""
    monkeypatch.delattr(runner, "fit")
    weights, out = tmp_path / "weights.safetensors", tmp_path / "out"
    _, model = load_weights(shared / "weights.safetensors")
    save_weights(weights, Model(params, model))
    config = ComparisonConfig(**settings | {"train": None, "weights": (f"crisalad={weights}",)})
    summary = run(config, out)
    assert run(config, out).rows == summary.rows
    save_weights(weights, Model(jax.tree.map(lambda x: x + 1, params), model))
    with pytest.raises(InputError, match=r"other settings: weights: was .*, is "):
        run(config, out)


def test_weights_are_not_trained(shared, params, benchmark, settings, tmp_path, monkeypatch):
    """One evaluation, whatever the seeds, of just these; in every grouping that is asked for."""
    monkeypatch.delattr(runner, "fit")
    weights = shared / "weights.safetensors"
    options = {"train": None, "weights": (f"crisalad={weights}",), "grouping": "single,sequential"}
    summary = run(ComparisonConfig(**settings | options), tmp_path / "out")
    single, sequential = summary.rows
    _, model = load_weights(weights)
    groupings = ("single", "sequential")
    expected = evaluate(Model(params, model), benchmark, groupings=groupings, reading=reading())
    for row, result in zip((single, sequential), expected, strict=True):
        assert row.grouping == result.grouping
        (recalls,) = row.recalls.values()
        for k in (1, 5, 10):
            assert (recalls[k].mean, recalls[k].spread) == (result.recalls[k], None)
        # Of one trial the interval is the binomial one, as `evaluate` has it.
        assert recalls[1].interval == result.intervals[1]
    assert (single.trained, single.training) == (None, None)


def test_models_of_any_family_are_lines_of_their_own(shared, benchmark, settings, tmp_path):
    """Two files that no recipe makes, and no training set: one takes images at their own size."""
    _, model = load_weights(shared / "weights.safetensors")
    small = ResNetConfig(layers=18, stages=1)
    native = PreprocessingConfig(size_rule="native")
    plain = {"aggregator": "gem", "cross_image": "none"}
    models = {
        "ours": dataclasses.replace(model, **plain),
        "netvlad": ModelConfig(model.image_size, native, small, **plain),
    }
    for name, config in models.items():
        made = init_crisalad(jax.random.key(1), config)
        save_weights(tmp_path / f"{name}.safetensors", Model(made, config))
    weights = tuple(f"{name}={tmp_path / name}.safetensors" for name in models)
    options = {"train": None, "weights": weights, "names": names_to_compare(None, weights)}
    summary = run(ComparisonConfig(**settings | options), tmp_path / "out")
    assert [row.labels for row in summary.rows] == [("ours",), ("netvlad",)]
    for row, config in zip(summary.rows, models.values(), strict=True):
        model = load_weights(tmp_path / f"{row.name}.safetensors")
        (expected,) = evaluate(model, benchmark, reading=reading())
        assert row.recalls["town"][1].mean == expected.recalls[1]
        assert row.dimension == config.descriptor_dim


def test_a_vocabulary_is_built_once_and_kept(shared, settings, tmp_path, monkeypatch):
    """Of a method that learns nothing: what the vocabulary gave is what is evaluated."""
    built = []

    def moved(params):
        aggregator = jax.tree.map(lambda x: x + 1, params.aggregator)
        return dataclasses.replace(params, aggregator=aggregator)

    def with_vocabulary(model, paths, *, images, seed, on_bad_image, quiet):
        built.append((len(paths), images, seed))
        return moved(model.params)

    monkeypatch.setattr(start, "with_vocabulary", with_vocabulary)
    monkeypatch.delattr(runner, "fit")
    config = ComparisonConfig(**settings | {"names": ("anyloc",)})
    out = tmp_path / "out"
    summary = run(config, out)
    assert built == [(24, 500, 0), (24, 500, 1)]
    assert summary.rows[0].trained == 0
    params, model = load_weights(out / "anyloc" / "seed-1" / "run" / "last.safetensors")
    key, _ = jax.random.split(jax.random.key(1))
    assert_equal(params, moved(init_crisalad(key, model)))
    (out / "anyloc" / "seed-0" / "result.json").unlink()
    again = run(config, out)
    assert len(built) == 2
    assert again.rows == summary.rows


def test_methods_of_one_recipe_share_its_runs(finished, settings, monkeypatch):
    """The second one re-ranks; how is another module's, which is given its words."""
    monkeypatch.setitem(METHODS, "ranked", ComparedMethod("Ranked", "crisalad", rerank="by-name"))
    anything = types.SimpleNamespace(check=lambda model, database: None)
    monkeypatch.setattr(plan, "parse_reranking", lambda text: anything)
    monkeypatch.setattr(runner, "parse_reranking", lambda text: f"parsed {text}")
    seen = []
    real = runner.evaluate

    def noted(*args, rerank=None, **options):
        seen.append((options["seed"], rerank))
        plain = real(*args, **options)
        return [*plain, *(one._replace(rerank=rerank) for one in plain)]

    monkeypatch.setattr(runner, "evaluate", noted)
    monkeypatch.delattr(runner, "fit")
    config = ComparisonConfig(**settings | {"names": ("crisalad", "ranked"), "rerank": 5})
    summary = run(config, finished)
    assert seen == [(0, "parsed by-name:5"), (1, "parsed by-name:5")]
    first, second = summary.rows
    for k, recall in second.recalls["town"].items():
        assert recall._replace(difference=None) == first.recalls["town"][k]
    assert (first.speed, second.speed, second.training) == (1, 1, first.training)
    assert second.recalls["town"][1].difference.interval == (0, 0)


def test_rows_draw_seeds_together_where_they_share_them(finished, settings, shared):
    """A row that hits the same queries as the reference in each run, and a model from a file."""
    weights = (f"ours={shared / 'weights.safetensors'}",)
    names = ("crisalad", "salad", "ours")
    prepared = comparison.prepare(
        ComparisonConfig(**settings | {"names": names, "weights": weights})
    )
    ranks = {0: [1] * 5, 1: [0] * 5}
    trained = result_of(finished / "crisalad" / "seed-0")["training"]
    runs = runs_of(prepared, finished)
    for each in runs:
        factor = 2 if each.variant.name == "salad" else 1
        result = each.read()
        result.training = trained | {"step_seconds": factor * trained["step_seconds"]}
        result.ranks = {each.evaluations[0].key: {"single": ranks[each.seed]}}
        result.write(each.folder)
    speed = read_json(finished / "speed.json", "times") | {"rounds": dict.fromkeys(names, (1.0,))}
    _, same, alone = comparison.summarise(prepared, runs, speed).rows
    assert same.recalls["town"][1].difference.interval == (0, 0)
    assert (same.training, alone.training) == ((2, 2, 2), None)  # over the reference's
    # All queries hit or miss with their seed: two seeds miss both in a quarter of the resamples.
    assert alone.recalls["town"][1].difference.interval == (0, 1)


def test_it_grows_by_a_set_and_a_seed_and_nothing_is_repeated(
    finished, flags, shared, capfd, tmp_path, monkeypatch
):
    """In any order of the sets; a reordered command does nothing."""
    village = tmp_path / "village"
    shutil.copytree(shared / "town", village)
    trained, evaluated = [], []
    fit, evaluate_ = runner.fit, runner.evaluate
    monkeypatch.setattr(
        runner, "fit", lambda config, *a, **o: trained.append(config.seed) or fit(config, *a, **o)
    )

    def noted(model, benchmark, **options):
        evaluated.append((benchmark.root.name, options["seed"]))
        return evaluate_(model, benchmark, **options)

    monkeypatch.setattr(runner, "evaluate", noted)
    before = stamps(finished)
    more = ("--test", village, shared / "town", "--seeds", 3)
    succeeds(capfd, *flags, *more, "--out", finished)
    assert trained == [2]
    assert evaluated == [("village", 0), ("village", 1), ("village", 2), ("town", 2)]
    after = stamps(finished)
    changed = {str(path) for path in before if after[path] != before[path]}
    results = {f"crisalad/seed-{seed}/result.json" for seed in (0, 1)}
    assert changed == {*results, "config.json", "results.json"}
    succeeds(capfd, *flags, "--test", shared / "town", village, "--seeds", 3, "--out", finished)
    assert (len(trained), len(evaluated)) == (1, 4)
    assert stamps(finished).keys() == after.keys()
    first, second = row_of(finished)["recalls"].values()
    assert first == second
    assert len(first["R@1"]["by_seed"]) == 3


def test_a_second_process_is_refused(finished, config):
    with locks.lock(finished):
        words = rf"^{finished}: found another process that writes here \(process {os.getpid()} on"
        with pytest.raises(InputError, match=words):
            run(config, finished)


def test_a_run_waits_for_a_worker_of_a_killed_command(finished, config, monkeypatch):
    """It writes the result, some moments before it ends."""
    folder, other = finished / "crisalad" / "seed-0", contextlib.ExitStack()
    result = folder / "result.json"
    result.rename(finished / "result.json")
    for name in ("fit", "evaluate"):
        monkeypatch.delattr(runner, name)

    def ended(seconds):
        (finished / "result.json").rename(result)
        other.close()

    other.enter_context(locks.lock(folder))
    waiting = types.SimpleNamespace(monotonic=time.monotonic, sleep=ended)
    monkeypatch.setattr(locks, "time", waiting)
    with pytest.warns(Note, match=rf"^{folder}: waiting for another process"):
        run(config, finished)


def test_the_run_of_a_killed_process_is_free(finished, config, monkeypatch):
    """Its lock's file is left, and the kernel has released the lock."""
    folder = finished / "crisalad" / "seed-0"
    (folder / temporaries.LOCK).write_text(f"process 1 on {socket.gethostname()}\n")
    change(folder, ranks={})
    monkeypatch.delattr(runner, "fit")
    run(config, finished)
    assert not (folder / temporaries.LOCK).exists()


def test_a_training_time_is_of_runs_with_a_device_of_their_own(finished, flags, capfd):
    folder = finished / "crisalad" / "seed-1"
    alone = result_of(folder)["training"]
    change(folder, training=alone | {"beside": True, "step_seconds": 1e6})
    # One run is left, whose time has no spread.
    told = succeeds(capfd, *flags, "--out", finished)
    assert "of runs that had their device to themselves, at least two" in told
    row = row_of(finished)
    assert (row["training"], row["training_seconds"]) == (None, None)
