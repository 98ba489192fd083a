"""A Milvus server for tests: 2.3.5, of the package `milvus` (`pip install --no-deps milvus`).

Its command is needed alone, so that any environment on PATH may have it.
"""

import os
import pathlib
import shutil
import signal
import subprocess
import time

import pymilvus
import pytest

ADDRESS = "http://127.0.0.1:19530"
PROGRAM = shutil.which("milvus-server")


class Server:
    """A process that can be killed, and started again with the same data."""

    def __init__(self, folder: pathlib.Path) -> None:
        if PROGRAM is None:
            pytest.skip("found no milvus-server on PATH")
        self._folder = folder
        self.start()
        self.wait()

    def start(self) -> None:
        with (self._folder / "log").open("a") as log:
            program = [PROGRAM, "--data", self._folder / "data", "--proxy-port", "19530"]
            self._process = subprocess.Popen(
                program, stdout=log, stderr=log, start_new_session=True
            )

    def wait(self) -> None:
        end = time.monotonic() + 180
        while True:
            try:
                return pymilvus.MilvusClient(ADDRESS, timeout=5).close()
            except pymilvus.MilvusException:
                assert time.monotonic() < end, "no answer in 180 s"
                time.sleep(0.5)

    def kill(self, number: int = signal.SIGKILL) -> None:
        os.killpg(self._process.pid, number)
        if number == signal.SIGKILL:
            self._process.wait()
