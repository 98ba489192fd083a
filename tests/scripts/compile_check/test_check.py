"""`scripts.compile_check`: its bad input, and what it compares."""

import dataclasses
import importlib
import json
import pathlib
import sys
from collections.abc import Sequence

import jax
import pytest

from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from scripts.compile_check import (
    CompileCheck,
    ProgramCheck,
    differences,
    read_check,
)
from scripts.compile_check.__main__ import main
from scripts.compile_check.tables import COLUMNS, cells, markdown_table, rounded

ONE = ProgramCheck(
    target="v5e-8",
    program="train",
    images=192,
    memory=2_000_000_000,
    card_memory=16e9,
    aliased=138_000_000,
    flops=2_580_000_000_000,
    hbm_bytes=20_000_000_000,
    sent=90_000_000,
    collectives={"all-gather": 2, "all-reduce": 3},
    bfloat16_sums=0,
    fused_attention=36,
    host_callbacks=0,
    roofline=0.028,
    messages=0.0004,
    compiler=0.05,
    kernels=0.008,
)
CHECK = CompileCheck(recipe("tiny"), (ONE,))


def fails(monkeypatch: pytest.MonkeyPatch, *arguments: object, words: Sequence[object]) -> None:
    """The script with these flags, for the smallest model, ends with these words in one line."""
    flags = ["compile_check", "--preset", "tiny", *map(str, arguments)]
    monkeypatch.setattr(sys, "argv", flags)
    with pytest.raises(InputError) as error:
        main()
    assert "\n" not in str(error.value)
    for each in words:
        assert str(each) in str(error.value)


@pytest.fixture
def without_compilers(monkeypatch: pytest.MonkeyPatch):
    """An installation without compilers for accelerators."""
    original = importlib.import_module

    def missing(name: str, *rest):
        if name.partition(".")[0] in ("libtpu", "jax_plugins"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return original(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)


@pytest.mark.parametrize(
    ("target", "module", "package"),
    [("v5e-1", "libtpu", "jax[tpu]"), ("h100", "jax_plugins.xla_cuda12", "jax-cuda12-plugin")],
)
def test_a_compiler_that_is_not_installed_is_named(
    without_compilers, monkeypatch, target, module, package
):
    words = f"{target}: found no module {module}", f"pip install '{package}=={jax.__version__}'"
    fails(monkeypatch, "--targets", target, words=words)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--targets", "b200"), ("target: found 'b200'", "h100, h100-8, v4, v5e-1")),
        (("--programs", "serve"), ("program: found 'serve'", "describe, train")),
        (("--preset", "huge"), ("preset: found 'huge'", "tiny")),
        (("--expect", "none.json"), ("none.json",)),
        (("--keep", "nowhere"), ("nowhere: found no folder",)),
        (("--batch-size", "-3"), ("batch size: found -3 images, expected at least 1",)),
        (("--targets", "v5e-256"), ("found 96 images for 256 devices, expected a multiple of",)),
    ],
)
def test_bad_input_is_one_line(flags, words, monkeypatch):
    fails(monkeypatch, "--targets", "v5e-8", *flags, words=words)


def test_figures_of_another_configuration(tmp_path: pathlib.Path, monkeypatch):
    file = tmp_path / "expected.json"
    write_json(file, CHECK.as_json())
    flags = ("--targets", "v5e-8", "--expect", file, "--model.compute-dtype", "bfloat16")
    fails(monkeypatch, *flags, words=('found figures for model.compute_dtype "float32"', "bfloat"))


PLAIN = json.loads(json.dumps(CHECK.as_json()))


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([1, 2], "expected the JSON of `scripts.compile_check --json`"),
        ({"programs": []}, "found 'config', expected the JSON"),
        (PLAIN | {"programs": [PLAIN["programs"][0] | {"speed": 3}]}, "keyword argument 'speed'"),
        (PLAIN | {"config": 5}, "found 5, expected an object"),
    ],
)
def test_a_file_of_something_else(tmp_path: pathlib.Path, monkeypatch, value, words):
    file = tmp_path / "other.json"
    file.write_text(json.dumps(value))
    fails(monkeypatch, "--targets", "v5e-8", "--expect", file, words=(file, words))


def test_what_is_written_is_read_as_it_was(tmp_path: pathlib.Path):
    file = tmp_path / "check.json"
    write_json(file, CHECK.as_json())
    again = read_check(file)
    assert again == CHECK
    assert differences(again, CHECK) == []


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"memory": 2_090_000_000, "flops": 2_460_000_000_000}, None),
        ({"roofline": 1.0, "hbm_bytes": 1, "sent": 1}, None),
        ({"memory": 2_110_000_000}, "found memory 2,110,000,000, expected 2,000,000,000 within"),
        ({"memory": 1_890_000_000}, "found memory 1,890,000,000"),
        ({"flops": 3_000_000_000_000}, "found flops 3,000,000,000,000"),
        ({"aliased": 0}, "found aliased 0, expected 138000000"),
        ({"bfloat16_sums": 1}, "found bfloat16_sums 1, expected 0"),
        ({"fused_attention": 0}, "found fused_attention 0, expected 36"),
        ({"host_callbacks": 1}, "found host_callbacks 1, expected 0"),
        ({"collectives": {"all-to-all": 1}}, 'found collectives {"all-to-all": 1}, expected {"al'),
        ({"images": 384}, "found no expected figures"),
    ],
)
def test_one_line_for_each_difference(changes, line):
    found = CompileCheck(CHECK.config, (dataclasses.replace(ONE, **changes),))
    lines = differences(found, CHECK)
    assert len(lines) == (line is not None)
    if line is not None:
        assert lines[0].startswith(f"v5e-8 train of {changes.get('images', 192)} images: ")
        assert line in lines[0]


def test_a_program_that_does_not_compile_is_a_difference():
    found = CompileCheck(CHECK.config, (), ("v5e-1 train: found that it does not compile: HBM",))
    assert differences(found, CHECK) == list(found.failures)


def test_the_table_has_a_cell_for_each_column():
    row = dict(zip(COLUMNS, cells(ONE), strict=True))
    assert row["memory, GB"] == "2.00 of 16"
    assert row["compiler, ms"] == "50"
    # 192 images in 50.4 ms are 3,810 a second; two digits of a model are enough.
    assert row["images/s"] == "3,800"
    assert row["collectives"] == "2 gather, 3 reduce"
    header, rule, first = markdown_table([ONE], COLUMNS[:3]).splitlines()
    assert (header, rule) == ("| target | program | images |", "| --- | --- | ---: |")
    assert first == "| v5e-8 | train | 192 |"
    assert [rounded(x) for x in (0.4, 7.26, 3810, 99950)] == [0, 7, 3800, 100000]
