"""The HTTP interface: routes, limits, and what every answer carries."""

import asyncio
import base64
import contextlib
import dataclasses
import hashlib
import importlib.resources
import json
import re
import sys
import time
from typing import Annotated, Any

import fastapi
import starlette.datastructures
import starlette.exceptions
import starlette.requests
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from crisalad_jax.data.images import IMAGE_SUFFIXES
from crisalad_jax.data.positions import AXES, MOST_METRES, Positions, utm_positions
from crisalad_jax.serve.access import Access, RefusedError
from crisalad_jax.serve.service import MapService
from crisalad_jax.serve.worker import MapFailedError, NameTakenError
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.version import VERSION

MOST_ANSWERS = 100
"""Largest k."""
MOST_WAITING = 128
"""Number of requests whose pictures are decoded or described at once."""
_UPLOADS = 2
"""Number of pictures that may be arriving at once, in `most_waiting`."""
_PATIENCE = 60.0
"""Seconds in which a picture has to arrive."""
_FIELDS = 10
"""Number of files, and of fields, that are read of a form."""
_RETRY = {"Retry-After": "1"}


@dataclasses.dataclass(frozen=True)
class Neighbour:
    """An image of the map."""

    rank: int
    """From 1, the most similar."""
    name: str
    similarity: float
    """Cosine of the two descriptors."""
    position: dict[str, float] | None
    """east and north, or x and y, in metres, or lat and lon in degrees."""
    number: int
    """Its picture is at /images/{number}."""


@dataclasses.dataclass(frozen=True)
class Located:
    """The most similar images of the map, best first."""

    neighbours: list[Neighbour]
    known: bool | None
    """Whether the picture shows a place of the map, as far as the map is calibrated; else null."""
    latency_ms: float
    """From the last byte of the picture to the answer."""


@dataclasses.dataclass(frozen=True)
class Appended:
    """An image that the map has from now on."""

    number: int
    name: str
    position: dict[str, float] | None
    images: int
    """Number of images of the map."""
    latency_ms: float


@dataclasses.dataclass(frozen=True)
class Health:
    """What runs."""

    status: str
    images: int
    model: str
    """Digest of the model that made the map."""
    search: str
    """exact, hnsw or ivf-pq."""
    stale_search: str | None
    """An approximate search that is not used, for it lacks images; build it anew. Else null."""
    uptime_s: float


@dataclasses.dataclass(frozen=True)
class Places:
    """The map, for a page that draws it."""

    name: str
    images: int
    axes: tuple[str, str] | None
    zone: str | None
    positions: list[tuple[int, float, float]]
    """(number, position), evenly chosen where there are many."""
    positions_known: int
    appends: bool
    k: int
    max_bytes: int


@dataclasses.dataclass(frozen=True)
class Problem:
    """Why a request was not answered."""

    error: str


_PICTURE = {"type": "string", "format": "binary"}
_BODY = {
    "requestBody": {
        "required": True,
        "description": f"The bytes of an image file ({' '.join(IMAGE_SUFFIXES)}), or a form with "
        "`image`.",
        "content": {
            "image/*": {"schema": _PICTURE},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["image"],
                    "properties": {"image": _PICTURE},
                }
            },
        },
    }
}
_OF_ALL: dict[int | str, dict[str, Any]] = {
    400: {"model": Problem, "description": "An unknown parameter"},
    401: {"model": Problem, "description": "No token, or another one"},
    421: {"model": Problem, "description": "A Host of another machine, where there is no token"},
}
_PROBLEMS = _OF_ALL | {
    400: {"model": Problem, "description": "No picture, or an argument unknown or out of range"},
    403: {"model": Problem, "description": "A page of another site, or a map that is only read"},
    408: {"model": Problem, "description": "A picture that takes too long to arrive"},
    413: {"model": Problem, "description": "More bytes than the service takes"},
    500: {"model": Problem, "description": "The map or the model failed"},
    503: {"model": Problem, "description": "Too many requests wait; try again"},
}


class _Json(JSONResponse):
    """JSON in ASCII: a name may hold what no UTF-8 has."""

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False).encode("ascii")


