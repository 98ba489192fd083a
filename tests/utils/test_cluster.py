"""Reaching a Ray cluster. The map over workers is compared with Python's own."""

import os
import socket
import subprocess
import sys
import threading

import pytest

from crisalad_jax.utils import cluster
from crisalad_jax.utils.errors import InputError
from tests.ray_nodes import ray_nodes


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        (None, None),
        ("local", None),
        ("auto", None),
        ("ray://head", ("head", 10001)),
        ("ray://10.0.0.1:7", ("10.0.0.1", 7)),
        ("head:6379", ("head", 6379)),
        ("[::1]:6379", ("::1", 6379)),
    ],
)
def test_check_cluster(address, expected):
    assert cluster.check_cluster(address) == expected


@pytest.mark.parametrize("address", ["", "head", "http://head:1", "ray://", "head:", "a b:1"])
def test_check_cluster_refuses(address):
    with pytest.raises(InputError, match=r"^--cluster: got .* expected local, auto, ray://HOST"):
        cluster.check_cluster(address)


def _closed_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_no_cluster_there(scheme):
    address = f"{scheme}127.0.0.1:{_closed_port()}"
    with pytest.raises(InputError, match=f"^--cluster {address}: cannot connect .*refused"):
        cluster.connected(address).__enter__()


def test_without_ray(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"--cluster local: .* pip install 'crisalad-jax\[ray\]'$"):
        cluster.connected("local").__enter__()


OTHER_SERVER = """
import sys
from crisalad_jax.utils import cluster
cluster.CONNECT = 5.0
try:
    with cluster.connected(sys.argv[1]):
        pass
except ValueError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_another_server_there(scheme):
    """A server that accepts and says nothing does not hold a program up."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
        threading.Thread(target=server.accept, daemon=True).start()
        command = [sys.executable, "-c", OTHER_SERVER, address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.stdout == f"--cluster {address}: found no answer from a Ray cluster within 5 s\n"
    assert len(done.stderr.splitlines()) <= 1  # a warning of Ray's, which it writes itself


MAPPING = """
import functools, os, pathlib, signal, sys
from crisalad_jax.utils import cluster

def absolute(folder, item):
    try:
        (folder / str(item)).touch(exist_ok=False)
    except FileExistsError:
        return abs(item)
    if item % 10 == 0:  # the first time
        os.kill(os.getpid(), signal.SIGKILL)
    return abs(item)

with cluster.connected(sys.argv[1]) as ray:
    cluster.check_nodes(ray, read=[sys.argv[2]], write=pathlib.Path(sys.argv[2]))
    for kill in (False, True):
        items = range(-30, 0)
        how = {"prepare": int, "environment": {"SECRET": "1"}}
        work = functools.partial(absolute, pathlib.Path(sys.argv[2])) if kill else abs
        print(list(cluster.map_in_order(ray, work, items, **how)) == list(map(abs, items)))
    for work, items in ((int, "12x"), (os._exit, [1])):
        try:
            print(list(cluster.map_in_order(ray, work, items, **how)))
        except ValueError as error:
            print(type(error).__name__, error)
"""


@pytest.mark.slow
def test_map_in_order(tmp_path):
    with ray_nodes() as nodes:
        for name, address in (("driver", nodes.address), ("client", nodes.client)):
            (folder := tmp_path / name).mkdir()
            done = subprocess.run(
                [sys.executable, "-c", MAPPING, address, str(folder)],
                env=dict(nodes.environment),
                capture_output=True,
                text=True,
                timeout=300,
            )
            first, second, third, fourth = done.stdout.splitlines()
            assert first == second == "True"
            assert third == "ValueError invalid literal for int() with base 10: 'x'"
            assert fourth.startswith("InputError --cluster: workers ended 5 times at the same work")
            assert done.stderr == ""


FAKE = 'raise ImportError("no jaxlib")'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ('VERSION = "0.0.1"', "found crisalad-jax 0.0.1, expected"),
        (FAKE, "cannot import crisalad_jax (no jaxlib), expected"),
    ],
)
def test_node_of_another_version(tmp_path, version, expected):
    package = tmp_path / "crisalad_jax"
    (package / "utils").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "utils" / "__init__.py").touch()
    (package / "utils" / "version.py").write_text(version)
    (folder := tmp_path / "there").mkdir()
    with ray_nodes(environments=[{}, {"PYTHONPATH": str(tmp_path)}]) as nodes:
        done = subprocess.run(
            [sys.executable, "-c", MAPPING, nodes.address, str(folder)],
            cwd=folder,  # which workers look for modules in first
            env=dict(nodes.environment),
            capture_output=True,
            text=True,
            timeout=300,
        )
    last = done.stderr.splitlines()[-1]
    assert "InputError: --cluster: node " in last
    assert last.count("node ") == 1
    assert expected in last


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="mounts")
def test_node_without_the_files(tmp_path):
    """The second node has another file system where the folder is."""
    mounts = 'mount -t tmpfs none "$0" && exec "$@"'
    before = [[], ["unshare", "-m", "sh", "-c", mounts, str(tmp_path)]]
    (tmp_path / "there").mkdir()
    with ray_nodes(before=before) as nodes:
        done = subprocess.run(
            [sys.executable, "-c", MAPPING, nodes.address, str(tmp_path / "there")],
            env=dict(nodes.environment),
            capture_output=True,
            text=True,
            timeout=300,
        )
    last = done.stderr.splitlines()[-1]
    assert f"cannot read {tmp_path}/there, as this machine can (FileNotFoundError" in last
