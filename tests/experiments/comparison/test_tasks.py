"""The runs of a comparison as tasks of Ray."""

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
from crisalad_jax.experiments.comparison.tasks import Share, in_tasks, joined, share_of
from crisalad_jax.utils import temporaries
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note, warn
from tests.cli.test_cli import fails
from tests.conftest import MODEL
from tests.ray_nodes import ray_nodes

SMALL = f"""
import json
from crisalad_jax.config.io import from_plain
from crisalad_jax.nn.config import PRESETS, ModelConfig
plain = json.loads({json.dumps(to_plain(MODEL))!r})
PRESETS["tiny"] = from_plain(ModelConfig, plain, source="test")
"""
"""A plug-in by which workers too have the small preset of these tests."""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, "_LOADED", {})
    path = tmp_path / "small.py"
    path.write_text(SMALL)
    return path


def gpus(*counts: int) -> list[dict[str, float]]:
    return [{"CPU": 16.0, "GPU": float(count)} for count in counts]


def cores(*counts: int) -> list[dict[str, float]]:
    return [{"CPU": float(count)} for count in counts]


SHARES = [
    (gpus(5), 2, Share("GPU", 2, 2, False)),  # the fifth is left
    (gpus(2), 3, Share("GPU", 0.5, 3, True)),
    (gpus(4, 1), 2, Share("GPU", 2, 2, False)),  # both on the first node: none has 4 and 1
    (gpus(4, 4), 3, Share("GPU", 2, 3, False)),
    (gpus(2, 1), None, Share("GPU", 1, 3, False)),
    (gpus(1) + cores(64), None, Share("GPU", 1, 1, False)),
    (gpus(1), 7, Share("GPU", 0.1428, 7, True)),  # seven of 0.1429 are more than 1
    (cores(2), 2, Share("CPU", 1, 2, True)),
    (cores(2), 5, Share("CPU", 0.3333, 5, True)),
    (cores(8), None, Share("CPU", 8, 1, False)),
    (cores(8, 20), None, Share("CPU", 8, 3, True)),
    ([{"memory": 1.0}, *cores(8, 8)], 2, Share("CPU", 8, 2, False)),
]


@pytest.mark.parametrize(("nodes", "jobs", "share"), SHARES)
def test_tasks_get_the_largest_share_with_which_they_fit(nodes, jobs, share):
    assert share_of(nodes, jobs) == share


