"""The HTTP interface of a served map: routes, access control, and errors as JSON."""

import asyncio
import base64
import collections
import contextlib
import dataclasses
import functools
import hashlib
import io
import itertools
import math
import os
import pathlib
import re
import secrets
import sys
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any

import fastapi
import numpy as np
import pydantic
from fastapi import Query
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic_core import PydanticCustomError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Receive, Scope, Send

from crisalad_jax.config.checks import require
from crisalad_jax.data.images import IMAGE_SUFFIXES, decode_image
from crisalad_jax.data.positions import AXES, MOST_METRES, Positions, exif_position, utm_positions
from crisalad_jax.data.resize import Pixels
from crisalad_jax.data.tables import number_of
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.retrieval.maps.map import Answer, Map
from crisalad_jax.retrieval.maps.query import answer_fields, asked_thresholds, position_fields
from crisalad_jax.retrieval.maps.verified import verify_answers
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.retrieval.serve.pictures import (
    check_new_name,
    check_picture,
    image_in,
    read_thumbnail,
    receive_picture,
)
from crisalad_jax.retrieval.serve.tiles import Tiles
from crisalad_jax.retrieval.serve.worker import (
    Addition,
    MapFailedError,
    MapWorker,
    NameTakenError,
    Question,
)
from crisalad_jax.retrieval.verification.results import Verification
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.output import one_line, printable
from crisalad_jax.utils.version import VERSION

MOST_ANSWERS = 100
"""Maximum number of answers to a picture."""
MOST_PIXELS = 2**26
"""Default maximum number of pixels in a picture; the highest setting of some phones exceeds it."""
_LANES = ((2**21, 4), (2**24, 1), (math.inf, 1))
"""Maximum pixels of a picture, and how many such pictures are decoded at once: large ones, which
take seconds each, do not hold up small ones."""
_THUMBNAILS = 512
"""Number of cached thumbnails, about 30 kB each."""
_DOTS = 4000
"""Maximum number of places that the page draws."""
FAILED = "the map or the model failed; the service's terminal says why"
_LOCAL = ("localhost", "127.0.0.1", "[::1]")

_FILE = pathlib.Path(__file__).with_name("page.html")
PAGE = _FILE.read_text("utf-8").replace("IMAGE_SUFFIXES", ",".join(IMAGE_SUFFIXES))


