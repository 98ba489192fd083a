"""The server: open a map, compile its model, and answer requests until a signal stops it."""

import asyncio
import contextlib
import ipaddress
import logging
import math
import os
import pathlib
import socket
from collections.abc import Callable, Iterator
from typing import Any, Literal

import h11
import uvicorn
from starlette.responses import JSONResponse
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from crisalad_jax.checkpoints.engines import EngineName
from crisalad_jax.config.checks import check_count, require
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.serve.app import (
    MOST_ANSWERS,
    MOST_PIXELS,
    bracketed,
    headers,
    make_app,
)
from crisalad_jax.retrieval.serve.tiles import Tiles, open_tiles
from crisalad_jax.retrieval.serve.worker import MapWorker
from crisalad_jax.retrieval.verification.verify import Verify
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import most_files
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.signals import SignalState, defer_signals

# It would log a line for each incomplete form.
logging.getLogger("python_multipart").setLevel(logging.ERROR)
_GRACE = 30
"""Seconds after a signal until requests in flight are dropped."""
_HEAD, _EXCHANGE = 10, 120
"""Seconds for the head of a request to arrive; and for all of it, or for its answer to be read."""
_MOST_CONNECTIONS, _ACCEPTED, _QUEUE = 256, 2, 2048
"""Maximum number of connections open, accepted at once, and waiting in the kernel."""
_SHORTEST_TOKEN = 16


def serve_map(
    folder: str | os.PathLike[str],
    *,
    weights: str | os.PathLike[str] | None = None,
    engine: EngineName | Literal["jax", "auto"] = "auto",
    host: str = "127.0.0.1",
    port: int = 8000,
    token: str | None = None,
    k: int = 5,
    append: bool = False,
    map_images: str | os.PathLike[str] | None = None,
    max_bytes: int = 20 * 2**20,
    max_pixels: int = MOST_PIXELS,
    batch_size: int = 16,
    tiles: str | None = None,
    tiles_attribution: str | None = None,
    rerank: Verify | None = None,
    verify: bool = True,
    quiet: bool = False,
    ready: Callable[[str, str], object] = lambda address, engine: None,
) -> None:
    """Serve a map over HTTP, with a page for browsers, until a signal stops it.

    Requests in flight are answered before it stops; then the signal has its usual effect.

    Args:
        folder: folder of the map.
        weights: file of the model that made the map; None is the one that the map records.
        engine: "jax", "onnxruntime", "openvino", or "auto" for the choice of `Map.fastest_engine`.
        host: name or address to listen on. One that other machines can reach needs a token.
        port: port to listen on; 0 picks a free one.
        token: token that requests must send as `Authorization: Bearer ...`; None for no token.
        k: default number of answers to a picture.
        append: whether requests may add images to the map; other processes then cannot.
        map_images: folder of the map's images; None is the one from which they were indexed.
        max_bytes: maximum size of a request body.
        max_pixels: maximum pixels of a picture in a request.
        batch_size: maximum number of pictures described together, each independently.
        tiles: address of street map tiles, which browsers draw behind the map's places:
            https://tile.openstreetmap.org/{z}/{x}/{y}.png. None draws none.
        tiles_attribution: text shown with tiles; None is OpenStreetMap's for its tiles, else none.
        rerank: how to verify the best answers by local features; None for no verification.
        verify: whether to compare the map's descriptors with their checksums.
        quiet: whether to hide the progress bar.
        ready: called with (address, engine) once the service answers.

    Raises:
        InputError: a number is out of range; the address is not this machine's, is in use, or can
            be reached by others without a token; a folder is missing; there are tiles, but the map
            is in neither degrees nor a known UTM zone; `append` is set, and the model is not the
            map's; or `Map.open`, `Map.fastest_engine`, `Map.load_model` or `open_for_appending`
            fails.

    Example:
        >>> serve_map("city.map", host="0.0.0.0")
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: host: found '0.0.0.0', which other machines ...
    """
    check_count("batch size", batch_size)
    require(1 <= k <= MOST_ANSWERS, f"k: found {k}, expected 1 to {MOST_ANSWERS}")
    require(0 <= port < 2**16, f"port: found {port}, expected 0 to 65535")
    require(max_bytes >= 1, f"max_bytes: found {max_bytes}, expected at least 1")
    if map_images is not None and not pathlib.Path(map_images).is_dir():
        raise InputError(f"map_images: found no folder {map_images}, expected one")
    _check_access(host, token)
    with contextlib.ExitStack() as stack:
        # The outermost, so that the map is closed before a signal ends the process.
        stop = stack.enter_context(defer_signals())
        listener = stack.enter_context(contextlib.closing(_bound(host, port)))
        places = stack.enter_context(_opened(folder, append=append, verify=verify))
        behind = None if tiles is None else open_tiles(tiles, tiles_attribution, places)
        if engine == "auto":
            engine = places.fastest_engine(weights)
        places.load_model(weights, engine=engine, verify=verify)
        describer, expected = places.describer(), places.metadata.model
        if append and describer.digest != expected:  # int8 programs may query a map, not extend it
            found = f"model {describer.digest}"
            raise InputError(f"{weights}: found {found}, expected {expected} with append")
        worker = MapWorker(places, describer, batch_size=batch_size)
        stack.enter_context(contextlib.closing(worker))
        worker.compile(quiet=quiet)
        stop.check()
        stop.has_work = True
        access: dict[str, Any] = {"host": host, "token": token, "appends": append}
        limits = {"k": k, "max_bytes": max_bytes, "max_pixels": max_pixels}
        shown: dict[str, Any] = {"map_images": map_images, "tiles": behind, "rerank": rerank}
        app = make_app(worker, **access, **limits, **shown)
        address = f"http://{bracketed(host)}:{listener.getsockname()[1]}"
        Server(app, stop, lambda: ready(address, engine), behind).run([listener])