def make_app(
    service: MapService,
    access: Access,
    *,
    k: int = 5,
    max_bytes: int = 20 * 2**20,
    most_waiting: int = MOST_WAITING,
) -> ASGIApp:
    """Make the application that answers for a map.

    Args:
        service: what it answers.
        access: who may ask.
        k: answers to a picture where the request names no number.
        max_bytes: largest body of a request.
        most_waiting: number of requests with a picture at once; more are told to come again.

    Returns:
        An ASGI application.
    """
    app = fastapi.FastAPI(
        title="crisalad serve",
        description="Where was this photograph taken? Asks a map of crisalad-jax.",
        version=VERSION,
        docs_url=None,  # FastAPI's page loads scripts from another server
        redoc_url=None,
        openapi_url=None,  # FastAPI's route takes any parameters
        default_response_class=_Json,
        dependencies=[fastapi.Depends(_refuse_unknown)],
    )
    room = _Room(most_waiting)
    # Apart, so that clients who stop in the middle of a picture keep no whole ones waiting.
    uploads = _Room(_UPLOADS * most_waiting)
    _handle_errors(app)
    page = importlib.resources.files("crisalad_jax.serve").joinpath("page.html").read_bytes()
    page = page.replace(b"IMAGE_SUFFIXES", ",".join(IMAGE_SUFFIXES).encode())

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    async def show_page() -> Response:
        return HTMLResponse(page)

    @app.get("/openapi.json", include_in_schema=False)
    async def describe_interface() -> Response:
        return JSONResponse(app.openapi())

    @app.get("/health", responses={status: _OF_ALL[status] for status in (400, 421)})
    async def health() -> Health:
        """Tell that the service runs, of which model, how it searches, and since when."""
        return Health(**service.health())

    @app.get("/map", responses=_OF_ALL)
    def describe_map() -> Places:
        """Tell how large the map is, and where its images were taken."""
        return Places(**service.map_fields(), k=k, max_bytes=max_bytes)

    @app.get(
        "/images/{number}",
        response_class=Response,
        responses=_OF_ALL
        | {
            200: {"content": {"image/jpeg": {}}, "description": "A small JPEG"},
            400: {"model": Problem, "description": "No number, or an unknown parameter"},
            404: {"model": Problem, "description": "No such image, or its file is gone"},
        },
    )
    async def show_image(number: int) -> Response:
        """Show an image of the map."""
        try:
            data = await service.thumbnail(number)
        except InputError as error:
            raise RefusedError(404, str(error)) from error
        return Response(data, media_type="image/jpeg", headers={"Cache-Control": "private"})

    @app.post("/locate", responses=_PROBLEMS, openapi_extra=_BODY)
    async def locate(
        request: fastapi.Request,
        k: Annotated[int, fastapi.Query(ge=1, le=MOST_ANSWERS)] = k,
    ) -> Located:
        """Find the most similar images of the map to a picture."""
        with uploads.taken():
            data, name = await _picture(request, max_bytes)
        with room.taken():
            start = time.perf_counter()
            found, known = await service.locate(data, name, k)
        return Located([Neighbour(**each) for each in found], known, _milliseconds(start))

    @app.post(
        "/images",
        status_code=201,
        responses=_PROBLEMS | {409: {"model": Problem, "description": "The name is taken"}},
        openapi_extra=_BODY,
    )
    async def append(
        request: fastapi.Request,
        name: str,
        lat: Annotated[float | None, fastapi.Query(ge=-90, le=90)] = None,
        lon: Annotated[float | None, fastapi.Query(ge=-180, le=180)] = None,
        east: Annotated[float | None, fastapi.Query(ge=-MOST_METRES, le=MOST_METRES)] = None,
        north: Annotated[float | None, fastapi.Query(ge=-MOST_METRES, le=MOST_METRES)] = None,
        x: Annotated[float | None, fastapi.Query(ge=-MOST_METRES, le=MOST_METRES)] = None,
        y: Annotated[float | None, fastapi.Query(ge=-MOST_METRES, le=MOST_METRES)] = None,
    ) -> Appended:
        """Append a picture to the map, for good; answers see it from then on."""
        if not service.appends:
            raise RefusedError(403, "images: found a map that is only read, expected --append")
        position = _position(name, (east, north), (lat, lon), (x, y))
        with uploads.taken():
            data, _ = await _picture(request, max_bytes)
        with room.taken():
            start = time.perf_counter()
            fields = await service.append(data, name, position)
        return Appended(**fields, latency_ms=_milliseconds(start))

    _leave_out_unused(app)
    return _Gate(app, access, page)


