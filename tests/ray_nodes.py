"""Nodes of a Ray cluster on this machine, each a raylet of its own, pinned to one core."""

import contextlib
import ctypes
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import psutil

_TRIES = 3
"""Times that a node is started: Ray gives it 30 seconds."""


class Nodes(NamedTuple):
    """A cluster that runs."""

    address: str
    """HOST:PORT of its head, of which this machine is a node."""
    client: str
    """ray://HOST:PORT."""
    processes: list[subprocess.Popen[bytes]]
    """`ray start --block` of each node, the head first."""
    environment: Mapping[str, str]
    """Of the nodes, and of a driver."""

    def pids(self, name: str) -> list[int]:
        """List the processes of the nodes whose command line has this name."""
        return [
            process.pid
            for node in self.processes
            for process in _in_session(node.pid)
            if name in " ".join(process.info["cmdline"] or ())
        ]


def _in_session(session: int) -> list[psutil.Process]:
    found = []
    for process in psutil.process_iter(["cmdline"]):
        with contextlib.suppress(ProcessLookupError):
            if os.getsid(process.pid) == session:
                found.append(process)
    return found


def _free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


def pinned(core: int) -> list[str]:
    """Return the beginning of a command that runs on one core of this machine."""
    usable = sorted(os.sched_getaffinity(0))
    return ["taskset", "-c", str(usable[core % len(usable)])]


@contextlib.contextmanager
def ray_nodes(
    count: int = 2,
    *,
    environments: Sequence[Mapping[str, str]] = (),
    before: Sequence[Sequence[str]] = (),
    host: str = "127.0.0.1",
    hosts: Sequence[str] = (),
) -> Iterator[Nodes]:
    """Run a cluster while the block runs.

    Args:
        count: number of nodes.
        environments: variables of each node; missing ones are empty.
        before: the beginning of each node's command, such as `ip netns exec NAME`.
        host: the head's address.
        hosts: the nodes' addresses; by default all are the head's.
    """
    folder = pathlib.Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # sockets need short paths
    root = pathlib.Path(__file__).parent.parent
    common = {
        **os.environ,
        "PYTHONPATH": str(root),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "disabled",
    }
    port, client = _free_port(), 20000 + _free_port() % 10000
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for number in range(count):
            where = hosts[number] if hosts else host
            role = ["--address", f"{host}:{port}"]
            if number == 0:
                role = ["--head", "--port", str(port), "--ray-client-server-port", str(client)]
                role += ["--include-dashboard=false", "--temp-dir", str(folder)]
            command = [*(before[number] if before else pinned(number)), sys.executable, "-m"]
            command += ["ray.scripts.scripts", "start", "--block", "--num-cpus", "1", *role]
            command += ["--node-ip-address", where, "--disable-usage-stats"]
            command += ["--object-store-memory", str(200 * 2**20)]
            own = environments[number] if number < len(environments) else {}
            log = folder / f"node{number}.log"
            for _ in range(_TRIES):
                with log.open("wb") as file:
                    process = subprocess.Popen(
                        command,
                        env={**common, **own},
                        stdout=file,
                        stderr=subprocess.STDOUT,
                        start_new_session=True,
                        preexec_fn=_end_with_parent,
                    )
                processes.append(process)
                if _has_started(process, log):
                    break
                _end(processes.pop())
            else:
                raise AssertionError(log.read_text(errors="replace"))
        yield Nodes(f"{host}:{port}", f"ray://{host}:{client}", processes, common)
    finally:
        for process in reversed(processes):
            _end(process)
        shutil.rmtree(folder, ignore_errors=True)


def _end_with_parent() -> None:
    """Let the kernel end a node when this process is killed; `--block` ends what it started."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _has_started(process: subprocess.Popen[bytes], log: pathlib.Path) -> bool:
    """Wait until a node runs; it ends itself where the machine is too busy for it."""
    end = time.monotonic() + 400
    while process.poll() is None and time.monotonic() < end:
        if "Ray runtime started" in log.read_text(errors="replace"):
            return True
        time.sleep(0.1)
    return False


def _end(process: subprocess.Popen[bytes]) -> None:
    for each in _in_session(process.pid):
        with contextlib.suppress(psutil.NoSuchProcess):
            each.send_signal(signal.SIGKILL)
    process.wait(30)
