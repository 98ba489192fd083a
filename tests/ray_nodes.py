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
        "RAY_raylet_start_wait_time_s": "200",  # tests share a machine
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
            log = (folder / f"node{number}.log").open("wb")
            processes.append(
                subprocess.Popen(
                    command,
                    env={**common, **own},
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=_end_with_parent,
                )
            )
            log.close()
            _wait_for("Ray runtime started", folder / f"node{number}.log", processes[-1])
        yield Nodes(f"{host}:{port}", f"ray://{host}:{client}", processes, common)
    finally:
        for process in reversed(processes):
            for each in _in_session(process.pid):
                with contextlib.suppress(psutil.NoSuchProcess):
                    each.send_signal(signal.SIGKILL)
            process.wait(30)
        shutil.rmtree(folder, ignore_errors=True)


def _end_with_parent() -> None:
    """Let the kernel end a node when this process is killed; `--block` ends what it started."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _wait_for(words: str, log: pathlib.Path, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 120
    while words not in log.read_text(errors="replace"):
        assert process.poll() is None, log.read_text(errors="replace")
        assert time.monotonic() < end, words
        time.sleep(0.1)
