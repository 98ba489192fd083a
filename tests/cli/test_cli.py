"""The command line: what it writes, and for every bad input one line on stderr and exit code 2."""

import dataclasses
import errno
import hashlib
import importlib
import json
import os
import pathlib
import re
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest
import safetensors.numpy
import torch

import crisalad_jax.cli
from crisalad_jax.checkpoints.formats import public_shapes
from crisalad_jax.checkpoints.public import read_checkpoint
from crisalad_jax.checkpoints.weights import load_weights, model_hash, save_weights
from crisalad_jax.cli import main
from crisalad_jax.config.io import read_config, to_plain
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.resize import resize_image
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.results import to_json
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import (
    BATCH,
    IMAGES_PER_PLACE,
    MODEL,
    RECIPE,
    STEPS,
    assert_equal,
    random_params,
    write_picture,
)
from tests.random_checkpoints import random_state, save

Capture = pytest.CaptureFixture[str]
ROOT = pathlib.Path(crisalad_jax.cli.__file__).parents[2]

# See test_evaluation: rounding of float32 sums.
TOLERANCE = 2e-6


def runs(capfd: Capture, *arguments: object) -> tuple[str, str]:
    """Run; what stands on stdout, and on stderr without the note that most new maps here get."""
    code = main([str(a) for a in arguments])
    out, err = capfd.readouterr()
    assert code == 0, err
    lines = err.splitlines(keepends=True)
    return out, "".join(
        line for line in lines if ": a map describes images independently" not in line
    )


def succeeds(capfd: Capture, *arguments: object) -> str:
    """Run; the words on stdout, with any space or line break as one space."""
    out, err = runs(capfd, *arguments)
    assert err == ""
    return " ".join(out.split())


def fails(capfd: Capture, *arguments: object, words: tuple[object, ...]) -> str:
    """Run; code 2 and a single line on stderr that holds the words, even from code below Python."""
    code = main([str(a) for a in arguments])
    error = capfd.readouterr().err
    assert code == 2
    assert error.startswith("crisalad: ")
    assert error.count("\n") == 1
    assert error.endswith("\n")
    for word in words:
        assert str(word) in error
    return error


def files_in(folder: pathlib.Path) -> set[str]:
    """All but TensorBoard's, whose names have a time in them."""
    files = (p for p in folder.rglob("*") if p.is_file() and p.parent.name != "tensorboard")
    return {p.relative_to(folder).as_posix() for p in files}


def train(shared: pathlib.Path, data: pathlib.Path, out: pathlib.Path, *more: object) -> tuple:
    """A run of RECIPE. Weights are given: to draw them takes longer than the run."""
    return (
        *("train", "--data", data, "--out", out, "--config", shared / "recipe.json"),
        *("--weights", shared / "weights.safetensors", "--quiet", *more),
    )


def spoil(path: pathlib.Path) -> None:
    """Cut a picture short."""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


LONG = "/".join(["folder"] * 20)
"""A path that no terminal has in a line."""
POSITIONAL = {
    ("completion", "shell"): "{bash,zsh,fish}",
    ("convert", "source"): "SRC",
    ("data", "action"): "{list,fetch,check}",
    ("data", "what"): "NAME|DIR",
    ("map", "action"): "{list,remove,replace,move,merge}",
    ("map", "map"): "MAP",
    ("map", "what"): "NAME|PATTERN|MAP...",
    ("publish", "run"): "RUN",
    ("convert", "target"): "DST",
    ("models", "name"): "NAME",
    ("query", "images"): "IMAGE",
}
# Arguments


def test_help_lists_every_command_and_flag(capfd):
    out = succeeds(capfd, "--help")
    assert succeeds(capfd, "help") == out
    for command, about in crisalad_jax.cli._COMMANDS.items():
        assert f"{command} {about['summary']}" in out
        help_text = succeeds(capfd, command, "--help-all")
        module = importlib.import_module(f"crisalad_jax.cli.{command}")
        for field in dataclasses.fields(getattr(module, command.capitalize())):
            if (command, field.name) in POSITIONAL:
                assert POSITIONAL[command, field.name] in help_text
            elif field.name != "settings":
                assert f"--{field.name.replace('_', '-')}" in help_text
    for flag in ("--model.backbone.adapter", "--optimiser.learning-rate"):
        assert flag in succeeds(capfd, "train", "--help-all")