class _Connection(H11Protocol):
    """A connection that is closed if its client keeps the service waiting."""

    since = 0.0
    """When the client's time for its request began: on connecting, or after the last answer."""

    @property
    def patience(self) -> float:
        """Seconds that the client has for its turn; infinite while it is the service's turn."""
        if self.transport.get_write_buffer_size():
            return _EXCHANGE  # to read the answer
        if self.cycle is None or self.cycle.response_complete:
            return _HEAD
        return _EXCHANGE if self.cycle.more_body else math.inf

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection; if there are too many, close the one that has stalled longest."""
        super().connection_made(transport)
        self.since = self.loop.time()
        # The map, pictures and incoming connections need some of the other half.
        most = min(most_files() // 2, _MOST_CONNECTIONS)
        connections: set[Any] = self.connections
        if len(connections) > most:
            waiting = (each for each in connections if each.patience < math.inf)
            oldest = min(waiting, key=lambda each: each.since)
            connections.discard(oldest)
            oldest.transport.abort()
            warn(f"found more than {most} connections at once: closing those that wait longest")

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.since = self.loop.time()
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Answer invalid HTTP like all other errors, unless an answer has begun."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            answer = JSONResponse({"error": msg}, 400, {"Connection": "close"})
            headers = [*self.server_state.default_headers, *answer.raw_headers]
            for event in (
                h11.Response(status_code=400, headers=headers, reason=b"Bad Request"),
                h11.Data(data=bytes(answer.body)),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        if self.cycle is not None:
            self.cycle.disconnected = True  # its own answer would be a second one
        self.transport.close()


class Server(uvicorn.Server):
    """An HTTP server that stops on a signal, once `defer_signals` has recorded one."""

    def __init__(
        self,
        app: ASGIApp,
        stop: SignalState,
        ready: Callable[[], object],
        tiles: Tiles | None = None,
    ) -> None:
        """Set the application, the recorded signals, what to call once ready, and the tiles."""
        config = uvicorn.Config(
            app,
            loop="asyncio",  # uvloop would take the signals that `defer_signals` handles
            http=_Connection,
            ws="none",
            lifespan="off",
            log_level="error",  # a warning for each invalid request would fill a disk
            backlog=_ACCEPTED,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=_GRACE,
            headers=list(headers(tiles).items()),
        )
        super().__init__(config)
        self._stop, self._ready = stop, ready

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals to `defer_signals`."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening, and call `ready`."""
        await super().startup(sockets)
        # uvicorn has one number for both; accepting that many at once would use all descriptors.
        for listener in sockets or ():
            listener.listen(_QUEUE)
        self._ready()

    async def on_tick(self, counter: int) -> bool:
        """Drop slow clients, and return whether to stop; called ten times a second."""
        now = asyncio.get_running_loop().time()
        connections: tuple[Any, ...] = tuple(self.server_state.connections)
        for each in connections:
            if now > each.since + each.patience:
                each.transport.abort()
        return await super().on_tick(counter) or bool(self._stop.number)


@contextlib.contextmanager
def _opened(folder: str | os.PathLike[str], *, append: bool, verify: bool) -> Iterator[Map]:
    """Open an existing map for searching, or also for appending."""
    with Map.open(folder, verify=verify) as places:
        if not append:
            yield places
            return
        metadata, calibration = places.metadata, places.calibration
    with open_for_appending(folder, metadata) as places:
        places.calibration = calibration
        yield places


def _check_access(host: str, token: str | None) -> None:
    """Check that a service that other machines can reach has a token that is hard to guess."""
    if token is not None:
        if len(token) < _SHORTEST_TOKEN or not all("!" <= letter <= "~" for letter in token):
            raise InputError(
                f"token: found {len(token)} characters, expected at least {_SHORTEST_TOKEN}, in "
                "ASCII without spaces, as from `openssl rand -hex 16`"
            )
    elif not is_loopback(host):
        raise InputError(
            f"host: found {host!r}, which other machines can reach, and no token, expected "
            "--token-file or CRISALAD_TOKEN, or --host 127.0.0.1"
        )


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is a loopback one, out of reach for other machines."""
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _bound(host: str, port: int) -> socket.socket:
    """Bind a socket, which does not listen yet.

    Raises:
        InputError: the address is not this machine's, or in use.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family, kind, protocol)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(f"host and port: cannot listen at {host}:{port}: {error}") from error
    return bound