def test_jobs_without_ray_are_one_line(flags, capfd, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    words = ("found no module ray, expected it with the extra ray: pip install",)
    fails(capfd, *flags, "--jobs", 2, "--out", tmp_path / "out", words=words)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_tasks_end_once_each_and_a_lost_worker_is_replaced(tmp_path, monkeypatch):
    """Calls in workers: in the driver's folder, with its plug-ins; one dies at first."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.py").write_text("import os\nos.environ['PART'] = 'loaded'\n")
    monkeypatch.setattr(plugins, "_LOADED", {})
    plugins.load_plugin("part.py")

    def work(shared: str, number: int) -> tuple[str, int, str, bool]:
        if number == 7:
            raise InputError("seven: found 7, expected another")
        path = pathlib.Path(f"{number}")
        is_first = not path.exists()
        with path.open("a") as file:
            file.write("x")
        if number == 1 and is_first:
            os.kill(os.getpid(), signal.SIGKILL)
        warn(f"a note of {number}")
        return shared, number, os.environ["PART"], os.getpid() != driver

    driver = os.getpid()
    each = ((number,) for number in range(4))
    with joined("local", 2, [], tmp_path) as share:
        with pytest.warns(Note) as notes:
            results = in_tasks(share, work, ("all",), each)
        assert sorted(results) == [("all", number, "loaded", True) for number in range(4)]
        calls = [(tmp_path / f"{number}").read_text() for number in range(4)]
        assert calls == ["x", "xx", "x", "x"]
        words = sorted(str(note.message) for note in notes)
        assert words[-1].startswith("a worker of the cluster was lost (WorkerCrashedError); ")
        assert words[:-1] == [f"a note of {number}" for number in range(4)]
        with pytest.raises(InputError, match=r"^seven: found 7, expected another$"):
            in_tasks(share, work, ("all",), [(7,)])


def program(flags, out, plugin, *more: object) -> list[str]:
    given = (*flags, "--methods", "crisalad+gem", "--out", out, "--plugin", plugin, *more)
    return [sys.executable, "-m", "crisalad_jax", *map(str, given)]


@pytest.mark.slow
def test_two_runs_at_once_have_the_bits_of_one_process(flags, tmp_path, plugin):
    """Of weights and ranks; all times differ."""
    found = []
    for jobs in ((), ("--jobs", 2)):
        out = tmp_path / f"out{len(jobs)}"
        done = subprocess.run(program(flags, out, plugin, *jobs), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        results = [json.loads(path.read_text()) for path in sorted(out.rglob("result.json"))]
        weights = [path.read_bytes() for path in sorted(out.rglob("last.safetensors"))]
        found.append((weights, [(each["settings"], each["ranks"]) for each in results]))
        assert [each["training"]["beside"] for each in results] == [bool(jobs)] * 2
        assert not list(out.rglob(".crisalad-*"))
    assert found[0] == found[1]


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


def holder_of(folder: pathlib.Path) -> int:
    """The process that writes into a folder; 0 for none."""
    try:
        words = (folder / temporaries.LOCK).read_text().split()
    except FileNotFoundError:
        words = []
    return int(words[1]) if words else 0


def start(command, out, environment=None) -> tuple[subprocess.Popen[str], list[int]]:
    """Start it; return it and the processes of its two runs, which both train."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, env=environment, **pipes)
    folders = [out / "crisalad+gem" / f"seed-{seed}" for seed in (0, 1)]
    metrics = [folder / "run" / "metrics.jsonl" for folder in folders]

    def begun() -> bool:
        return all(path.exists() and path.stat().st_size for path in metrics)

    wait_for(lambda: begun() or process.poll() is not None)
    assert process.poll() is None, process.communicate()
    return process, [holder_of(folder) for folder in folders]


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """A folder of compiled programs, so that each is compiled once."""
    return tmp_path_factory.mktemp("programs")


@pytest.fixture
def long(flags, tmp_path, plugin, programs, monkeypatch):
    """A command that trains two runs at once, for some time."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(programs))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    return program(flags, tmp_path / "out", plugin, "--jobs", 2, "--epochs", 150)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_an_interruption_ends_all_and_the_same_command_resumes(long, tmp_path, how):
    out = tmp_path / "out"
    process, workers = start(long, out)
    process.send_signal(how)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == (-how if how == signal.SIGKILL else 128 + how), errors
    wait_for(lambda: not any(map(is_alive, workers)), 60)
    results = [json.loads(path.read_text()) for path in out.rglob("result.json")]
    assert [result["training"] for result in results] == [None, None]
    if how != signal.SIGKILL:  # each has saved the state after its last step
        assert len(list(out.glob("*/*/run/state/[0-9]*"))) == 2
        assert not list(out.rglob(".crisalad-*"))
    again = subprocess.run(long, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert (out / "results.json").is_file()


@pytest.mark.slow
def test_a_second_signal_does_not_wait(long, tmp_path):
    process, workers = start(long, tmp_path / "out")
    for worker in workers:  # they cannot save
        os.kill(worker, signal.SIGSTOP)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(1)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    wait_for(lambda: not any(map(is_alive, workers)), 60)


@pytest.mark.slow
def test_the_run_of_a_killed_worker_is_begun_again(long, tmp_path):
    process, workers = start(long, tmp_path / "out")
    os.kill(workers[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors
    assert errors.count("a worker of the cluster was lost (WorkerCrashedError); ") == 1
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    (recalls,) = results["rows"][0]["recalls"].values()
    assert len(recalls["R@1"]["by_seed"]) == 2


@pytest.mark.slow
def test_the_run_of_a_lost_node_is_begun_again_on_another(flags, tmp_path, plugin, programs):
    out = tmp_path / "out"
    variables = {"JAX_COMPILATION_CACHE_DIR": str(programs)}
    with ray_nodes() as nodes:
        command = program(flags, out, plugin, "--cluster", nodes.address, "--epochs", 150)
        process, workers = start(command, out, {**nodes.environment, **variables})
        _, second = sessions = [node.pid for node in nodes.processes]
        assert sorted(map(os.getsid, workers)) == sorted(sessions)
        for pid in nodes.pids("raylet"):
            if os.getsid(pid) == second:
                os.kill(pid, signal.SIGKILL)
        _, errors = process.communicate(timeout=900)
    assert process.returncode == 0, errors
    assert errors.count("a worker of the cluster was lost (") == 1
    results = [json.loads(path.read_text()) for path in sorted(out.rglob("result.json"))]
    assert [each["training"]["beside"] for each in results] == [False, False]
    assert all(each["ranks"] for each in results)
