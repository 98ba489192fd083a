"""The same run on 1, 2, 4 and 8 devices, and in two processes that meet on this machine."""

import dataclasses
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.remote import read_remote
from crisalad_jax.training import distributed as processes
from crisalad_jax.training import loop, run_files
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import RECIPE
from tests.training.programs import COMPILED_SOON, ROOT, run_on_devices

# Eight images a step, two steps an epoch: ten steps.
CONFIG = dataclasses.replace(
    RECIPE, trainable="adapters,head", places_per_batch=4, epochs=5, patience=None
)
DEVICES = """
import dataclasses, pathlib, sys
from unittest import mock
import jax
from crisalad_jax.training import trainer as module
from crisalad_jax.training.loop import fit
from crisalad_jax.utils import devices as spreading
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from tests.training.test_processes import CONFIG

shared, out = map(pathlib.Path, sys.argv[1:3])
part = sys.argv[3]
places, town = read_places(shared / "city", min_images=2), open_benchmark(shared / "town")
devices, step, seen = jax.devices(), module.train_step, set()

def train_step(state, frozen, images, *rest):
    state, metrics = step(state, frozen, images, *rest)
    parts = [leaf for leaf in jax.tree.leaves(state) if not leaf.is_fully_replicated]
    seen.add((len(images.sharding.device_set), len(parts) > 50))
    return state, metrics

def run(name, config, count, **options):
    with (
        mock.patch.object(jax, "local_devices", lambda **_: devices[:count]),
        mock.patch.object(module, "train_step", train_step),
    ):
        trained = fit(config, places, out / name, quiet=True, **options).params
    ((spread, split),) = seen
    print(name, spread, split, len(trained.backbone.blocks.ls1.sharding.device_set))
    seen.clear()

if part == "counts":
    for count in (1, 2, 8):
        # A validation owes nothing to the devices of the steps: that of the processes is compared.
        run(str(count), CONFIG, count, validation=town if count == 1 else None)
    sys.exit()
spreading.SHARD_FROM = 64  # numbers: this model has no larger arrays
run("split", CONFIG, 8, shard_state=True)
run("all", dataclasses.replace(CONFIG, trainable="all", epochs=1), 8)
"""


@pytest.fixture(scope="module")
def by_devices(shared: pathlib.Path, tmp_path_factory) -> pathlib.Path:
    """A run on each number of devices, in folders named by it; what comes back is on one."""
    out = tmp_path_factory.mktemp("devices")
    said = run_on_devices(8, DEVICES, shared, out, "counts")
    assert said == ["1 1 False 1", "2 2 False 1", "8 8 False 1"]
    return out


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return listener.getsockname()[1]


# It says when it starts a step (s) and when it waits for the other process (w).
COMMAND_LINE = """
import sys
from jax.experimental import multihost_utils
from crisalad_jax import cli
from crisalad_jax.training import trainer
from crisalad_jax.utils import devices
devices.SHARD_FROM = 64
events = []

def told(what, function):
    def call(*args, **options):
        events.append(what)
        return function(*args, **options)
    return call

trainer.train_step = told("s", trainer.train_step)
for name in ("process_allgather", "broadcast_one_to_all"):
    setattr(multihost_utils, name, told("w", getattr(multihost_utils, name)))
code = cli.main()
print("events", "".join(events))
sys.exit(code)
"""