def _leave_out_unused(app: fastapi.FastAPI) -> None:
    """Take out of the description of the interface what FastAPI adds and is never answered."""
    described = app.openapi()  # is kept, and served from now on
    for path in described["paths"].values():
        for operation in path.values():
            operation["responses"].pop("422", None)  # such is answered with 400
    for name in ("HTTPValidationError", "ValidationError"):
        described["components"]["schemas"].pop(name, None)


async def _refuse_unknown(request: fastapi.Request) -> None:
    """Refuse a request with a parameter that its route does not have."""
    known = _parameters(request)
    for name in request.query_params:
        if name not in known:
            expected = ", ".join(known) or "none"
            raise RefusedError(400, f"{name}: found an unknown parameter, expected {expected}")


def _parameters(request: fastapi.Request) -> list[str]:
    """Return the names of the parameters in the URL that a request's route has."""
    return [field.alias for field in request.scope["route"].dependant.query_params]


class _Room:
    """Room for a number of requests; more are refused."""

    def __init__(self, most: int) -> None:
        self._free = most

    @contextlib.contextmanager
    def taken(self) -> Any:
        """Take a place while the block runs, in the thread of the event loop."""
        if not self._free:
            raise RefusedError(503, "found too many requests that wait, try again", _RETRY)
        self._free -= 1
        try:
            yield
        finally:
            self._free += 1


async def _picture(request: fastapi.Request, limit: int) -> tuple[bytes, str]:
    """Read a picture and its name from a body, or from a form's field `image`."""
    data = await _body(request, limit)
    if not request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        return data, "image"

    async def receive() -> Message:
        return {"type": "http.request", "body": data, "more_body": False}

    copy = starlette.requests.Request(request.scope, receive)
    try:
        form = await copy.form(max_files=_FIELDS, max_fields=_FIELDS)
    except starlette.exceptions.HTTPException as error:
        raise RefusedError(
            400,
            f"image: found a form that cannot be read, or of more than {_FIELDS} files or fields, "
            "expected one with a file of this name",
        ) from error
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(form.close)
        files = [
            each
            for _, each in form.multi_items()
            if isinstance(each, starlette.datastructures.UploadFile)
        ]
        unknown = next((name for name in form if name != "image"), None)
        if unknown is not None:
            in_url = ", ".join(_parameters(request))
            raise RefusedError(
                400,
                f"{unknown}: found an unknown field of the form, expected image (in the URL "
                f"{in_url})",
            )
        image = form.get("image")
        if not isinstance(image, starlette.datastructures.UploadFile):
            raise RefusedError(400, "image: found no such file in the form, expected one")
        if len(files) > 1:
            raise RefusedError(400, f"image: found {len(files)} files in the form, expected one")
        return await image.read(), image.filename or "image"


async def _body(request: fastapi.Request, limit: int) -> bytes:
    too_large = RefusedError(413, f"image: found more than {limit} bytes, expected at most those")
    length = request.headers.get("content-length", "")
    if length.isdecimal() and int(length) > limit:
        raise too_large
    data = bytearray()
    try:
        async with asyncio.timeout(_PATIENCE):
            async for chunk in request.stream():
                data += chunk
                if len(data) > limit:
                    raise too_large
    except TimeoutError as error:
        raise RefusedError(408, f"image: found half of it after {_PATIENCE:g} seconds") from error
    return bytes(data)


