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
NEEDS = {"h100": "jax_plugins.xla_cuda12", "v5e": "libtpu"}


def compile_check(target: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command as a user does: the flags that speed up tests would change the programs."""
    module = NEEDS[target.partition("-")[0]]
    try:
        found = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        found = None
    if found is None:
        pytest.skip(f"no {module}: pip install 'crisalad-jax[accelerators]'")
    command = [sys.executable, "-m", "crisalad_jax", "compile-check", "--targets", target]
    return subprocess.run(
        [*command, *map(str, arguments), "--model.compute-dtype", "bfloat16", "--quiet"],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": "", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("target", ["h100", "h100-8", "v5e-1", "v5e-8"])
def test_b14_in_bfloat16_is_as_expected(target):
    done = compile_check(target, "--expect", EXPECTED)
    assert done.returncode == 0, done.stderr


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
