"""Odd names of files and folders, and outputs that would overwrite each other."""

import importlib
import os
import shlex
import shutil

import pytest

import crisalad_jax.cli
from tests.cli.test_cli import extract, fails, files_in, succeeds


def test_brackets_and_colons_in_names_are_printed_as_they_are(capfd, tmp_path, shared):
    out = tmp_path / "fo[red]x[/b]:smile:" / "d.npy"
    said = succeeds(capfd, *extract(shared, shared / "town", out))
    assert f"{out}: 12 descriptors" in said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (b"b\nc.jpg", "found a line break in the name 'images/test/queries/b\\nc.jpg'"),
        (b"caf\xe9.jpg", "found the name 'images/test/queries/caf\\udce9.jpg', expected UTF-8"),
    ],
)
def test_a_name_that_is_no_line_of_text_is_refused_before_the_work(
    capfd, tmp_path, shared, town, name, words
):
    photograph = next((town / "images" / "test" / "queries").iterdir())
    shutil.copy(photograph, os.path.join(os.fsencode(photograph.parent), name))
    (tmp_path / "out").mkdir()
    fails(capfd, *extract(shared, town, tmp_path / "out" / "d.npy"), words=(words,))
    assert files_in(tmp_path / "out") == set()


OUTPUTS = (
    *(f"{verb} --out" for verb in ("train", "evaluate", "extract", "index", "pca", "export")),
    *(f"{verb} --out" for verb in ("vocabulary", "compare", "ablate", "demo", "render")),
    *(f"{verb} --json" for verb in ("evaluate", "query", "info", "models", "calibrate")),
    *(f"{verb} --latex" for verb in ("evaluate", "ablate", "info", "models", "calibrate")),
    *("evaluate --report", "pairs --out", "query --out", "query --gallery", "convert DST"),
)
SUFFIXES = {
    "--json": ".json",
    "--latex": ".tex",
    "--gallery": ".png",
    "pairs --out": ".txt",
    "query --out": ".csv",
    "extract --out": ".npy",
}


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("folder", ["/proc", "file"])
def test_every_output_is_checked_before_any_work(capfd, tmp_path, monkeypatch, output, folder):
    """In /proc no file can be made, though its permissions let root write there."""
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    verb, flag = output.split()
    module = importlib.import_module(f"crisalad_jax.cli.{verb}")
    monkeypatch.setattr(module, "run", lambda _: pytest.fail("the work began"))
    suffix = SUFFIXES.get(output, SUFFIXES.get(flag, ".safetensors"))
    target = os.path.join(folder, f"x{suffix}")
    example = shlex.split(crisalad_jax.cli._COMMANDS[verb]["example"])[1:]
    given = [*example[:-1], target] if flag == "DST" else [*example, flag, target]
    fails(capfd, *given, words=(f"crisalad: {target}: cannot be made: found {folder[:5]}, exp",))
    assert files_in(tmp_path) == {"file"}


def test_an_export_does_not_take_the_place_of_the_working_folder(
    capfd, tmp_path, monkeypatch, weights
):
    monkeypatch.chdir(tmp_path)
    start = ("export", "--weights", weights, "--out", ".")
    fails(capfd, *start, words=(".: found the working directory, expected another",))