def start(
    shared: pathlib.Path, out: pathlib.Path, *more: str, both: tuple[str, ...] = ()
) -> list[subprocess.Popen[str]]:
    """The command line, in two processes; `more` flags are for the second."""
    config = out.with_suffix(".json")
    write_json(config, to_plain(CONFIG))
    meet = f"localhost:{free_port()}"
    return [
        subprocess.Popen(
            [
                *(sys.executable, "-c", COMMAND_LINE, "train", "--config", str(config)),
                *(() if index == 1 and "--data" in more else ("--data", str(shared / "city"))),
                *("--val", str(shared / "town")),
                *("--out", str(out), "--coordinator-address", meet),
                *("--num-processes", "2", "--process-id", str(index), "--quiet", *both),
                *(more if index == 1 else ()),
            ],
            cwd=ROOT,
            # What is said of virtual devices does not count here: see `processes.join_processes`.
            env={**COMPILED_SOON, "JAX_NUM_CPU_DEVICES": "2"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(2)
    ]


def ends(programs: list[subprocess.Popen[str]]) -> list[tuple[int, str]]:
    """Exit codes, and all that was printed."""
    return [
        (program.returncode, out + errors)
        for program, (out, errors) in [(p, p.communicate(timeout=300)) for p in programs]
    ]


STEP = ("step", "epoch", "loss", "easy_anchor_fraction", "learning_rate", "skipped_images")
RECALLS = ("step", "epoch", "R@1", "R@5", "R@10", "R@20")


def logged(out: pathlib.Path, names: tuple[str, ...]) -> list[list[float]]:
    lines = read_metrics(out / "metrics.jsonl")
    return [[line[name] for name in names] for line in lines if names[-1] in line]


# Their gradient is 0 but for rounding, of which Adam makes steps of full length: the transport's
# potentials take up what is added to a cluster's scores, a softmax what is added to its keys.
FREE = ("aggregator.score.fc2.bias", "aggregator.dust_bin")
KEYS = re.compile(r"cross_image\.layers\.\d\.attn\.qkv\.bias")


def trained(out: pathlib.Path) -> dict[str, np.ndarray]:
    """Arrays of the last weights whose steps their gradients decide."""
    found = {}
    for name, leaf in named_leaves(load_weights(out / "last.safetensors")[0]).items():
        array = np.asarray(leaf)
        if KEYS.fullmatch(name):
            queries, _, values = np.split(array, 3)
            found |= {f"{name}, queries": queries, f"{name}, values": values}
        elif name not in FREE:
            found[name] = array
    return found


def assert_same_run(found: pathlib.Path, expected: pathlib.Path) -> None:
    """Ten steps' losses and the parameters after them, each within 1e-5 of its own size.

    Sums are taken in another order: the largest error seen is 3e-6, of `adapter.up`, whose weights
    began at 0.
    """
    np.testing.assert_allclose(logged(found, STEP), logged(expected, STEP), rtol=1e-5)
    # Of gradients, which the loss's exponents of 50 times a similarity round more: 1.1e-5 seen.
    norms = (logged(run, ("gradient_norm",)) for run in (found, expected))
    np.testing.assert_allclose(*norms, rtol=3e-5)
    assert len(logged(found, STEP)) == 10
    ours, theirs = trained(found), trained(expected)
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        error = np.linalg.norm(array - theirs[name])
        assert error <= 1e-5 * np.linalg.norm(theirs[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["2", "8"])
def test_devices_do_not_change_a_run(by_devices: pathlib.Path, name: str):
    assert_same_run(by_devices / name, by_devices / "1")


@pytest.mark.slow
def test_a_split_state_does_not_change_a_run(shared, by_devices, tmp_path):
    """Where all trains a CPU's devices do not share it."""
    said = run_on_devices(8, DEVICES, shared, tmp_path, "split")
    assert said == ["split 8 True 1", "all 1 False 1"]
    assert_same_run(tmp_path / "split", by_devices / "1")


@pytest.mark.slow
def test_two_processes_do_not_change_a_run(shared, by_devices, tmp_path):
    out = tmp_path / "run"
    codes = ends(start(shared, out))
    assert [code for code, _ in codes] == [0, 0], codes
    for _, words in codes:
        # Five epochs of two steps: between steps of an epoch no process waits for the other.
        assert re.search(r"^events w+(ssw+){5}$", words, re.MULTILINE), words
    assert_same_run(out, by_devices / "1")
    assert logged(out, RECALLS) == logged(by_devices / "1", RECALLS)
    assert len(logged(out, RECALLS)) == 5


@pytest.mark.parametrize(
    ("more", "what"),
    [
        (("--data", "{smaller}"), "places"),
        (("--data", "{longer}"), "sizes of images"),
        (("--epochs", "9"), "configuration"),
        (("--shard-state",), "--shard-state"),
    ],
)
@pytest.mark.slow
def test_processes_that_differ_end_before_the_run(shared, tmp_path, more, what):
    smaller, out = shutil.copytree(shared / "city", tmp_path / "smaller"), tmp_path / "run"
    (smaller / "Dataframes" / "Brill.csv").unlink()
    longer = shutil.copytree(shared / "city", tmp_path / "longer")
    with next(longer.rglob("*.jpg")).open("ab") as picture:
        picture.write(b"x")
    more = [flag.format(smaller=smaller, longer=longer) for flag in more]
    for code, words in ends(start(shared, out, *more)):
        assert code == 2, words
        assert f"processes: found other {what} in process 1 than in 0, expected the same" in words
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--data", "none"), "crisalad: none"),
        (("--weights", "no.safetensors"), "no.safetensors"),
        # Without credentials, which the tests' environment has not.
        (("--data", "s3://none/places"), "crisalad: s3://none/places"),
    ],
)
def test_what_fails_in_one_process_before_training_ends_both(shared, tmp_path, more, words):
    found = ends(start(shared, tmp_path / "run", *more))
    assert [code for code, _ in found] == [2, 2], found
    assert "crisalad: processes: process 1 failed; see what it says" in found[0][1]
    assert words in found[1][1]


@pytest.mark.slow
def test_an_image_that_one_process_cannot_read_ends_both(shared, tmp_path):
    town = shutil.copytree(shared, tmp_path / "shared")
    broken = sorted((town / "city").rglob("*.jpg"))[:3]  # all of a place
    for path in broken:
        path.write_bytes(b"no picture")
    found = ends(start(town, tmp_path / "run"))
    assert [code for code, _ in found] == [2, 2], found
    words = sorted(words.splitlines()[-1] for _, words in found)
    assert any(words[0].startswith(f"crisalad: {path}: found 10 bytes") for path in broken)
    assert re.fullmatch("crisalad: processes: process [01] failed; see what it says", words[1])


def wait_for_steps(programs: list[subprocess.Popen[str]], out: pathlib.Path) -> None:
    log = out / "metrics.jsonl"
    while not (log.exists() and log.read_bytes().count(b"\n") > 2):
        assert programs[0].poll() is None, ends(programs)
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_where_one_process_is_killed_the_other_ends_and_both_go_on(
    shared, by_devices, tmp_path, killed
):
    out = tmp_path / "run"
    programs = start(shared, out)
    wait_for_steps(programs, out)
    programs[killed].kill()
    found = ends(programs)
    assert found[killed][0] == -signal.SIGKILL
    code, words = found[1 - killed]
    assert code != 0
    assert re.search(
        "^crisalad: processes: lost (process [01]|another process)", words, re.MULTILINE
    )
    assert "Check failure stack trace" not in words
    assert [code for code, _ in ends(start(shared, out))] == [0, 0]
    assert_same_run(out, by_devices / "1")


@pytest.mark.slow
@pytest.mark.parametrize("both", [(), ("--shard-state", "--num-threads", "1")], ids=str)
def test_a_signal_to_one_process_stops_all_and_all_go_on(shared, by_devices, tmp_path, both):
    out = tmp_path / "run"
    programs = start(shared, out, both=both)
    wait_for_steps(programs, out)
    programs[1].send_signal(signal.SIGTERM)
    for code, words in ends(programs):
        assert code == 128 + signal.SIGTERM, words
        assert "the same command goes on" in words
    assert len(logged(out, STEP)) < 10
    assert [code for code, _ in ends(start(shared, out, both=both))] == [0, 0]
    assert_same_run(out, by_devices / "1")


STOP = """
import crisalad_jax as cj

@cj.register_callback("stop-at-3")
class StopAt3(cj.Callback):
    def on_step(self, numbers):
        if numbers["step"] == 3:
            raise cj.StopTraining
"""


@pytest.mark.slow
def test_a_callback_stops_all_processes_and_all_go_on(shared, tmp_path):
    """And batches that one of them has drawn by descriptors are those of all."""
    plugin = tmp_path / "stop.py"
    plugin.write_text(STOP)
    hard = ("--sampler", "hard-negatives", "--plugin", str(plugin))
    out = tmp_path / "run"
    found = ends(start(shared, out, both=(*hard, "--callback", "stop-at-3")))
    assert [code for code, _ in found] == [0, 0], found
    # The step after the one that is logged is under way, and is finished.
    assert len(logged(out, STEP)) == 4
    assert [code for code, _ in ends(start(shared, out, both=hard))] == [0, 0]
    config = dataclasses.replace(CONFIG, sampler="hard-negatives")
    places, town = read_places(shared / "city", min_images=2), open_benchmark(shared / "town")
    fit(config, places, tmp_path / "one", validation=town, quiet=True)
    assert_same_run(out, tmp_path / "one")


@pytest.mark.parametrize(
    "given",
    [
        *(("auto", 2, None), ("host:1", None, 0), ("host:1", 2, 2), ("host:1", 2, -1)),
        *(("host", 2, 0), ("host:0", 2, 0), ("host:65536", 2, 0)),
    ],
)
def test_processes_that_make_no_sense_are_refused(given):
    with pytest.raises(InputError, match=r"^processes: found .* expected"):
        processes.join_processes(*given)


@pytest.fixture
def initialised(monkeypatch) -> list[dict]:
    """What JAX was asked for, in place of meeting other processes; nothing tells of a launcher."""
    asked: list[dict] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **given: asked.append(given))
    monkeypatch.setattr(jax.config, "update", lambda name, value: None)
    for name in ("SLURM_PROCID", "SLURM_LOCALID", "OMPI_COMM_WORLD_RANK", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    return asked


@pytest.mark.parametrize(
    ("coordinator", "environment", "given", "expected"),
    [
        ("127.0.0.1:1", {"SLURM_PROCID": "3", "SLURM_LOCALID": "1"}, None, [3]),
        ("[::1]:1", {}, None, [3]),
        ("host0:1", {}, None, None),
        ("host0:1", {"SLURM_PROCID": "3", "SLURM_LOCALID": "1"}, None, [1]),
        # Of a shell that Slurm began, whose processes it knows nothing of.
        ("host0:1", {"SLURM_PROCID": "0", "SLURM_LOCALID": "0"}, None, None),
        ("host0:1", {"OMPI_COMM_WORLD_RANK": "3", "OMPI_COMM_WORLD_LOCAL_RANK": "2"}, None, [2]),
        # A process that sees one GPU alone was given it: here it has the number 0.
        ("localhost:1", {"CUDA_VISIBLE_DEVICES": "3"}, None, None),
        ("localhost:1", {"CUDA_VISIBLE_DEVICES": "0,1,2,3"}, None, [3]),
        ("localhost:1", {"JAX_LOCAL_DEVICE_IDS": "2"}, None, None),
        ("localhost:1", {}, (4, 5), [4, 5]),
        ("auto", {}, (1,), [1]),
    ],
)
def test_each_process_of_a_host_has_its_own_gpu(
    initialised, monkeypatch, coordinator, environment, given, expected
):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    numbers = (None, None) if coordinator == "auto" else (4, 3)
    processes.join_processes(coordinator, *numbers, given)
    (asked,) = initialised
    assert asked.get("local_device_ids") == expected
    if coordinator != "auto":
        assert (asked["num_processes"], asked["process_id"]) == (4, 3)


def test_processes_that_gave_other_numbers_are_named(monkeypatch):
    given = np.array([[1, 7], [1, 7], [1, 8], [1, 9]])
    monkeypatch.setattr(processes, "_gather", lambda *numbers: given)
    words = "^processes: found other places in processes 2, 3 than in 0, expected the same$"
    with pytest.raises(InputError, match=words):
        processes.check_same({"configuration": 1, "places": 7})
    given[2:] = given[0]
    processes.check_same({"configuration": 1, "places": 7})


def test_sums_of_data_tell_names_places_and_sizes(shared, tmp_path):
    city = shutil.copytree(shared / "city", tmp_path / "city")
    first, second = (read_places(each, min_images=2) for each in (shared / "city", city))
    sums = run_files.checksum_of_places, run_files.checksum_of_sizes
    assert [of(first) for of in sums] == [of(second) for of in sums]
    with second.path(3).open("ab") as picture:
        picture.write(b"x")
    other = dataclasses.replace(second, names=("another", *second.names[1:]))
    assert [of(first) == of(other) for of in sums] == [False, False]
    assert sums[0](first) == sums[0](second)


def test_images_at_addresses_are_read_by_the_cache(shared, tmp_path, monkeypatch):
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path))
    places = read_places(shared / "city", min_images=2)
    far = dataclasses.replace(places, root=pathlib.Path("s3://bucket/places"))
    assert loop._reader(places, 1.0) is loop._reader(far, 0.0) is read_remote
    cache = loop._reader(far, 2.0).__self__  # pyright: ignore
    assert (cache._folder, cache._share * 256) == (tmp_path / "images", 2e9)
    with pytest.raises(InputError, match=r"^--cache-gb: found -1, expected at least 0"):
        fit(CONFIG, places, tmp_path / "run", cache_gb=-1.0)


def test_the_process_that_failed_is_named(monkeypatch):
    monkeypatch.setattr(processes, "all_max", lambda *numbers: (1, 2))
    with pytest.raises(InputError, match=r"^processes: process 2 failed; see what it says$"):
        processes.raise_together(lambda: None)


@pytest.mark.parametrize("given", [(), (0, -1)])
def test_gpus_that_make_no_sense_are_refused(initialised, given):
    with pytest.raises(InputError, match=r"^--local-device-ids: found .* expected"):
        processes.join_processes("auto", None, None, given)
    assert not initialised