def _hash(tag: str) -> str:
    """Return the digest of the page's script or style, for the content security policy."""
    text = PAGE.partition(f"<{tag}>")[2].partition(f"</{tag}>")[0]
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def headers(tiles: Tiles | None = None) -> dict[str, str]:
    """Return the HTTP headers of every response, which allow the page to load `tiles`."""
    return {
        # The page holds its style and its script; nothing else runs in it.
        "Content-Security-Policy": (
            f"default-src 'none'; script-src {_hash('script')}; style-src {_hash('style')}; "
            f"img-src 'self' blob: data:{f' {tiles.origin}' if tiles else ''}; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        ),
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        # OpenStreetMap's servers refuse browsers that do not send a referrer.
        "Referrer-Policy": "strict-origin" if tiles else "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


@dataclasses.dataclass(frozen=True)
class Verified:
    """How well the local features of the picture match an answer."""

    inliers: int
    matches: int
    confidence: float
    """From 0 to 1; at 1, the picture and the answer count as views of one scene."""


@dataclasses.dataclass(frozen=True)
class Neighbour:
    """An image of the map, as an answer to a picture."""

    rank: int
    """Rank from 1, the best answer."""
    name: str
    similarity: float
    """Cosine of the descriptors of the picture and the image."""
    position: dict[str, float] | None
    """east and north, or x and y, in metres; or lat and lon in degrees; null if unknown."""
    number: int
    """The image's thumbnail is at /images/{number}, even after other images are removed."""
    verified: Verified | None = None
    """Verification, for the first answers if the service verifies them; otherwise null."""


@dataclasses.dataclass(frozen=True)
class Located:
    """The most similar images of the map, best first."""

    neighbours: list[Neighbour]
    known: bool | None
    """Whether the picture shows a place of the map, if the map is calibrated; otherwise null."""
    latency_ms: float
    """Milliseconds from the last byte of the picture to the answer."""


@dataclasses.dataclass(frozen=True)
class Appended:
    """An image that was appended to the map."""

    number: int
    name: str
    position: dict[str, float] | None
    images: int
    """Number of images in the map, including this one."""
    latency_ms: float


@dataclasses.dataclass(frozen=True)
class Health:
    """The status of the service."""

    status: str
    images: int
    model: str
    """Digest of the model that made the map."""
    search: str
    """How the map is searched: exact, hnsw, ivf-rabitq, or with Milvus also diskann."""
    stale_search: str | None
    """Kind of an approximate search built for other images, so unused; null if there is none."""
    uptime_s: float


@dataclasses.dataclass(frozen=True)
class Places:
    """A map and the positions of its images, for a page that draws them."""

    name: str
    images: int
    axes: tuple[str, str] | None
    zone: str | None
    positions: list[tuple[int, float, float]]
    """(number, first coordinate, second) of images with a position; a sample if there are many."""
    positions_known: int
    appends: bool
    k: int
    max_bytes: int
    tiles: Tiles | None
    """Street map tiles that the page draws behind the positions; null for none."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """Why a request failed."""

    error: str


class _NoParameters(pydantic.BaseModel, extra="forbid"):
    """A route without parameters in its URL."""


class _Asked(pydantic.BaseModel, extra="forbid"):
    k: int | None = pydantic.Field(None, ge=1, le=MOST_ANSWERS)
    """Number of answers; by default the service's, see /map."""
    verify: int | None = pydantic.Field(None, ge=0, le=MOST_ANSWERS)
    """Number of best answers to verify; by default the service's, from --rerank."""
    where: str | None = None
    """Conditions on the images that are searched, as in `crisalad query --where`."""


def _plain(text: str) -> str:
    """Refuse text that is not a plain number: pydantic, too, reads 1_0 as 10."""
    if math.isnan(number_of(text)):
        raise PydanticCustomError("number", "expected a number")
    return text


_Number = Annotated[float | None, pydantic.BeforeValidator(_plain)]
_Metres = Annotated[_Number, pydantic.Field(ge=-MOST_METRES, le=MOST_METRES)]


class _NewImage(pydantic.BaseModel, extra="forbid"):
    """The name of an image, and where it was taken, along one of `AXES`."""

    name: str
    east: _Metres = None
    north: _Metres = None
    lat: _Number = pydantic.Field(None, ge=-90, le=90)
    lon: _Number = pydantic.Field(None, ge=-180, le=180)
    x: _Metres = None
    y: _Metres = None

    def position(self) -> Positions | None:
        """Return the given position, or by default the one in a name with @UTM."""
        given = self.model_dump(exclude={"name"}, exclude_none=True)
        if not given:
            named = utm_positions([self.name])
            return named if named.of else None
        axes: Any = tuple(given)
        if axes not in AXES:
            pairs = ", or ".join(" and ".join(pair) for pair in AXES)
            raise InputError(f"position: found {', '.join(axes)}, expected {pairs}, or none")
        return Positions(axes, {self.name: tuple(given.values())})


_Nothing = Annotated[_NoParameters, Query()]
_PICTURE = {"type": "string", "format": "binary"}
_FORM = {"type": "object", "required": ["image"], "properties": {"image": _PICTURE}}
_BODY = {
    "requestBody": {
        "required": True,
        "description": f"The bytes of an image file ({' '.join(IMAGE_SUFFIXES)}), or a form with "
        "`image`.",
        "content": {"image/*": {"schema": _PICTURE}, "multipart/form-data": {"schema": _FORM}},
    }
}
_PROBLEM: dict[int | str, dict[str, Any]] = {
    "default": {"model": Problem, "description": "The reason for the missing answer, in one line"}
}
_Bearer = Annotated[
    HTTPAuthorizationCredentials | None, fastapi.Depends(HTTPBearer(auto_error=False))
]


def make_app(
    worker: MapWorker,
    *,
    host: str = "127.0.0.1",
    token: str | None = None,
    appends: bool = False,
    map_images: str | os.PathLike[str] | None = None,
    k: int = 5,
    max_bytes: int = 20 * 2**20,
    max_pixels: int = MOST_PIXELS,
    most_waiting: int = 128,
    tiles: Tiles | None = None,
    rerank: Verify | None = None,
) -> ASGIApp:
    """Create the application that serves a map.

    Args:
        worker: the worker of the map.
        host: name or address of the service; without a token, requests must name it or localhost.
        token: the token that requests must send; None requires none.
        appends: whether requests may append images; the map must then be open for appending.
        map_images: folder of the map's images; None is the one from which they were indexed.
        k: default number of answers to a picture.
        max_bytes: maximum size of a request body.
        max_pixels: maximum pixels of a picture in a request.
        most_waiting: maximum number of requests with a picture at once; others get status 503.
        tiles: street map tiles that the page draws behind the positions; None for none.
        rerank: how to verify the best answers by local features; None for no verification.

    Returns:
        An ASGI application.
    """
    since = time.monotonic()
    cores = usable_cores()
    lanes = [(most, ThreadPoolExecutor(min(cores, count), "decode")) for most, count in _LANES]
    shown = ThreadPoolExecutor(min(cores, 2), "thumbnails")
    checking = ThreadPoolExecutor(1, "verify")
    verifier = None if rerank is None else Verifier(rerank)
    thumbnail = functools.lru_cache(_THUMBNAILS)(read_thumbnail)
    # Cached with and without verification: a calibration of inliers is read from a file.
    thresholds = functools.lru_cache(2)(asked_thresholds)
    waiting = asyncio.Semaphore(most_waiting)

    async def check_access(request: Request, given: _Bearer) -> None:
        """Require the token if there is one; otherwise refuse pages of other sites."""
        if token is not None:
            brought = "" if given is None else given.credentials
            if not secrets.compare_digest(brought.encode(), token.encode()):
                reason = "Authorization: expected 'Bearer' and the token of this service"
                raise HTTPException(401, reason, {"WWW-Authenticate": "Bearer"})
        elif request.method == "POST":
            origin, own = request.headers.get("origin"), f"http://{request.headers['host']}"
            if origin not in (None, own):
                raise HTTPException(403, f"Origin: found {origin!r}, expected {own}")

    async def prepare(data: bytes, name: str) -> Pixels:
        def decode() -> Pixels:
            return prepare_image(decode_image(data, name), worker.places.config, name)

        pixels = await asyncio.to_thread(check_picture, data, name, max_pixels)
        lane = next(lane for most, lane in lanes if pixels <= most)
        return await asyncio.wrap_future(lane.submit(decode))

    app = fastapi.FastAPI(
        title="crisalad serve",
        description="Where was this photograph taken? Asks a map of crisalad-jax.",
        version=VERSION,
        docs_url=None,  # FastAPI's page loads scripts from another server
        redoc_url=None,
        redirect_slashes=False,  # the address would be the client's Host
        dependencies=[fastapi.Depends(_check_parameters)],
        responses=_PROBLEM,
        exception_handlers=dict.fromkeys((*_CLIENTS, MapFailedError, Exception), _answer_error),
    )
    names = "|".join(map(re.escape, (*_LOCAL, bracketed(host))))
    own_host = re.compile(rf"({names})(:\d+)?" if token is None else ".*", re.IGNORECASE)
    guarded = fastapi.APIRouter(dependencies=[fastapi.Depends(check_access)])

    @app.get("/", include_in_schema=False)
    async def show_page(_: _Nothing) -> HTMLResponse:
        return HTMLResponse(PAGE)

    @app.get("/health")
    async def health(_: _Nothing) -> Health:
        """Report the status of the service, its model, its search and its uptime."""
        places = worker.places
        if not places.exists:
            raise HTTPException(503, FAILED)
        return Health(
            status="ok",
            images=len(places),
            model=places.metadata.model,
            search=places.search_kind,
            stale_search=places.stale_search,
            uptime_s=round(time.monotonic() - since, 1),
        )

    @guarded.get("/map")
    def describe_map(_: _Nothing) -> Places:
        """Return the size of the map, and where its images were taken."""
        places = worker.places
        positions, rows = places.images.positions, places.removed.rows_of(np.arange(len(places)))
        known = rows[~np.isnan(positions[rows, 0])]
        shown = known[:: -(-len(known) // _DOTS) or 1]
        return Places(
            name=printable(places.folder.resolve().name),
            images=len(places),
            axes=places.axes,
            zone=None if places.zone is None else str(places.zone),
            positions=[(row, *positions[row].tolist()) for row in shown.tolist()],
            positions_known=len(known),
            appends=appends,
            k=k,
            max_bytes=max_bytes,
            # A map opened without positions may have got some that tiles cannot show.
            tiles=tiles if places.axes == AXES[1] or places.zone else None,
        )

    @guarded.get(
        "/images/{number}",
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}}, "description": "A small JPEG"}},
    )
    async def show_image(number: int, _: _Nothing) -> Response:
        """Show an image of the map."""
        try:
            places = worker.places
            image = image_in(places, number), places.folder, map_images
            data = await asyncio.wrap_future(shown.submit(thumbnail, *image))
        except InputError as error:
            raise HTTPException(404, str(error)) from error
        return Response(data, media_type="image/jpeg")

    @guarded.post("/locate", openapi_extra=_BODY)
    async def locate(request: Request, asked: Annotated[_Asked, Query()]) -> Located:
        """Find the images of the map that are most similar to a picture."""
        data, name = await receive_picture(request, max_bytes)
        async with _room(waiting):
            start = time.perf_counter()
            answers, count = asked.k or k, asked.verify
            if count is None:
                count = 0 if rerank is None else rerank.answers
            if count and verifier is None:
                raise InputError("verify: found in a service without --rerank, expected none")
            where = None if asked.where is None else Where.parse(asked.where)
            question = Question(await prepare(data, name), max(answers, count), where)
            places, found = await asyncio.wrap_future(worker.submit(question))
            best, checks = found[0][1], []
            if verifier and count:
                given = verifier, decode_image(data, name), places, found, count
                found, checks = await asyncio.wrap_future(checking.submit(_verified, *given))
        pairs = itertools.zip_longest(found[:answers], checks[:answers])
        neighbours = [
            Neighbour(
                **answer_fields(Answer(rank, similarity, places.images[number]), places.axes),
                number=_row(places, number),
                verified=check and Verified(check.inliers, check.matches, check.confidence),
            )
            for rank, ((number, similarity), check) in enumerate(pairs, 1)
        ]
        least, inliers = thresholds(places, None, verifier if checks else None)
        known = None
        if (least, inliers) != (None, None):
            known = (least is None or best >= least) and (
                inliers is None or checks[0].inliers >= inliers
            )
        return Located(neighbours, known, _milliseconds(start))

    @guarded.post("/images", status_code=201, openapi_extra=_BODY)
    async def append(request: Request, asked: Annotated[_NewImage, Query()]) -> Appended:
        """Append a picture to the map permanently; answers include it from then on."""
        if not appends:
            raise HTTPException(403, "images: found a read-only map, expected --append")
        check_new_name(asked.name)
        position = asked.position()
        data, _ = await receive_picture(request, max_bytes)
        async with _room(waiting):
            start = time.perf_counter()
            pixels, places = await prepare(data, asked.name), worker.places
            # A map in other axes ignores the position in EXIF data, as `crisalad index` does.
            if position is None and places.axes in (None, AXES[1]):
                said = await asyncio.to_thread(exif_position, io.BytesIO(data))
                position = said and Positions(AXES[1], {asked.name: said})
            addition = Addition(pixels, data, asked.name, position)
            number = await asyncio.wrap_future(worker.submit(addition))
        there = position_fields(places.images[number], places.axes)
        row = _row(places, number)
        return Appended(row, asked.name, there, len(places), _milliseconds(start))

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        """Answer requests that name this host, and HEAD as GET: the server leaves out the body."""
        host = Headers(scope=scope).get("host", "")
        if not own_host.fullmatch(host):
            problem = {"error": f"Host: found {host!r}, expected this machine's, or a token"}
            await JSONResponse(problem, 400)(scope, receive, send)
            return
        method = "GET" if scope.get("method") == "HEAD" else scope.get("method")
        await app({**scope, "method": method}, receive, send)

    app.include_router(guarded)
    return answer


