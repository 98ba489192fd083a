"""Comparisons that are carried out, interrupted, and gone on with."""

import contextlib
import dataclasses
import json
import shutil
import socket
import statistics
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
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import Model, init_crisalad
from crisalad_jax.utils import locks, temporaries
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from tests.cli.test_cli import fails, succeeds
from tests.conftest import BATCH, STEPS, assert_equal

pytestmark = pytest.mark.usefixtures("quick")


def run(config: ComparisonConfig, out) -> comparison.Summary:
    prepared = comparison.prepare(config)
    comparison.carry_out(prepared, out, say=lambda line: None, quiet=True)
    return comparison.summarise(prepared, out)


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


def stamps(out):
    """When each file of results and weights was written."""
    kept = (path for path in out.rglob("*") if path.suffix in (".json", ".safetensors"))
    return {
        path.relative_to(out): path.stat().st_mtime_ns for path in kept if "state" not in path.parts
    }


def test_recalls_are_those_of_the_weights_that_are_left(finished, benchmark):
    """Evaluated again, apart; the mean and the deviation by the statistics module."""
    results = json.loads((finished / "results.json").read_text())
    (row,) = results["rows"]
    by_seed, digests = [], set()
    for seed in (0, 1):
        run_folder = finished / "crisalad" / f"seed-{seed}" / "run"
        params, model = load_weights(run_folder / "last.safetensors")
        (result,) = evaluate(
            Model(params, model),
            benchmark,
            groupings=("single",),
            reading=Reading(batch_size=BATCH, quiet=True),
        )
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
    seconds = []
    for seed in (0, 1):
        record = read_json(finished / "crisalad" / f"seed-{seed}" / "training.json", "a record")
        seconds.append(record["steps"] * record["step_seconds"])
    ratio = max(seconds) / min(seconds)
    assert row["training"] == pytest.approx([1, 1 / ratio, ratio])
    assert row["training_seconds"] == pytest.approx(
        [statistics.mean(seconds), min(seconds), max(seconds)]
    )


def test_what_it_leaves(finished):
    written = {path.name for path in finished.iterdir() if path.is_file()}
    assert written == {
        *("config.json", "behind.json", "speed.json", "results.json", "table.md", "table.csv"),
        *("index.html", "recall_0.png", "recall_0_dark.png"),
    }
    page = (finished / "index.html").read_text()
    assert "CriSALAD" in page
    assert "://" not in page.replace("data:image", "")


