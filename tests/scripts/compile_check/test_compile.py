"""Programs compiled for GPUs and TPUs that are not here, by XLA's own compilers on the CPU."""

import importlib.util
import json
import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[3]
EXPECTED = ROOT / "docs" / "accelerators" / "compile_check.json"
OURS = ("XLA_FLAGS", "JAX_PLATFORMS")
"""Variables of the tests, which a user has not set."""
NEEDS = {"h100": "jax_plugins.xla_cuda12", "v5e": "libtpu", "v6e": "libtpu"}


def compile_check(target: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command as a user does: the flags that speed up tests would change the programs."""
    module = NEEDS[target.partition("-")[0]]
    try:
        found = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        found = None
    if found is None:
        pytest.skip(f"no {module}: pip install -r scripts/bench/compile_check.txt")
    command = [sys.executable, "-m", "scripts.compile_check", "--targets", target]
    return subprocess.run(
        [*command, *map(str, arguments), "--model.compute-dtype", "bfloat16", "--quiet"],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if name not in OURS},
        capture_output=True,
        text=True,
        check=False,
    )


GOALS = {
    ("v5e-8", "train"): ("compiler", 50e-3),
    ("v5e-1", "describe"): ("compiler", 180e-3),
    ("h100", "train"): ("roofline", 60e-3),
    ("h100-8", "train"): ("roofline", 8.5e-3),
    ("v5e-1", "train"): ("memory", 14e9),
}
"""What the work on accelerators was to reach: seconds, or bytes of a chip's 16 GB with room."""


@pytest.mark.slow
@pytest.mark.parametrize("target", ["h100", "h100-8", "v5e-1", "v5e-8", "v6e-8", "v5e-64"])
def test_b14_in_bfloat16_is_as_expected(target):
    done = compile_check(target, "--expect", EXPECTED)
    assert done.returncode == 0, done.stderr


def test_the_committed_figures_reach_the_goals():
    check = json.loads(EXPECTED.read_text())
    programs = {(each["target"], each["program"]): each for each in check["programs"]}
    for name, (field, most) in GOALS.items():
        assert programs[name][field] <= most, name
    for each in programs.values():
        assert each["bfloat16_sums"] == each["host_callbacks"] == 0
        assert each["fused_attention"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("target", ["h100-8", "v5e-8"])
def test_a_short_model_trains_in_few_messages_and_none_in_bfloat16(target, tmp_path):
    """Two blocks in place of twelve; 259 tokens, which are odd as the usual 257 are."""
    file = tmp_path / "check.json"
    done = compile_check(
        target,
        *("--programs", "train", "--preset", "s14", "--model.backbone.depth", 2),
        *("--model.backbone.registers", 2, "--batch-size", 16, "--json", file),
    )
    assert done.returncode == 0, done.stderr
    (program,) = json.loads(file.read_text())["programs"]
    assert program["bfloat16_sums"] == 0
    assert program["fused_attention"] > 0
    assert program["host_callbacks"] == 0
    # What trains and its moments are updated in place: all of the state but a few numbers.
    assert program["aliased"] > 10e6
    # The seven that docs/training.md names; one for a scatter may be written as two.
    assert sum(program["collectives"].values()) <= 8