def _row(places: Map, number: int) -> int:
    return int(places.removed.rows_of(np.array(number)))


def _verified(
    verifier: Verifier, image: Any, places: Map, found: list[tuple[int, float]], count: int
) -> tuple[list[tuple[int, float]], list[Verification]]:
    """Verify the first answers, and reorder them."""
    first = found[:count]
    images, similarities = [places.images[number] for number, _ in first], [s for _, s in first]
    try:
        order, checks, _ = verify_answers(
            verifier, image, images, np.array(similarities, np.float32), places.axes
        )
    except InputError as error:  # about the map's files, which clients must not see
        raise MapFailedError(str(error)) from error
    return [*(first[i] for i in order), *found[count:]], checks


def _check_parameters(request: Request) -> None:
    """Check that no URL parameter is repeated, since only the last one would count."""
    counts = collections.Counter(name for name, _ in request.query_params.multi_items())
    for name, count in counts.items():
        require(count == 1, f"{name}: found it {count} times, expected it once")


def bracketed(host: str) -> str:
    """Return a host as it is written before a port: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


@contextlib.asynccontextmanager
async def _room(free: asyncio.Semaphore) -> AsyncIterator[None]:
    """Hold a slot while the block runs, or refuse the request."""
    if free.locked():
        reason = "found too many waiting requests, try again"
        raise HTTPException(503, reason, {"Retry-After": "1"})
    async with free:
        yield


def _milliseconds(start: float) -> float:
    return round(1000 * (time.perf_counter() - start), 1)


_CLIENTS = (HTTPException, RequestValidationError, InputError, ClientDisconnect)
"""Errors of a client; all others come from the map, the model or this service."""


async def _answer_error(_: Request, error: Exception) -> Response:
    """Answer any error with one line of JSON."""
    status, reason, headers = 400, str(error), None
    if isinstance(error, HTTPException):
        status, reason, headers = error.status_code, error.detail, error.headers
    elif isinstance(error, RequestValidationError):
        first = error.errors()[0]
        found = "" if first["type"] == "missing" else f"found {first['input']!r}, "
        reason = f"{first['loc'][-1]}: {found}{first['msg'].lower()}"
    elif isinstance(error, NameTakenError):
        status = 409
    elif not isinstance(error, _CLIENTS):
        # The client learns nothing about the machine; the operator sees the reason.
        print(f"crisalad: {one_line(error)}", file=sys.stderr, flush=True)
        status, reason = 500, FAILED
    return JSONResponse({"error": one_line(reason)}, status, headers)