def test_only_what_is_missing_is_done_again(finished, flags, capfd, monkeypatch):
    missing = finished / "crisalad" / "seed-1" / "test-0.json"
    content, before = missing.read_text(), stamps(finished)
    missing.unlink()

    def never(*args: object, **options: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(runner, "fit", never)
    monkeypatch.setattr(runner, "race", never)
    succeeds(capfd, *flags, "--out", finished)
    after = stamps(finished)
    changed = {str(path) for path in after if after[path] != before.get(path)}
    assert changed == {"crisalad/seed-1/test-0.json", "results.json"}
    differing = ('"seconds": ', '"checksum": ')  # of how long it took, and of the file's bytes
    assert _without(missing.read_text(), *differing) == _without(content, *differing)


def _without(text: str, *starts: str) -> list[str]:
    return [line for line in text.splitlines() if not line.strip().startswith(starts)]


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
    assert sorted(path.name for path in out.rglob("test-*.json")) == ["test-0.json"]
    assert not (out / "results.json").exists()
    succeeds(capfd, *flags, "--out", out)
    assert calls == [0, 1, 1]
    ours, theirs = (
        json.loads((folder / "results.json").read_text())["rows"][0] for folder in (out, finished)
    )
    assert ours["recalls"] == theirs["recalls"]
    assert ours["sittings"] == 1


def test_a_run_that_was_cut_short_goes_on(finished, flags, capfd, tmp_path):
    """As a kill leaves it before training.json: its steps are not taken again."""
    folder = finished / "crisalad" / "seed-0"
    weights = (folder / "run" / "last.safetensors").read_bytes()
    for name in ("training.json", "test-0.json"):
        (folder / name).unlink()
    out = succeeds(capfd, *flags, "--out", finished)
    assert "Resumed, so that its steps' times are of several calls: CriSALAD." in out
    assert (folder / "run" / "last.safetensors").read_bytes() == weights
    assert json.loads((folder / "training.json").read_text())["steps"] == STEPS


def test_a_file_of_results_that_is_cut_short(finished, flags, capfd):
    path = finished / "crisalad" / "seed-0" / "test-0.json"
    path.write_text(path.read_text()[:40])
    fails(capfd, *flags, "--out", finished, words=(path, "found no JSON", "delete it"))


@pytest.mark.parametrize(
    "name", ["crisalad/seed-0/test-0.json", "crisalad/seed-1/training.json", "speed.json"]
)
def test_a_file_of_results_that_was_changed(finished, flags, capfd, name):
    path = finished / name
    text = path.read_text()
    path.write_text(
        text.replace('"device": "', '"device": "x').replace('"queries": 5', '"queries": 6')
    )
    assert path.read_text() != text
    words = (path, "found other bytes than were written", "delete it, and the same command")
    fails(capfd, *flags, "--out", finished, words=words)


def test_a_result_of_another_set(finished, flags, capfd):
    path = finished / "crisalad" / "seed-0" / "test-0.json"
    write_json(path, read_json(path, "a result") | {"queries": 4})
    words = (path, "with 4 queries and 7 database images, expected", "with 5 and 7; delete it")
    fails(capfd, *flags, "--out", finished, words=words)


def test_another_comparison_is_refused(finished, flags, capfd):
    words = (finished, "holds another comparison: epochs: was 3, is 4; give the same to go on")
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
    with pytest.raises(InputError, match=r"out: .*weights\.safetensors: found changed since"):
        run(config, out)


def test_weights_are_not_trained(shared, params, benchmark, settings, tmp_path, monkeypatch):
    """One evaluation, whatever the seeds, of just these; in every grouping that is asked for."""
    monkeypatch.delattr(runner, "fit")
    weights = shared / "weights.safetensors"
    options = {"train": None, "weights": (f"crisalad={weights}",), "grouping": "single,sequential"}
    summary = run(ComparisonConfig(**settings | options), tmp_path / "out")
    single, sequential = summary.rows
    _, model = load_weights(weights)
    expected = evaluate(
        Model(params, model),
        benchmark,
        groupings=("single", "sequential"),
        reading=Reading(batch_size=BATCH, quiet=True),
    )
    for row, result in zip((single, sequential), expected, strict=True):
        assert row.grouping == result.grouping
        (recalls,) = row.recalls.values()
        assert {k: recall.mean for k, recall in recalls.items()} == {
            k: result.recalls[k] for k in (1, 5, 10)
        }
        assert {recall.spread for recall in recalls.values()} == {None}
        # Of one trial the interval is the binomial one, as `evaluate` has it.
        assert recalls[1].interval == result.intervals[1]
    assert (single.trained, single.training) == (None, None)


def test_models_of_any_family_are_lines_of_their_own(shared, benchmark, settings, tmp_path):
    """Two files that no recipe makes, and no training set: one takes images at their own size."""
    _, model = load_weights(shared / "weights.safetensors")
    small = ResNetConfig(layers=18, stages=1)
    native = PreprocessingConfig(size_rule="native")
    plain = {"aggregator": "gem", "cross_image": CrossImageConfig(layers=0)}
    models = {
        "ours": dataclasses.replace(model, **plain),
        "netvlad": ModelConfig(model.image_size, native, small, **plain),
    }
    weights = []
    for name, config in models.items():
        weights.append(f"{name}={tmp_path / name}.safetensors")
        made = init_crisalad(jax.random.key(1), config)
        save_weights(tmp_path / f"{name}.safetensors", Model(made, config))
    names = names_to_compare(None, weights)
    options = {"train": None, "weights": tuple(weights), "names": names}
    summary = run(ComparisonConfig(**settings | options), tmp_path / "out")
    assert [row.labels for row in summary.rows] == [("ours",), ("netvlad",)]
    for row in summary.rows:
        params, config = load_weights(tmp_path / f"{row.name}.safetensors")
        (expected,) = evaluate(
            Model(params, config), benchmark, reading=Reading(batch_size=BATCH, quiet=True)
        )
        (recalls,) = row.recalls.values()
        assert recalls[1].mean == expected.recalls[1]
        assert row.dimension == config.descriptor_dim
    assert "All models are from files." in summary.notes[0]


def test_a_vocabulary_is_built_once_and_kept(shared, settings, tmp_path, monkeypatch):
    """Of a method that learns nothing: what the vocabulary gave is what is evaluated."""
    built = []

    def with_vocabulary(params, config, paths, *, images, seed, on_bad_image, quiet):
        built.append((len(paths), images, seed))
        return dataclasses.replace(
            params, aggregator=jax.tree.map(lambda x: x + 1, params.aggregator)
        )

    monkeypatch.setattr(runner, "with_vocabulary", with_vocabulary)
    monkeypatch.delattr(runner, "fit")
    config = ComparisonConfig(**settings | {"names": ("anyloc",)})
    out = tmp_path / "out"
    summary = run(config, out)
    assert built == [(24, 500, 0), (24, 500, 1)]
    assert summary.rows[0].trained == 0
    params, model = load_weights(out / "anyloc" / "seed-1" / "start.safetensors")
    key, _ = jax.random.split(jax.random.key(1))
    fresh = init_crisalad(key, model)
    moved = jax.tree.map(lambda x: x + 1, fresh.aggregator)
    assert_equal(params, dataclasses.replace(fresh, aggregator=moved))
    (out / "anyloc" / "seed-0" / "test-0.json").unlink()
    again = run(config, out)
    assert len(built) == 2
    assert again.rows == summary.rows


def test_methods_of_one_recipe_share_its_runs(finished, settings, monkeypatch):
    """The second one re-ranks; how is another module's, which is given its words."""
    monkeypatch.setitem(METHODS, "ranked", ComparedMethod("Ranked", "crisalad", rerank="by-name"))
    anything = types.SimpleNamespace(check=lambda model: None)
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
    assert first.recalls == second.recalls
    assert (first.speed, second.speed, second.training) == (1, 1, first.training)
    assert second.differences["town"][1].interval == (0, 0)


def test_rows_draw_seeds_together_where_they_share_them(finished, settings, shared):
    """A row that hits the same queries as the reference in each run, and a model from a file."""
    weights = (f"ours={shared / 'weights.safetensors'}",)
    names = ("crisalad", "salad", "ours")
    prepared = comparison.prepare(
        ComparisonConfig(**settings | {"names": names, "weights": weights})
    )
    ranks = {0: [1] * 5, 1: [0] * 5}
    record = read_json(finished / "crisalad" / "seed-0" / "test-0.json", "a result")
    trained = read_json(finished / "crisalad" / "seed-0" / "training.json", "a record")
    for variant, seed in prepared.units:
        folder = runner.folder_of(finished, variant.name, seed)
        factor = 2 if variant.name == "salad" else 1
        took = {"step_seconds": factor * trained["step_seconds"]}
        write_json(folder / "training.json", trained | took)
        write_json(folder / "test-0.json", record | {"groupings": {"single": ranks[seed]}})
    speed = read_json(finished / "speed.json", "times")
    write_json(finished / "speed.json", speed | {"rounds": {name: [1.0] for name in names}})
    _, same, alone = comparison.summarise(prepared, finished).rows
    assert same.differences["town"][1].interval == (0, 0)
    assert (same.training, alone.training) == ((2, 2, 2), None)  # over the reference's
    # All queries hit or miss with their seed: two seeds miss both in a quarter of the resamples.
    assert alone.differences["town"][1].interval == (0, 1)
    notes = " ".join(comparison.summarise(prepared, finished).notes)
    assert "runs of one seed share initial values and batches; a model from a file shares" in notes


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
    assert changed == {"config.json", "behind.json", "results.json"}
    succeeds(capfd, *flags, "--out", finished)  # a part of it, as at the beginning
    succeeds(capfd, *flags, "--test", shared / "town", village, "--seeds", 3, "--out", finished)
    assert (len(trained), len(evaluated)) == (1, 4)
    assert stamps(finished).keys() == after.keys()
    (row,) = json.loads((finished / "results.json").read_text())["rows"]
    first, second = row["recalls"].values()
    assert first == second
    assert len(first["R@1"]["by_seed"]) == 3


def test_runs_are_shared_with_another_process(finished, config, monkeypatch):
    """It holds seed 0, and ends it while this one waits; seed 1 is done here, and only that."""
    prepared = comparison.prepare(config)
    for seed in (0, 1):
        (finished / "crisalad" / f"seed-{seed}" / "test-0.json").rename(finished / f"{seed}.json")
    one, lines = [], []

    def done(seed):
        (finished / f"{seed}.json").rename(finished / "crisalad" / f"seed-{seed}" / "test-0.json")

    monkeypatch.setattr(runner, "_one", lambda p, o, n, v, seed, *_: one.append(seed) or done(seed))
    with contextlib.ExitStack() as other:
        other.enter_context(locks.lock(finished / "crisalad" / "seed-0"))

        def ended(seconds):
            done(0)
            other.close()

        monkeypatch.setattr(runner.time, "sleep", ended)
        runner.take_runs(prepared, finished, say=lines.append)
    assert one == [1]
    assert lines == [
        "crisalad, seed 1: method 1 of 1, 0 of 2 runs done",
        "waiting for the runs of other processes",
    ]


def test_the_run_of_a_killed_process_is_free(finished, config, monkeypatch):
    """Its lock's file is left, and the kernel has released the lock."""
    lock = finished / "crisalad" / "seed-0" / temporaries.LOCK
    lock.write_text(f"process 1 on {socket.gethostname()}\n")
    (finished / "crisalad" / "seed-0" / "test-0.json").unlink()
    monkeypatch.delattr(runner, "fit")
    assert not runner._has_neighbours(finished)
    runner.take_runs(comparison.prepare(config), finished, say=print)
    assert not lock.exists()


def test_a_training_time_is_of_runs_with_a_device_of_their_own(finished, flags, capfd):
    """Of a process of this host; another host's is no neighbour."""
    with locks.lock(finished / "crisalad" / "seed-1"):
        lock = finished / "crisalad" / "seed-1" / temporaries.LOCK
        assert not runner._has_neighbours(finished)  # it is this process's own
        lock.write_text(f"process 1 on {socket.gethostname()}\n")
        assert runner._has_neighbours(finished)
        lock.write_text("process 1 on elsewhere\n")
        assert not runner._has_neighbours(finished)
    paths = [finished / "crisalad" / f"seed-{seed}" / "training.json" for seed in (0, 1)]
    second = read_json(paths[1], "a record")
    write_json(paths[1], second | {"beside": True, "step_seconds": 1e6})
    # One run is left, whose time has no spread.
    told = succeeds(capfd, *flags, "--out", finished)
    assert "median and range of the runs that had their device to themselves, where these" in told
    (row,) = json.loads((finished / "results.json").read_text())["rows"]
    assert (row["training"], row["training_seconds"]) == (None, None)
    assert (finished / "table.md").read_text().splitlines()[2].endswith("| - |")


def test_the_time_left_is_told_by_runs_of_the_same_method(tmp_path):
    """A slow method's seconds say nothing of a fast one; re-ranking shares its training."""

    def variant(name, run, *, trains=True):
        return types.SimpleNamespace(name=name, run=run, trains=trains)

    slow, again, fast = variant("slow", "slow"), variant("slow+r", "slow"), variant("fast", "fast")
    file = variant("file", "file", trains=False)
    units = [(v, seed) for v in (slow, again, fast) for seed in (0, 1, 2)] + [(file, 0)]
    prepared = types.SimpleNamespace(units=units)
    assert runner.time_left(prepared, tmp_path, [0]) == (0, 0)

    def trained(run, seed, seconds):
        path = runner.folder_of(tmp_path, run, seed) / "training.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"seconds_of_steps": seconds})

    def evaluated(which, seed, seconds):
        path = runner.result_path(tmp_path, which, seed, 0)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"seconds": seconds})

    trained("slow", 0, 1000.0)
    evaluated(slow, 0, 10.0)
    # Seeds 1 and 2 of slow; of the others none has finished.
    assert runner.time_left(prepared, tmp_path, [0]) == (2 * 1010, 2)
    evaluated(again, 0, 30.0)
    # Two evaluations each, and one training of each seed.
    assert runner.time_left(prepared, tmp_path, [0]) == (2 * (1000 + 10 + 30), 4)
    trained("slow", 1, 2000.0)
    # Seed 1 is to be evaluated only; seed 2 trains as long as the two did on average.
    assert runner.time_left(prepared, tmp_path, [0]) == (1500 + 2 * (10 + 30), 4)
    trained("fast", 0, 5.0)
    evaluated(fast, 0, 1.0)
    assert runner.time_left(prepared, tmp_path, [0]) == (1500 + 2 * (10 + 30) + 2 * 6, 6)
