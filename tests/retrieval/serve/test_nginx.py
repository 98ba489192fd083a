"""The service behind nginx, as docs/serve.md writes it."""

import pathlib
import re
import shutil
import socket
import subprocess
import time

import pytest

from tests.retrieval.serve.conftest import Service, serving

ROOT = pathlib.Path(__file__).parents[3]
TOKEN = "0123456789abcdef"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nginx") is None, reason="needs nginx")
def test_behind_a_proxy(own_map, params, pictures, tmp_path):
    page = (ROOT / "docs" / "serve.md").read_text()
    (location,) = re.findall(r"```nginx\n(.*?)```", page, re.DOTALL)
    data, right = pictures[4].read_bytes(), {"Authorization": f"Bearer {TOKEN}"}
    with serving(own_map, params, appends=True, token=TOKEN) as own:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        settings = tmp_path / "nginx.conf"
        settings.write_text(f"""
            daemon off; pid {tmp_path}/pid; error_log {tmp_path}/error.log; user root;
            events {{ }}
            http {{ access_log {tmp_path}/access.log;
                    server {{ listen 127.0.0.1:{port};
                              {location.replace("8000", str(own.port))} }} }}
        """)
        with subprocess.Popen(["nginx", "-c", str(settings)]) as nginx:
            try:
                there = Service(port, own.worker, own.stop, own.thread)
                for _ in range(100):
                    with socket.socket() as probe:
                        if probe.connect_ex(("127.0.0.1", port)) == 0:
                            break
                    time.sleep(0.1)
                health = there.ask("GET", "/places/health", Host="robot.example")
                assert health.json["status"] == "ok"
                reply = there.ask("GET", "/places", Host="evil.example")
                assert (reply.status, reply.headers["location"]) == (301, "/places/")
                assert there.ask("GET", "/places/").data == own.ask("GET", "/").data
                assert there.ask("GET", "/places/map/", **right).status == 404
                for wrong in ({}, {"Authorization": "Bearer "}):
                    reply = there.ask("GET", "/places/map", **wrong)
                    assert (reply.status, reply.headers["www-authenticate"]) == (401, "Bearer")
                asked = {**right, "Host": "robot.example", "Origin": "https://robot.example"}
                add = "/places/images?name=tuesday/%C3%A9%20b.jpg"
                assert there.ask("POST", add, data, **asked).json["name"] == "tuesday/é b.jpg"
                found = there.ask("POST", "/places/locate?k=1", data, **asked).json["neighbours"]
                assert [each["number"] for each in found] == [7]
                assert there.ask("GET", "/places/images/7", **right).data.startswith(b"\xff\xd8")
                # The service's limit is smaller in this test than nginx's.
                for size, kind in ((2**20, "application/json"), (20 * 2**20 + 1, "text/html")):
                    reply = there.ask("POST", "/places/locate", bytes(size), **right)
                    assert (reply.status, reply.headers["content-type"]) == (413, kind)
            finally:
                nginx.terminate()
    log = (tmp_path / "access.log").read_text()
    assert "/places/map/" in log
    assert TOKEN not in log
