"""Short help, completion, --json and --on-bad-image of every command."""

import csv
import dataclasses
import importlib
import json
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest

import crisalad_jax.cli
from crisalad_jax.cli.common import console
from crisalad_jax.cli.completion import completion_script
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.results import to_json
from crisalad_jax.nn.model import Model
from crisalad_jax.training.loop import fit
from tests.cli.test_cli import ROOT, fails, files_in, runs, spoil, succeeds, train
from tests.conftest import BATCH, MODEL, RECIPE, STEPS

COMMANDS = list(crisalad_jax.cli._COMMANDS)


def example_of(command):
    return shlex.split(crisalad_jax.cli._COMMANDS[command]["example"].partition(" >")[0])[1:]


def module_of(command):
    return importlib.import_module(f"crisalad_jax.cli.{command}")


# Platforms


@pytest.mark.parametrize("platforms", ["gpuu", pytest.param("rocm", marks=pytest.mark.slow)])
def test_platforms_that_jax_lacks_are_one_line(tmp_path, platforms, database, weights):
    """JAX raises a RuntimeError of the first, and an AssertionError without words of the second."""
    given = ("index", "--images", database, "--weights", weights, "--out", "m")
    done = subprocess.run(
        [sys.executable, "-m", "crisalad_jax", *map(str, given)],
        cwd=tmp_path,
        env=os.environ | {"JAX_PLATFORMS": platforms, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    start = f"crisalad: JAX_PLATFORMS: found '{platforms}', expected platforms that this JAX"
    assert done.stderr.startswith(start), done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "cpu" in done.stderr.rpartition("has: ")[2]  # which every jaxlib has
    assert files_in(tmp_path) == set()


# The cache


@pytest.mark.slow
def test_all_that_is_cached_is_in_one_folder(tmp_path, shared, weights):
    """A process of its own, as of a user: the tests' set-up keeps no programs."""
    environment = {k: v for k, v in os.environ.items() if k not in OWN_CACHES}
    home, cache = tmp_path / "home", tmp_path / "cache"
    environment |= {"HOME": str(home), "CRISALAD_CACHE": str(cache), "PYTHONPATH": str(ROOT)}
    images = shared / "town" / "images" / "test"
    given = ("--images", images, "--weights", weights, "--out", "d.npy")
    resizes = "from crisalad_jax.data import resize; resize._machine_code(True)"  # for many images
    for program in (["-m", "crisalad_jax", "extract", *map(str, given)], ["-c", resizes]):
        command = [sys.executable, *program]
        subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    assert {path.name for path in cache.iterdir()} == {"numba", "programs", "xla"}
    assert {path.relative_to(cache).parts[0] for path in files(cache)} >= {"numba", "programs"}
    assert files(home) == []


OWN_CACHES = ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR", "NUMBA_CACHE_DIR")


def files(folder):
    return [path for path in folder.rglob("*") if path.is_file()]


# Help


@pytest.mark.parametrize("columns", [10, 50])
def test_help_in_a_narrow_terminal_is_that_of_60_columns(capfd, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", "60")
    expected = {command: runs(capfd, command, "--help")[0] for command in COMMANDS}
    assert max(len(text) for text in expected.values()) > 600
    monkeypatch.setenv("COLUMNS", str(columns))
    assert {command: runs(capfd, command, "--help")[0] for command in COMMANDS} == expected


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_short_and_tells_of_an_example_that_parses(capfd, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "100")
    out, _ = runs(capfd, command, "--help")
    usage, *lines = out.splitlines()
    assert usage.startswith(f"usage: crisalad {command} ")
    entries = re.split(r"\n  (?=\S)", out.partition("\n\nexample: ")[0])[1:]
    assert 1 <= len(entries) <= 20
    assert all(len(entry.splitlines()) <= 2 for entry in entries)
    assert max(map(len, lines[:-3])) <= 100
    assert lines[-1] == f"all flags: crisalad {command} --help-all"
    module = module_of(command)
    verb, *given = example_of(command)
    assert verb == command
    assert crisalad_jax.cli._parse(command, module, given) is not None


def test_a_flag_that_is_not_common_stands_in_the_whole_help(capfd):
    assert "--max-heading-difference" not in succeeds(capfd, "evaluate", "--help")
    assert "--max-heading-difference" in succeeds(capfd, "evaluate", "--help-all")
    part = "--model.aggregator", "netvlad"
    assert "--model.aggregator.clusters" in succeeds(capfd, "train", *part, "--help-all")
    assert "--model.aggregator.sinkhorn" not in succeeds(capfd, "train", *part, "--help-all")


def test_a_text_is_cut_after_a_clause_and_keeps_its_default(capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    out = succeeds(capfd, "evaluate", "--help")
    assert "... (single,shuffled,sequential,window/single) --batch-size INT" in out
    assert "--[no-]checksums" in succeeds(capfd, "pca", "--help")


# Completion


@pytest.fixture(scope="module")
def bash(tmp_path_factory):
    """A function that completes the last of some words in a real bash."""
    script = tmp_path_factory.mktemp("completion") / "crisalad.bash"
    script.write_text(completion_script("bash"))
    program = f"""source {script}
        COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${{#COMP_LINE}}
        eval "$(complete -p crisalad | sed 's/.*-F \\([^ ]*\\).*/\\1/')" 2>/dev/null
        printf '%s\\n' "${{COMPREPLY[@]}}\""""

    def complete(*words: str) -> set[str]:
        command = ["bash", "-c", program, "bash", "crisalad", *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
        assert done.returncode == 0, done.stderr
        return set(done.stdout.split())

    return complete


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_commands_flags_and_choices(bash):
    assert bash("") == {*COMMANDS}
    assert bash("evaluate", "--ra") == {"--radius"}
    assert bash("evaluate", "--on-bad-image", "") == {"stop", "skip"}
    assert bash("train", "--data", "x", "--preset", "") == {"tiny", "s14", "b14", "l14", "g14"}
    assert {"salad", "selavpr"} <= bash("train", "--model.aggregator", "s")
    assert "--optimiser.learning-rate" in bash("train", "--optimiser.l")
    assert {"megaloc", "megaloc-v1"} == bash("models", "mega")


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_weights_by_models_and_files(bash, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "megabytes").mkdir()
    (tmp_path / "megabytes" / "best.safetensors").touch()
    expected = {"megaloc", "megaloc-v1", "megabytes"}
    for command, flag in (
        *(("compare", "--weights"), ("train", "--backbone"), ("evaluate", "--rerank-weights")),
    ):
        assert bash(command, flag, "mega") == expected, (command, flag)
    assert bash("index", "--weights", "start") == {"starter"}
    assert bash("index", "--weights", "megabytes/b") == {"megabytes/best.safetensors"}


@pytest.mark.parametrize(("shell", "first"), [("zsh", "#compdef crisalad"), ("fish", "")])
def test_other_shells_have_a_script_of_every_command(capfd, shell, first):
    out, _ = runs(capfd, "completion", shell)
    assert out.startswith(first)
    assert all(command in out for command in COMMANDS)
    assert "help-all" in out


# Tables


def test_no_number_and_no_path_breaks_on_a_narrow_terminal(capfd, tmp_path, shared, monkeypatch):
    """What a table has on a wide terminal, it has on a narrow one, in as many whole words."""
    monkeypatch.chdir(tmp_path)
    set_ = pathlib.Path("data", *["a_folder_with_a_long_name"] * 4, "town")
    shutil.copytree(shared / "town", set_)
    weights = set_.parent / "weights.safetensors"
    shutil.copy(shared / "weights.safetensors", weights)
    own = ("--weights", weights, "--quiet", "--batch-size", BATCH)
    database, queries = (set_ / "images" / "test" / side for side in ("database", "queries"))
    succeeds(capfd, "index", *own, "--images", database, "--out", set_.parent / "map")

    verbs = (
        ("query", queries, "--map", set_.parent / "map", "--quiet"),
        ("evaluate", "--data", set_, *own, "--seeds", 2, "--precision", 0.6),
        ("info", "--weights", weights),
        ("info", "--map", set_.parent / "map"),
        ("compare", "--test", set_, "--weights", f"own={weights}", "--out", "out", "--quiet"),
    )
    for verb in verbs:
        wide, _ = runs(capfd, *verb)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(console, "_width", 60)
            narrow, _ = runs(capfd, *verb)
        left = Counter(narrow.split())
        for word, count in Counter(wide.split()).items():
            if any(letter.isalnum() for letter in word):
                assert left[word] >= count, (verb[0], word)
        frames = [line for line in narrow.splitlines() if line.startswith(tuple("┏┃┡│├└"))]
        assert all(len(line) <= 60 for line in frames), verb[0]


# JSON


def test_json_is_never_written_under_the_name_of_another_format(capfd, tmp_path, monkeypatch):
    """By every command that has results, all but two."""
    monkeypatch.chdir(tmp_path)
    name = "x.csv"
    for command in set(COMMANDS) - {"completion", "serve"}:
        verb, *given = example_of(command)
        given = [each for each in given if each not in ("--json", "-")]
        words = (f"--json: found {name}, expected a name that ends in .json",)
        fails(capfd, verb, *given, "--json", name, words=words)
    gallery = ("query", "a", "--map", "m", "--gallery", name)
    ends = "a name that ends in .png or .svg or .pdf"
    fails(capfd, *gallery, words=(f"--gallery: found {name}, expected {ends}",))
    words = (f"--latex: found {name}, expected a name that ends in .tex",)
    fails(capfd, "models", "--latex", name, words=words)
    words = ("--latex: found - with --json -, expected only one of the two",)
    fails(capfd, "models", "--latex", "-", "--json", "-", words=words)
    pairs = ("pairs", "--images", "a", "--out", name)
    fails(capfd, *pairs, words=(f"--out: found {name}, expected a name that ends in .txt",))
    assert list(tmp_path.iterdir()) == []


def printed(capfd, *arguments):
    """The JSON on stdout, and the words on stderr."""
    out, err = runs(capfd, *arguments)
    return json.loads(out), err


def test_json_on_stdout_is_what_the_last_line_says(capfd, tmp_path, database, weights):
    common = ("--images", database, "--weights", weights, "--batch-size", BATCH, "--quiet")
    found, words = printed(capfd, "extract", *common, "--out", tmp_path / "d.npy", "--json", "-")
    assert (found["descriptors"], found["length"], found["skipped"]) == (7, 48, [])
    assert f"{tmp_path / 'd.npy'}: 7 descriptors of 48 dimensions" in words
    found, words = printed(capfd, "index", *common, "--out", tmp_path / "map", "--json", "-")
    assert (found["added"], found["positions"], found["images"], found["length"]) == (7, 7, 7, 48)
    assert "7 images added" in words
    pca = ("pca", "--descriptors", tmp_path / "d.npy", "--dim", 3, "--quiet")
    found, _ = printed(capfd, *pca, "--out", tmp_path / "p.safetensors", "--json", "-")
    assert (found["components"], found["of"], found["descriptors"]) == (3, 48, 7)
    assert 0 < found["variance"] < 1


def test_latex_on_stdout_is_the_table_alone(capfd):
    out, words = runs(capfd, "info", "--preset", "tiny", "--latex", "-")
    assert out.splitlines() == [
        "% tiny at 98 x 98",
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"part & parameters & multiply-accumulates an image \\",
        r"\midrule",
        r"backbone embedding, norm & 82,176 & 3,687,936 \\",
        r"backbone blocks & 794,112 & 41,881,600 \\",
        r"adapters & 84,736 & 4,192,512 \\",
        r"aggregator & 63,985 & 1,961,056 \\",
        r"cross-image encoder & 25,408 & 479,232 \\",
        r"\midrule",
        r"all & 1,050,417 & 52,202,336 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
    assert "descriptor" in words


def test_a_run_prints_json(capfd, tmp_path, shared, run):
    out = shutil.copytree(run, tmp_path / "run")
    given = train(shared, shared / "city", out, "--val", shared / "town", "--patience", "None")
    found, words = printed(capfd, *given, "--json", "-")
    assert f"{STEPS} steps, best R@5" in words
    assert (found["steps"], found["epochs"], found["stopped_early"]) == (STEPS, 3, False)
    best = json.loads((run / "config.json").read_text())["monitor"]
    assert found["best"]["name"] == best
    assert f"best R@5 {100 * found['best']['recall']:.1f}" in words


# Bad images


@pytest.fixture
def spoilt(town):
    """The town with an unreadable query and database image, and the same town without them."""
    whole = town.parent / "whole"
    shutil.copytree(town, whole)
    for side, number in (("queries", 1), ("database", 3)):
        name = sorted((town / "images" / "test" / side).iterdir())[number].name
        spoil(town / "images" / "test" / side / name)
        (whole / "images" / "test" / side / name).unlink()
    return town, whole


def test_an_evaluation_that_skips_is_that_of_the_readable_set(
    capfd, tmp_path, params, spoilt, weights
):
    town, whole = spoilt
    given = ("evaluate", "--data", town, "--weights", weights, "--quiet")
    given += ("--batch-size", BATCH, "--grouping", "single,window")
    found, words = printed(
        capfd, *given, "--on-bad-image", "skip", "--json", "-", "--report", tmp_path / "page"
    )
    model, reading = Model(params, MODEL), Reading(batch_size=BATCH, quiet=True)
    expected = evaluate(
        model, open_benchmark(whole), groupings=["single", "window"], reading=reading
    )
    for row, result in zip(found["results"], expected, strict=True):
        values = json.loads(json.dumps(to_json(result)))
        curves = row.pop("precision_recall"), values.pop("precision_recall")
        # Batches differ by the images left out: float32's rounding, as in test_evaluate.
        np.testing.assert_allclose(curves[0]["thresholds"], curves[1]["thresholds"], atol=2e-6)
        assert {name: row[name] for name in values} == values
    names = {side: [pathlib.Path(n).name for n in each] for side, each in found["skipped"].items()}
    assert [len(names["queries"]), len(names["database"])] == [1, 1]
    assert "left out: 1 queries and 1 database images" in " ".join(words.split())
    with (tmp_path / "page" / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * len(open_benchmark(whole).queries)
    assert not any(names["queries"][0] in row["query"] for row in rows)
    fails(capfd, *given, words=("found an image cut short",))
    for path in (town / "images" / "test" / "queries").iterdir():
        path.write_text("no image")
    words = ("queries: found 5 images, none of them readable",)
    fails(capfd, *given, "--on-bad-image", "skip", words=words)


def test_an_evaluation_that_skips_what_is_missing(capfd, tmp_path, spoilt, weights):
    """SALAD's lists name two images that are not there: as the set without them, of two folders."""
    town, whole = spoilt
    sides = ("database", "queries")
    images = {side: sorted((town / "images" / "test" / side).iterdir()) for side in sides}
    for side, kind in zip(sides, ("dbImages", "qImages"), strict=True):
        np.save(tmp_path / f"town_{kind}.npy", [str(p.relative_to(town)) for p in images[side]])
    truth = np.empty(len(images["queries"]), object)
    truth[:] = [np.array(each) for each in open_benchmark(town).ground_truth()]
    np.save(tmp_path / "town_gt.npy", truth, allow_pickle=True)
    given = ("evaluate", "--data", tmp_path, "--weights", weights, "--quiet")
    given += ("--batch-size", BATCH, "--images", whole)
    fails(capfd, *given, words=("found 1 of 7 images missing",))
    found, _ = printed(capfd, *given, "--on-bad-image", "skip", "--json", "-")
    assert [len(found["skipped"][side]) for side in ("queries", "database")] == [1, 1]
    same, _ = printed(capfd, *given[:2], whole, *given[3:-2], "--json", "-")
    assert found["results"][0]["recalls"] == same["results"][0]["recalls"]


def test_a_comparison_that_skips(capfd, tmp_path, shared, params, spoilt):
    town, whole = spoilt
    given = ("compare", "--test", town, "--weights", f"own={shared / 'weights.safetensors'}")
    given += ("--out", tmp_path / "out", "--quiet")
    fails(capfd, *given, words=("found an image cut short",))
    shutil.rmtree(tmp_path / "out")
    found, _ = printed(capfd, *given, "--on-bad-image", "skip", "--json", "-")
    model, quiet = Model(params, MODEL), Reading(quiet=True)
    (expected,) = evaluate(model, open_benchmark(whole), groupings=["single"], reading=quiet)
    (recalls,) = found["rows"][0]["recalls"].values()
    for k in (1, 5, 10):
        assert recalls[f"R@{k}"]["mean"] == expected.recalls[k]
    words = "unreadable and left out: 1 queries and 1 database images."
    assert any(note.endswith(words) for note in found["notes"])


def test_a_query_that_skips_answers_the_rest(capfd, spoilt, town_map):
    town, _ = spoilt
    asked = sorted((town / "images" / "test" / "queries").iterdir())
    common = ("--map", town_map, "--batch-size", BATCH, "--quiet", "--json", "-")
    given = ("query", *asked, *common)
    out, err = runs(capfd, *given, "--on-bad-image", "skip")
    lines = [json.loads(line) for line in out.splitlines()]
    assert [line["query"] for line in lines] == [p.name for p in asked if p != asked[1]]
    assert f"1 unreadable left out, {asked[1]} the first" in " ".join(err.split())
    fails(capfd, *given, words=("found an image cut short",))
    words = ("images: found 1 images, none of them readable",)
    fails(capfd, "query", asked[1], *common, "--on-bad-image", "skip", words=words)


def test_a_validation_that_skips(tmp_path, shared, params, spoilt):
    places = read_places(shared / "city", min_images=2)
    recipe = dataclasses.replace(RECIPE, patience=None)
    given = {"initial": params, "on_bad_image": "skip", "quiet": True}
    fit(recipe, places, tmp_path / "a", validation=open_benchmark(spoilt[0]), **given)
    fit(recipe, places, tmp_path / "b", validation=open_benchmark(spoilt[1]), **given)
    logs = [(tmp_path / name / "metrics.jsonl").read_text().splitlines() for name in "ab"]
    a, b = ([json.loads(x)["R@1"] for x in log if "R@1" in x] for log in logs)
    assert a == b
    assert len(a) == 3