def _position(name: str, *pairs: tuple[float | None, float | None]) -> Positions | None:
    """Return the position of a new image, by default what a name with @UTM says.

    The pairs are what the request says along each of `AXES`.
    """
    given = [
        Positions(axes, {name: (first, second)})
        for axes, (first, second) in zip(AXES, pairs, strict=True)
        if first is not None and second is not None
    ]
    if len(given) != 1 and any(each is not None for pair in pairs for each in pair):
        raise RefusedError(
            400, "position: expected east and north, or lat and lon, or x and y, or none of it"
        )
    if given:
        return given[0]
    said = utm_positions([name])
    return said if said.of else None


def _milliseconds(start: float) -> float:
    return round(1000 * (time.perf_counter() - start), 1)


def _problem(status: int, error: object, headers: dict[str, str] | None = None) -> Response:
    return _Json({"error": one_line(error)}, status, headers)


def _handle_errors(app: fastapi.FastAPI) -> None:
    """Answer every error with one line of JSON."""

    @app.exception_handler(RefusedError)
    async def refused(_: fastapi.Request, error: RefusedError) -> Response:
        return _problem(error.status, error, error.headers)

    @app.exception_handler(NameTakenError)
    async def taken(_: fastapi.Request, error: NameTakenError) -> Response:
        return _problem(409, error)

    @app.exception_handler(InputError)
    async def bad_input(_: fastapi.Request, error: InputError) -> Response:
        return _problem(400, error)

    @app.exception_handler(RequestValidationError)
    async def bad_argument(_: fastapi.Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        where, found = first["loc"][-1], first.get("input")
        said = f"found {found!r}, " if isinstance(found, str | int | float) else ""
        return _problem(400, f"{where}: {said}{first['msg'].lower()}")

    @app.exception_handler(starlette.exceptions.HTTPException)
    async def other(_: fastapi.Request, error: starlette.exceptions.HTTPException) -> Response:
        headers = dict(error.headers) if error.headers else None
        return _problem(error.status_code, error.detail, headers)

    @app.exception_handler(starlette.requests.ClientDisconnect)
    async def gone(_: fastapi.Request, error: starlette.requests.ClientDisconnect) -> Response:
        return _problem(400, "image: found half of it")

    # The client learns nothing of the machine; who runs the service sees why.
    @app.exception_handler(MapFailedError)
    async def failed(_: fastapi.Request, error: MapFailedError) -> Response:
        print(f"crisalad: {one_line(error)}", file=sys.stderr, flush=True)
        return _problem(500, "the map or the model failed; the service's terminal says why")

    @app.exception_handler(Exception)
    async def unforeseen(_: fastapi.Request, error: Exception) -> Response:
        return _problem(500, "the service failed; its terminal says why")


class _Gate:
    """Check who asks before anything is read, and add the headers that every answer carries.

    HEAD is answered as GET, without the body.
    """

    def __init__(self, app: ASGIApp, access: Access, page: bytes) -> None:
        self._app, self._access = app, access
        headers = {
            # The page holds its style and its script; nothing else runs in it.
            "Content-Security-Policy": (
                f"default-src 'none'; script-src {_hashes(page, b'script')}; style-src "
                f"{_hashes(page, b'style')}; img-src 'self' blob: data:; connect-src 'self'; "
                "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
            ),
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        self._headers = [(name.encode(), value.encode()) for name, value in headers.items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = message["headers"]
                message["headers"] = [*given, *self._headers]
                if not any(name.lower() == b"cache-control" for name, _ in given):
                    message["headers"].append((b"Cache-Control", b"no-store"))
            elif is_head and message["type"] == "http.response.body":
                message["body"] = b""
            await send(message)

        is_head = scope["method"] == "HEAD"
        headers = starlette.datastructures.Headers(scope=scope)
        try:
            self._access.check(scope["method"], scope["path"], headers)
        except RefusedError as error:
            answer = _problem(error.status, error, error.headers)
            await answer(scope, receive, send_with_headers)
            return
        if is_head:
            scope = {**scope, "method": "GET"}
        await self._app(scope, receive, send_with_headers)


def _hashes(page: bytes, tag: bytes) -> str:
    """Return the digests of a page's scripts or styles, as a policy lists them."""
    found = re.findall(b"<%b>(.*?)</%b>" % (tag, tag), page, re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(text).digest()).decode() for text in found)
    return " ".join(f"'sha256-{digest}'" for digest in digests)
