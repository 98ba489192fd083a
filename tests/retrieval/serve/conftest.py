"""A map that is served on a free port, by threads of the test's process."""

import contextlib
import http.client
import json
import pathlib
import shutil
import signal
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.serve.app import make_app
from crisalad_jax.retrieval.serve.server import Server, _bound
from crisalad_jax.retrieval.serve.worker import MapWorker
from crisalad_jax.utils.signals import SignalState
from tests.conftest import BATCH, MODEL

LIMIT = 50_000
"""Largest body in bytes: the town's pictures have a tenth of it."""


TOGETHER = 3
"""Pictures described at once: of 1 and 3 there are programs to compile, two are padded."""


class Reply(NamedTuple):
    status: int
    headers: dict[str, str]
    data: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.data)


class Service(NamedTuple):
    """A running service."""

    port: int
    worker: MapWorker
    stop: SignalState
    thread: threading.Thread

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> Reply:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        with contextlib.closing(connection):
            named = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, body, named)
            answer = connection.getresponse()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return Reply(answer.status, found, answer.read())


@contextlib.contextmanager
def serving(
    folder: pathlib.Path, params: Any, *, appends: bool = False, **options: Any
) -> Iterator[Service]:
    with contextlib.ExitStack() as stack:
        places = stack.enter_context(Map.open(folder))
        if appends:
            places = stack.enter_context(open_for_appending(folder, places.metadata))
        describer = places.describer(Model(params, places.config))
        worker = MapWorker(places, describer, batch_size=TOGETHER)
        stack.enter_context(contextlib.closing(worker))
        app = make_app(worker, appends=appends, max_bytes=LIMIT, **options)
        stop, up = SignalState(), threading.Event()
        server = Server(app, stop, up.set, options.get("tiles"))
        listener = stack.enter_context(contextlib.closing(_bound("127.0.0.1", 0)))
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        assert up.wait(60)
        yield Service(listener.getsockname()[1], worker, stop, thread)
        stop.number = signal.SIGTERM
        thread.join(60)
        assert not thread.is_alive()


@pytest.fixture(scope="session")
def folder(shared, params, sides, tmp_path_factory) -> pathlib.Path:
    out = tmp_path_factory.mktemp("serve") / "town.map"
    weights = shared / "weights.safetensors"
    index(
        Model(params, MODEL),
        sides[0],
        out,
        weights=weights,
        reading=Reading(batch_size=BATCH, quiet=True),
    )
    return out


@pytest.fixture(scope="session")
def service(folder, params) -> Iterator[Service]:
    """A service that is only read."""
    with serving(folder, params) as running:
        yield running


@pytest.fixture
def own_map(folder, tmp_path) -> pathlib.Path:
    """A map that a test may change."""
    return shutil.copytree(folder, tmp_path / "own.map")


@pytest.fixture(scope="session")
def pictures(sides) -> list[pathlib.Path]:
    """The town's queries."""
    return sorted(sides[1].iterdir())