def test_no_command_prints_the_usage(capfd):
    assert main([]) == 2
    assert capfd.readouterr().err.startswith("usage: crisalad COMMAND")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("tran --data d --out o", r"found no command 'tran'; did you mean train\? \(see"),
        ("help querry", r"found no command 'querry'; did you mean query\? \("),
        ("xyz", "found no command 'xyz'; expected demo, render, train, .*, completion"),
        ("info --preset b16", "preset: found 'b16', expected one of b14, g14, l14, s14, tiny"),
        ("train --data d --out o --recipe dbow", "recipe: found 'dbow', expected one of adapt"),
        ("train --data d --out o --recipe salad --config c", "--recipe: found with --config"),
        ("train --data d --out o --epoch 3", "--epochs"),  # perhaps you meant
        ("info --plugin --quiet", "--plugin: found no value, expected FILE.py or MODULE"),
        ("info --max-pixels 0", "--max-pixels: found '0', expected a number of pixels"),
        (
            "query a --map m --k 9999999999999",
            r"--k: found 9+, expected a number of at most 2\*\*40",
        ),
        ("extract", "missing --images PATH --out PATH"),
        ("train --data d --out o --seed one", "--seed: found 'one', expected a whole number"),
        ("query a --map m --fps slow", "--fps: found 'slow', expected a number"),
        (f"query a --map m --k {LONG}", f"--k: found '{LONG}', expected a whole number"),
        ("train --data d --out o --preset", "--preset: found none, expected a value"),
        ("evaluate --data d --image-size 1 x", "--image-size: found '1 x', expected 2 whole numb"),
        ("train --data d --out o --model.image-size 9 9 9", "found '9 9 9', expected 2 values"),
        ("query a --map m --runtime tvm", "--runtime: found 'tvm', expected one of auto, jax, onn"),
        ("index --images a b --out m", r"--images: found 'a b', expected one value \(quote"),
        ("extract --images a --out m --quiet no", "--quiet: found 'no', expected no value"),
        ("index --image a --out m", "--image: found no such flag; missing --images PATH"),
        ("query a --map m --kk 3", r"--kk: found no such flag; did you mean --k INT\?"),
        ("evaluate d", "found 'd' without a flag before it; missing --data PATH"),
        ("train --data d --out o --seed -1", "TrainConfig.seed: found -1"),
        ("train --data d --out o --model.image-size 100 98", "found 100 x 98, .*nearest: 98 x 98"),
        ("train --data d --out o --model.backbone.ffn relu", "relu.*mlp.*swiglu"),
        ("evaluate --data d --grouping single,sorted", "grouping: found 'sorted', expected one of"),
        ("evaluate --data d --grouping a/b/c", "grouping: found 'a/b/c', .*QUERIES/DATABASE"),
        ("evaluate --data d --seeds 0", "seeds: found 0, expected at least 1"),
        ("evaluate --data d --batch-size 0", "batch.size: found 0"),
        ("evaluate --data d --seed -1", "seed: found -1"),
        ("extract --weights w --images d --out f.txt", r"f\.txt: suffix.*\.h5, \.npy"),
        ("info --checksums", "--checksums: found without --map"),
        ("info --image-size 112 98", "56 patches for 64 clusters"),
        (
            "info --trainable last-13-blocks,head",
            "found last-13-blocks, expected 1 to the b",
        ),
        ("demo --seed -1 --out o", "seed: found -1"),
    ],
)
def test_bad_arguments(capfd, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    error = fails(capfd, *arguments.split(), words=())
    assert re.search(words, error), error
    assert os.environ["COLUMNS"] == "80"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"), [("{", "found no JSON"), ('{"epochs": 3, "colour": "red"}', "colour")]
)
def test_a_bad_config_file(capfd, tmp_path, content, words):
    path = tmp_path / "mine.json"
    path.write_text(content)
    given = ("train", "--data", "d", "--out", tmp_path / "run", "--config", path)
    fails(capfd, *given, words=(f"crisalad: {path}: ", words))
    assert not (tmp_path / "run").exists()


def test_an_interrupt_is_no_traceback(capfd, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("crisalad_jax.cli.info.model_summary", interrupt)
    assert main(["info"]) == 130
    assert capfd.readouterr().err == "crisalad: interrupted\n"


def test_the_console_script_and_the_module_are_the_same_thing(tmp_path):
    """One process for real: nothing else may write to stderr, and the code must come through."""
    write_picture(tmp_path / "photos" / "a.jpg", 0)
    spoil(tmp_path / "photos" / "a.jpg")
    save_weights(tmp_path / "w.safetensors", Model(random_params(MODEL), MODEL))
    command = [sys.executable, "-m", "crisalad_jax", "extract", "--quiet"]
    command += ["--weights", "w.safetensors", "--images", "photos", "--out", "d.npy"]
    environment = {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("crisalad: photos/a.jpg: found an image cut short")
    assert done.stderr.count("\n") == 1
    assert files_in(tmp_path) == {"photos/a.jpg", "w.safetensors"}


@pytest.mark.parametrize(
    "more", [("--help",), pytest.param(("--preset", "tiny"), marks=pytest.mark.slow)]
)
def test_a_reader_that_goes_away_is_no_error(more):
    """As `crisalad info --help | head -1`: the work goes on, and its files are written."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "crisalad_jax", "info", *more]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux alone")
@pytest.mark.parametrize(
    "more", [("--help",), pytest.param(("--json", "-"), marks=pytest.mark.slow)]
)
def test_a_full_disk_at_standard_output_is_one_line(more):
    """Of output met by the last flush, by a print on the way, and by JSON."""
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "crisalad_jax", "models", *more]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "crisalad: standard output: No space left on device"
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux alone")
def test_a_full_disk_at_standard_error_loses_what_is_said_there_alone():
    said = (
        "import sys; from crisalad_jax.__main__ import keep_on_without_reader as keep; keep();"
        "print('progress', file=sys.stderr); print('result')"
    )
    for program, code, out in (
        (["-c", said], 0, b"result\n"),
        (["-m", "crisalad_jax", "models", "--none"], 2, b""),
    ):
        with open("/dev/full", "w") as full:
            command = [sys.executable, *program]
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=full)
        assert (done.returncode, done.stdout) == (code, out)


@pytest.mark.parametrize("pixels", ["abc", "-1", "", "9" * 5000])
def test_a_limit_of_pixels_that_is_none_is_one_line(capfd, monkeypatch, shared, pixels):
    """OpenCV aborts the process at such a value."""
    monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", pixels)
    words = f"OPENCV_IO_MAX_IMAGE_PIXELS: found {pixels!r}, expected a number of pixels"
    fails(capfd, "extract", "--images", shared / "town", "--out", "d.npy", words=(words,))


def test_a_closed_standard_output_is_no_error():
    command = [sys.executable, "-m", "crisalad_jax", "info", "--help"]
    shell = ["sh", "-c", 'exec "$@" >&-', "sh", *command]
    done = subprocess.run(shell, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (0, "")


# train


def test_a_run_from_the_command_line_and_the_same_command_again(
    capfd, tmp_path, shared, benchmark, run
):
    arguments = train(
        shared, shared / "city", tmp_path / "run", "--val", shared / "town", "--patience", "None"
    )
    out = succeeds(capfd, *arguments)
    assert "8 places, 24 images; validation on town/test (@UTM, 25 m)" in out
    assert f"{STEPS} steps, best R@5" in out
    assert (tmp_path / "run" / "curves.png").stat().st_size > 0
    recorded = json.loads((tmp_path / "run" / "data.json").read_text())  # for a model card
    assert recorded["training"] == {"name": "city", "places": 8, "images": 24}
    assert recorded["validation"] == {"name": benchmark.name, "database": 7, "queries": 5}
    found, expected = (
        load_weights(folder / "last.safetensors") for folder in (tmp_path / "run", run)
    )
    assert found.config == MODEL
    assert_equal(found.params, expected.params)
    resolved = tmp_path / "run" / "config.json"
    assert read_config(TrainConfig, resolved) == dataclasses.replace(RECIPE, patience=None)

    log = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    out = succeeds(capfd, *arguments)
    assert f"{STEPS} steps, best R@5" in out
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == log


def few_images(city: pathlib.Path) -> pathlib.Path:
    for table in (city / "Dataframes").iterdir():
        header, *rows = table.read_text().splitlines()
        table.write_text("\n".join([header, *rows[::IMAGES_PER_PLACE]]))
    return city


def few_places(city: pathlib.Path) -> pathlib.Path:
    (city / "Dataframes" / "Brill.csv").unlink()
    table = city / "Dataframes" / "Aston.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:7]))
    return city


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (few_images, "found no place with at least 2 images; the largest has 1"),
        (few_places, "found 2 places of which sampler within-city makes no batch, expected"),
    ],
)
def test_bad_places(capfd, tmp_path, shared, city, damage, words):
    culprit = damage(city)
    fails(capfd, *train(shared, city, tmp_path / "run"), words=(f"crisalad: {culprit}: ", words))
    assert not (tmp_path / "run").exists()


def test_missing_and_empty_folders(capfd, tmp_path, shared):
    (tmp_path / "empty").mkdir()
    out, weights = tmp_path / "out", shared / "weights.safetensors"
    for data in (tmp_path / "none", tmp_path / "empty"):
        fails(capfd, *train(shared, data, out), words=(f"crisalad: {data}: ",))
        fails(capfd, *train(shared, shared / "city", out, "--val", data), words=(f"{data}: ",))
        fails(capfd, "evaluate", "--weights", weights, "--data", data, words=(f"{data}: found ",))
        fails(capfd, *extract(shared, data, tmp_path / "d.npy"), words=(f"{data}: found ",))
    assert files_in(tmp_path) == set()
    assert not out.exists()


def test_a_bad_training_image_stops_the_run_until_it_is_repaired(capfd, tmp_path, shared, city):
    """Half of the places are spoilt, and every batch holds three of four: one is met."""
    whole = {}
    for path in sorted((city / "Images").rglob("*_000000[01]_*.jpg")):
        whole[path] = path.read_bytes()
        spoil(path)
    arguments = train(shared, city, tmp_path / "run")
    error = fails(capfd, *arguments, words=(f"crisalad: {city}/Images/",))
    assert pathlib.Path(error.split(": ")[1]) in whole
    # A run that has not begun; no half of any file.
    assert files_in(tmp_path / "run") == {"config.json", "metrics.jsonl"}
    for path, data in whole.items():
        path.write_bytes(data)
    assert f"{STEPS} steps" in succeeds(capfd, *arguments)


def test_a_loss_that_is_not_finite_names_the_step_and_saves_the_state(
    capfd, tmp_path, shared, params
):
    """Finite weights so large that the first loss overflows."""
    huge = jax.tree.map(lambda leaf: leaf * 1e30, params)
    save_weights(tmp_path / "huge.safetensors", Model(huge, MODEL))
    arguments = list(train(shared, shared / "city", tmp_path / "run"))
    arguments[arguments.index("--weights") + 1] = tmp_path / "huge.safetensors"
    words = ("nan", "at step 1, expected finite", "the state after step 0 is saved")
    fails(capfd, *arguments, words=words)
    assert_equal(load_weights(tmp_path / "run" / "last.safetensors").params, huge)
    assert (tmp_path / "run" / "metrics.jsonl").read_text() == ""


# Weights


def test_extract_computes_in_the_type_that_is_asked_for(capfd, tmp_path, shared):
    town = shared / "town"
    succeeds(capfd, *extract(shared, town, tmp_path / "d.npy"))
    succeeds(capfd, *extract(shared, town, tmp_path / "n.npy", "--compute-dtype", "bfloat16"))
    config = json.loads((tmp_path / "n.npy.json").read_text())
    assert config["model"]["compute_dtype"] == "bfloat16"
    wide, narrow = (np.load(tmp_path / name) for name in ("d.npy", "n.npy"))
    assert np.abs(narrow - wide).max() > 1e-4  # float32 would be off by 1e-6
    # bfloat16 keeps 8 bits: a step is off by up to 2^-9, some 20 of them by 1 % or so, and the
    # cosine by half the square of that, with room for an unlucky image.
    assert (narrow * wide).sum(axis=-1).min() > 0.999


@pytest.mark.parametrize("kind", ["missing", "cut", "foreign"])
def test_bad_weights_are_named_by_every_command(capfd, tmp_path, shared, kind):
    weights = tmp_path / "w.safetensors"
    whole = shared / "weights.safetensors"
    if kind == "cut":
        weights.write_bytes(whole.read_bytes()[:-100])
    elif kind == "foreign":
        arrays = safetensors.numpy.load_file(whole)
        safetensors.numpy.save_file(arrays, weights, metadata={"format": "pt"})
    before = files_in(tmp_path)
    town = shared / "town"
    for arguments in (
        ("train", "--data", shared / "city", "--out", tmp_path / "r"),
        ("evaluate", "--data", town, "--json", tmp_path / "table.json"),
        ("extract", "--images", town, "--out", tmp_path / "d.npy"),
        ("info",),
    ):
        fails(capfd, *arguments, "--weights", weights, words=(f"crisalad: {weights}: ",))
    assert files_in(tmp_path) == before


# convert, and a backbone to start from


BACKBONE = ModelConfig(
    aggregator="class-token",
    backbone=ViTConfig(dim=64, depth=2, heads=1, position_grid=3, adapter="none"),
    cross_image="none",
)


@pytest.fixture
def public(tmp_path) -> pathlib.Path:
    """A DINOv2 checkpoint of two blocks of width 64."""
    return save(tmp_path / "dinov2.pth", random_state(public_shapes(BACKBONE, "dinov2")))


def test_convert_says_what_it_found(capfd, tmp_path, public):
    ours, back = tmp_path / "w.safetensors", tmp_path / "back.pth"
    out = succeeds(capfd, "convert", public, ours)
    assert f"{public} (DINOv2 .pth) -> {ours} (crisalad-jax): backbone of width 64, 2 blocks" in out
    assert "descriptor of 64 dimensions" in out
    assert load_weights(ours)[1] == BACKBONE
    out = succeeds(capfd, "convert", ours, back)
    assert f"(crisalad-jax) -> {back} (DINOv2 .pth)" in out
    assert back.read_bytes() == public.read_bytes()
    succeeds(capfd, "convert", ours, back, "--format", "reference")
    assert torch.load(back).keys() == {"state_dict"}


def test_convert_refuses_in_one_line(capfd, tmp_path, public):
    for arguments, words in (
        ((public, tmp_path / "x.pth"), ("x.pth: found the suffix '.pth', expected .safetensors",)),
        ((tmp_path / "none", tmp_path / "x.safetensors"), ("none: found no such file",)),
        (
            (public, tmp_path / "x.safetensors", "--format", "timm"),
            ("found a public checkpoint (dinov2) and format",),
        ),
        ((public,), ("DST",)),
    ):
        fails(capfd, "convert", *arguments, words=words)
    assert files_in(tmp_path) == {"dinov2.pth"}


@pytest.mark.slow
def test_a_run_starts_from_a_public_backbone(capfd, tmp_path, shared, public, weights):
    model = dataclasses.replace(
        RECIPE.model, backbone=dataclasses.replace(BACKBONE.backbone, adapter="depthwise")
    )
    recipe = dataclasses.replace(RECIPE, model=model, trainable="adapters,head", epochs=1)
    write_json(tmp_path / "recipe.json", to_plain(recipe))
    arguments = (
        *("train", "--config", tmp_path / "recipe.json", "--backbone", public),
        *("--data", shared / "city", "--out", tmp_path / "run", "--quiet"),
    )
    words = ("--backbone: found together with --weights",)
    fails(capfd, *arguments, "--weights", weights, words=words)
    differs = f"{public}: this backbone differs from the model's"
    words = (differs, "backbone.depth: found 2, expected 3")
    fails(capfd, *arguments, "--model.backbone.depth", 3, words=words)
    assert not (tmp_path / "run").exists()
    succeeds(capfd, *arguments)
    trained, _ = load_weights(tmp_path / "run" / "last.safetensors")
    found = named_leaves(trained.backbone)
    # The frozen part is the file's to the bit; the adapters have moved from their start at 0.
    for name, leaf in named_leaves(read_checkpoint(public).params.backbone).items():
        np.testing.assert_array_equal(found[name], leaf)
    assert np.abs(found["blocks.adapter.up.weight"]).max() > 0


# evaluate


def test_evaluate_prints_and_writes_the_table(capfd, tmp_path, shared, params, benchmark, weights):
    out = succeeds(
        capfd,
        *("evaluate", "--weights", weights, "--data", shared / "town"),
        *("--batch-size", BATCH, "--seed", "3", "--json", tmp_path / "table.json", "--quiet"),
        *("--seeds", "2", "--out", tmp_path / "pictures", "--latex", tmp_path / "t.tex"),
    )
    assert "town/test (@UTM, 25 m): 5 queries, 7 database images; positive: UTM distance" in out
    # The customer is told that a descriptor depends on its batch.
    words = f"depends on the images in its batch of {BATCH}: single = each image independently"
    assert words in out
    table = json.loads((tmp_path / "table.json").read_text())
    reading = Reading(batch_size=BATCH, quiet=True)
    expected = evaluate(Model(params, MODEL), benchmark, seed=3, seeds=2, reading=reading)
    groupings = ["single", "shuffled", "sequential", "window/single"]
    assert [row["grouping"] for row in table["results"]] == groupings
    for row, result in zip(table["results"], expected, strict=True):
        assert row == {
            "benchmark": benchmark.name,
            "model": f"{shared.name}/weights.safetensors",
            **json.loads(json.dumps(to_json(result))),
        }
        assert f"{100 * result.recalls[1]:.1f}" in out
    tex = (tmp_path / "t.tex").read_text().splitlines()
    assert r"\shortstack[r]{R@1 \\ 95 \%}" in tex[2]
    single, low, high = expected[0].recalls[1], *expected[0].intervals[1]
    wanted = f"{100 * single:.1f} {{\\footnotesize {100 * low:.1f}--{100 * high:.1f}}}"
    assert tex[4].split(" & ")[2] == wanted
    assert table["model"] == to_plain(MODEL)
    assert files_in(tmp_path / "pictures") == {
        "config.json",
        *(f"gallery_{name.replace('/', '-')}.png" for name in groupings),
    }
    written = json.loads((tmp_path / "pictures" / "config.json").read_text())
    assert len(written.pop("checksum")) == 64
    assert table.items() >= written.items()


def test_a_bad_image_stops_an_evaluation(capfd, tmp_path, town, weights):
    bad = sorted((town / "images" / "test" / "database").iterdir())[5]
    spoil(bad)
    fails(
        capfd,
        *("evaluate", "--weights", weights, "--data", town, "--quiet"),
        *("--batch-size", BATCH, "--json", tmp_path / "out" / "t.json", "--out", tmp_path / "out"),
        words=(f"crisalad: {bad}: found ",),
    )
    assert not (tmp_path / "out").exists()


def test_bad_evaluation_sets(capfd, tmp_path, town, weights):
    start = ("evaluate", "--weights", weights, "--data", town)
    fails(capfd, *start, "--split", "val", words=(f"crisalad: {town}: ", "splits test"))
    fails(capfd, *start, "--radius", "-1", words=("radius: found -1",))
    fails(capfd, *start, "--image-size", "28", "28", words=("4 patches for 4 clusters",))
    fails(capfd, *start, "--image-size", "50", "56", words=("found 50 x 56", "nearest: 56 x 56"))
    query = sorted((town / "images" / "test" / "queries").iterdir())[0]
    query.rename(query.with_name("street.jpg"))
    fails(capfd, *start, words=(f"{query.with_name('street.jpg')}: found no coordinates",))
    query.with_name("street.jpg").unlink()
    for path in (town / "images" / "test" / "queries").iterdir():
        path.unlink()
    fails(capfd, *start, words=(f"crisalad: {town}/images/test/queries: found no image",))


# extract


def extract(shared: pathlib.Path, images: pathlib.Path, out: pathlib.Path, *more: object) -> tuple:
    return (
        *("extract", "--weights", shared / "weights.safetensors", "--images", images),
        *("--out", out, "--batch-size", BATCH, "--quiet", *more),
    )


@pytest.mark.parametrize("name", ["d.npy", "d.names.txt", "d.npy.json"])
def test_extract_knows_at_once_that_one_of_its_files_cannot_be(capfd, tmp_path, shared, name):
    (tmp_path / name).mkdir()
    start = extract(shared, shared / "town", tmp_path / "d.npy")
    fails(capfd, *start, words=(f"{tmp_path / name}: found a folder",))
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_the_disk_refuses_is_one_line(capfd, tmp_path, shared, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "d.npy")

    monkeypatch.setattr("crisalad_jax.retrieval.descriptor_files.npy_header", full)
    out = tmp_path / "d.npy"
    start = extract(shared, shared / "town", out)
    words = (f"{out}.partial: cannot be written: No space left", f"is stored in {out}.partial")
    fails(capfd, *start, words=words)
    assert {path.split("/")[0] for path in files_in(tmp_path)} == {"d.npy.partial"}
    monkeypatch.undo()
    succeeds(capfd, *start)
    assert files_in(tmp_path) == {"d.npy", "d.names.txt", "d.npy.json"}


def test_extract_writes_descriptors_names_and_configuration(
    capfd, tmp_path, shared, params, weights
):
    town = shared / "town"
    out = succeeds(capfd, *extract(shared, town, tmp_path / "new" / "d.npy"))
    assert "12 descriptors of 48 dimensions, grouping single (each image independently)" in out
    assert files_in(tmp_path / "new") == {"d.npy", "d.names.txt", "d.npy.json"}
    names = (tmp_path / "new" / "d.names.txt").read_text().splitlines()
    assert names == sorted(path.relative_to(town).as_posix() for path in town.rglob("*.jpg"))
    images = (resize_image(read_image(town / name), MODEL.image_size) for name in names)
    expected = np.concatenate([describe(params, image[None], MODEL) for image in images])
    np.testing.assert_allclose(
        np.load(tmp_path / "new" / "d.npy"), expected, atol=TOLERANCE, rtol=0
    )
    config = json.loads((tmp_path / "new" / "d.npy.json").read_text())
    files = {"descriptors": tmp_path / "new" / "d.npy", "names": tmp_path / "new" / "d.names.txt"}
    assert config.pop("files") == {
        name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()
    }
    assert len(config.pop("checksum")) == 64
    assert config == {
        "weights": str(weights),
        "images": str(town),
        "grouping": "single",
        "batch_size": BATCH,
        "seed": 0,
        "fps": None,
        "every_metres": None,
        "topic": None,
        "pca": None,
        "skipped": [],
        "model": to_plain(MODEL),
        "model_sha256": model_hash(params, MODEL),
        "pca_sha256": None,
    }


def test_extract_stops_at_a_bad_image_and_leaves_nothing(capfd, tmp_path, shared, town):
    bad = list_images(town)[6]
    spoil(bad)
    for name in ("d.npy", "d.h5"):
        given = extract(shared, town, tmp_path / "out" / name)
        fails(capfd, *given, words=(f"crisalad: {bad}: found",))
    assert not (tmp_path / "out").exists()


def test_extract_skips_bad_images_and_says_so(capfd, tmp_path, shared, town):
    paths = list_images(town)
    for index in (0, 6, 11):
        spoil(paths[index])
    out = succeeds(capfd, *extract(shared, town, tmp_path / "d.npy", "--on-bad-image", "skip"))
    assert "9 descriptors" in out
    assert "3 unreadable images left out" in out
    skipped = json.loads((tmp_path / "d.npy.json").read_text())["skipped"]
    assert [town / name for name in skipped] == [paths[0], paths[6], paths[11]]


# info


def test_info_gives_the_papers_numbers(capfd, tmp_path):
    """Table 3: 741,504 parameters and 39.223 M multiply-accumulates an adapter."""
    out = succeeds(capfd, "info", "--preset", "b14", "--json", tmp_path / "info.json")
    for number in ("741,504", "39,223,296", "8,448"):
        assert number in out
    summary = json.loads((tmp_path / "info.json").read_text())
    # The two linears at all 257 tokens; the convolutions as the paper counts them.
    assert summary["one_adapter"]["macs"] == 257 * 589_824 + 256 * 150_912
    # DINOv2 ViT-B/14: 86.58 M parameters, of which its mask token (768) is not part of our model.
    assert summary["frozen_parameters"] == 86_580_480 - 768


def test_the_version_is_that_of_the_package(capfd):
    assert runs(capfd, "--version") == (f"crisalad-jax {crisalad_jax.__version__}\n", "")


def test_a_line_comes_as_it_is_written_without_buffers():
    """PYTHONUNBUFFERED makes Python's own streams write through, and no line buffers."""
    code = (
        "from crisalad_jax.__main__ import keep_on_without_reader as keep\n"
        "keep(); print('a note'); input()"
    )
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", code],
        **{"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment},
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        ends = threading.Timer(60, process.stdin.close)  # else a buffered line never comes
        ends.start()
        assert process.stdout.readline() == "a note\n"
        assert process.poll() is None
        assert not ends.finished.is_set()
        ends.cancel()
        process.stdin.close()
