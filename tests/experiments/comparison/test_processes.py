"""Several processes that share the runs of a comparison."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from crisalad_jax.config import plugins
from crisalad_jax.config.io import to_plain
from crisalad_jax.experiments.comparison import ComparisonConfig, compare
from crisalad_jax.experiments.comparison.processes import shares_of
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import fails
from tests.conftest import MODEL

SMALL = f"""
import json
from crisalad_jax.config.io import from_plain
from crisalad_jax.nn.config import PRESETS, ModelConfig
plain = json.loads({json.dumps(to_plain(MODEL))!r})
PRESETS["tiny"] = from_plain(ModelConfig, plain, source="test")
"""
"""A plug-in by which other processes too have the small preset of these tests."""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, "_LOADED", {})
    path = tmp_path / "small.py"
    path.write_text(SMALL)
    return path


def test_gpus_are_dealt_out_or_shared_with_their_memory():
    def devices(*names):
        return [{"CUDA_VISIBLE_DEVICES": name} for name in names]

    def memory(share):
        return {"XLA_PYTHON_CLIENT_MEM_FRACTION": share}

    assert shares_of("gpu", 5, 2, None) == [(each, False) for each in devices("0,2,4", "1,3")]
    a, b = devices("GPU-a", "GPU-b")
    half, whole = (a | memory("0.450"), True), (b | memory("0.900"), False)
    assert shares_of("gpu", 2, 3, "GPU-a, GPU-b") == [half, whole, half]


def test_processes_share_a_cpu_and_no_tpu():
    assert shares_of("cpu", 1, 2, None) == [({}, True)] * 2
    with pytest.raises(InputError, match="--jobs: found 2 on tpu, expected 1"):
        shares_of("tpu", 4, 2, None)


def test_two_processes_share_the_runs(shared, settings, tmp_path, plugin):
    """Of two models from files; each is evaluated once, and the table is that of one process."""
    plugins.load_plugin(str(plugin))
    weights = shared / "weights.safetensors"
    lines = []
    config = ComparisonConfig(
        **settings
        | {"names": ("a", "b"), "weights": (f"a={weights}", f"b={weights}"), "train": None}
    )
    out = tmp_path / "out"
    summary = compare(config, out, jobs=2, say=lines.append, quiet=True)
    begun = [line.partition("] ")[2].partition(":")[0] for line in lines if "runs done" in line]
    assert sorted(begun) == ["a, seed 0", "b, seed 0"]
    alone = compare(config, tmp_path / "alone", quiet=True)
    assert [row.recalls for row in summary.rows] == [row.recalls for row in alone.rows]
    assert not list(out.rglob(".crisalad-*"))


def test_an_error_of_a_process_ends_all_in_one_line(flags, capfd, tmp_path, plugin):
    given = ("--plugin", plugin, "--jobs", 2, "--train", "none", "--out", tmp_path / "out")
    fails(capfd, *flags, *given, words=("none: found no such folder",))
    assert [path.name for path in tmp_path.iterdir()] == ["small.py"]


def workers_of(pid: int) -> list[int]:
    """Its processes, without multiprocessing's own that tracks resources."""
    found = map(int, pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    return [
        each
        for each in found
        if b"spawn_main" in pathlib.Path(f"/proc/{each}/cmdline").read_bytes()
    ]


def is_alive(pid: int) -> bool:
    try:
        stat = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return "Z" not in stat.rpartition(")")[2].split()[0]


def wait_for(condition, seconds: float = 600) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.fixture
def command(flags, tmp_path, plugin):
    """A command that compares by two processes, in `out`."""
    given = ("--out", tmp_path / "out", "--plugin", plugin, "--jobs", 2, "--epochs", 400)
    return [sys.executable, "-m", "crisalad_jax", *map(str, (*flags, *given))]


def start(command, out) -> tuple[subprocess.Popen[str], list[int]]:
    """Start it; return it and its two processes, which both train."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    metrics = [out / "crisalad" / f"seed-{seed}" / "run" / "metrics.jsonl" for seed in (0, 1)]
    wait_for(lambda: all(path.exists() and path.stat().st_size for path in metrics))
    workers = workers_of(process.pid)
    assert len(workers) == 2
    return process, workers


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_an_interruption_ends_all_and_the_same_command_goes_on(command, tmp_path, how):
    out = tmp_path / "out"
    process, workers = start(command, out)
    process.send_signal(how)
    assert process.wait(300) == (-how if how == signal.SIGKILL else 128 + how)
    wait_for(lambda: not any(map(is_alive, workers)), 60)
    results = [json.loads(path.read_text()) for path in out.rglob("result.json")]
    assert [result["training"] for result in results] == [None, None]
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert (out / "results.json").is_file()


@pytest.mark.slow
def test_a_killed_process_leaves_its_run_to_the_other(command, tmp_path):
    process, workers = start(command, tmp_path / "out")
    os.kill(workers[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors
    assert "ended with code -9; its runs are left to the others" in errors
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    (recalls,) = results["rows"][0]["recalls"].values()
    assert len(recalls["R@1"]["by_seed"]) == 2


@pytest.mark.slow
def test_two_commands_share_a_folder(command):
    """As two hosts do: each run is done once, and both print the table."""
    command = [*command, "--jobs", "1", "--epochs", "3", "--seeds", "4"]
    command.remove("--quiet")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    both = [subprocess.Popen(command, **pipes) for _ in range(2)]
    said = [process.communicate(timeout=500) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    lines = [line for _, errors in said for line in errors.splitlines() if " runs done" in line]
    assert sorted(line.partition(":")[0] for line in lines) == [
        f"crisalad, seed {seed}" for seed in range(4)
    ]
    tables = [output.partition("table.md")[0] for output, _ in said]
    assert "CriSALAD" in tables[0]
    assert tables[0] == tables[1]
