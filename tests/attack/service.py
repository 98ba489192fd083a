"""Attack a map that is served: half-open connections, appends that fail, pictures that take long.

python -m tests.attack.service --out rows.json [--scale 1] [--only half-open ...]
"""

import asyncio
import collections
import concurrent.futures
import contextlib
import http.client
import io
import json
import multiprocessing
import os
import pathlib
import random
import re
import resource
import shutil
import socket
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np
from PIL import Image

from tests.attack.world import ROOT, Attack, Bench, Row, carry_out, part_of, picture_bytes

LIMIT = 1.0
"""Seconds in which a probe has to be answered."""
CONNECTIONS, DESCRIPTORS = 1000, 64


class Service(NamedTuple):
    """A service in a process of its own."""

    port: int
    process: subprocess.Popen[bytes]
    folder: pathlib.Path
    log: pathlib.Path

    def ask(self, method: str, path: str, body: bytes | None = None) -> tuple[int, bytes]:
        """Return the status and the body of an answer; 0 and the reason where there is none."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        with contextlib.closing(connection):
            try:
                connection.request(method, path, body)
                answer = connection.getresponse()
                return answer.status, answer.read()
            except (OSError, http.client.HTTPException) as error:
                return 0, repr(error).encode()

    def raw(self, data: bytes) -> bytes:
        """Send bytes, and return all that comes back."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            connection.sendall(data)
            parts = iter(lambda: connection.recv(2**16), b"")
            try:
                return b"".join(parts)
            except OSError as error:
                return repr(error).encode()

    def peak(self) -> float:
        """Return the largest resident memory so far in megabytes."""
        status = pathlib.Path(f"/proc/{self.process.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+)", status)
        assert found
        return int(found[1]) / 1024

    def lines(self) -> int:
        """Return how many lines the service has printed."""
        return len(self.log.read_bytes().splitlines())


@contextlib.contextmanager
def served(
    bench: Bench, name: str, *, files: int = 1024, folder: pathlib.Path | None = None
) -> Iterator[Service]:
    """Serve a copy of the world's map, open for appending, with so many files open at most."""
    folder, log = folder or bench.folder / f"{name}.map", bench.folder / f"{name}.log"
    shutil.copytree(bench.world.path("map"), folder)
    command = ["sh", "-c", f'ulimit -n {files}; exec "$@"', "sh", sys.executable]
    command += ["-m", "crisalad_jax", "serve", "--map", str(folder), "--quiet"]
    environment = {**os.environ, **bench.environment}
    environment.pop("CRISALAD_TOKEN", None)
    with (
        log.open("wb") as file,
        subprocess.Popen(
            [*command, "--append", "--port", "0"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=file,
        ) as process,
    ):
        assert process.stdout
        try:
            found = re.match(rb"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
            assert found, log.read_text()
            yield Service(int(found[1]), process, folder, log)
        finally:
            process.terminate()


async def _hold(port: int, kind: int, end: float) -> None:
    """Keep a connection half open, and open it again a second after its end."""
    half_head = b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\nX-A: "
    half_body = b"POST /locate HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 999\r\n\r\nhalf"
    unread = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 400
    kind = 4 if kind % 50 == 0 else kind % 4
    first = (b"", half_head, half_head, half_body, unread)[kind]
    while (left := end - time.monotonic()) > 0:
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(left):
                reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**10)
                try:
                    writer.write(first)
                    while kind == 2:  # letter by letter
                        await asyncio.sleep(1)
                        writer.write(b"a")
                        await writer.drain()
                    if kind == 4:
                        await writer.wait_closed()
                    await reader.read()
                finally:
                    writer.transport.abort()
        await asyncio.sleep(1)


def _hold_all(port: int, end: float) -> None:
    async def hold() -> None:
        await asyncio.gather(*(_hold(port, kind, end) for kind in range(CONNECTIONS)))

    asyncio.run(hold())


def attack_connections(bench: Bench, scale: float) -> list[Row]:
    """Hold 1,000 connections half open against 64 descriptors, and ask meanwhile."""
    seconds = part_of(300, scale, least=3)
    row = Row(
        f"half-open connections: {CONNECTIONS:,} at {DESCRIPTORS} descriptors",
        f"every probe is answered within {LIMIT:g} s, and the log has less than 100 lines",
    )
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))

    apart = concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("fork"))
    with served(bench, "half-open", files=DESCRIPTORS) as service, apart as pool:
        end, slowest = time.monotonic() + seconds, 0.0
        held = pool.submit(_hold_all, service.port, end)
        while time.monotonic() < end:
            time.sleep(0.5)
            for path, body in (("/health", None), ("/locate?k=1", picture_bytes())):
                start = time.monotonic()
                status, words = service.ask("GET" if body is None else "POST", path, body)
                took = time.monotonic() - start
                slowest = max(slowest, took)
                row.note(status == 200 and took < LIMIT, f"{path}: {status} {words!r} {took:.1f} s")
        held.result()
        row.note(service.lines() < 100, f"{service.lines()} lines in the log")
    row.promise += f" (here {slowest:.2f} s at most)"
    return [row]


def noise(side: int, seed: int) -> bytes:
    """Return a PNG whose file is about as large as its pixels are many."""
    pixels = np.random.default_rng(seed).integers(0, 255, (side, side, 3), np.uint8)
    return cv2.imencode(".png", pixels)[1].tobytes()


def attack_appends(bench: Bench, scale: float) -> list[Row]:
    """Append images, some of which the disk refuses, while others ask; then take the map away."""
    count = part_of(500, scale, least=30)
    good = Row("served appends: good ones", "each is acknowledged, whatever becomes of others")
    bad = Row("served appends: that the disk refuses", "500, and nothing of it is left")
    asked = Row("served appends: questions meanwhile", "each is answered")
    long = Row("served appends: too long a path", "400")
    gone = Row("served appends: to a map that was moved", "500, health says 503, nothing is made")
    folder = pathlib.Path(*[bench.folder, *["d" * 200] * (3000 // 200)], "map")
    folder.parent.mkdir(parents=True)
    # Fewer than the map's files in the end.
    with served(bench, "appends", files=128, folder=folder) as service:
        resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
        small, large, path = noise(20, 0), noise(250, 0), "/".join(["a" * 190] * 5)
        rows = {"good": (good, 201), "bad": (bad, 500), "ask": (asked, 200), "long": (long, 400)}

        def one(number: int) -> tuple[str, int, bytes]:
            if number % 10 == 9:
                return "bad", *service.ask("POST", f"/images?name=bad/{number}.png", large)
            return "good", *service.ask("POST", f"/images?name=good/{number}.png", small)

        def beside(number: int) -> tuple[str, int, bytes]:
            if number % 10 == 9:
                return "long", *service.ask("POST", f"/images?name={number}/{path}", small)
            return "ask", *service.ask("POST", "/locate?k=100", small)

        work = [(call, number) for number in range(count) for call in (one, beside)]
        bench.random.shuffle(work)
        with concurrent.futures.ThreadPoolExecutor(32) as pool:
            for kind, status, words in pool.map(lambda each: each[0](each[1]), work):
                row, expected = rows[kind]
                row.note(status == expected, f"{kind}: {status} {words!r}")
        images = json.loads(service.ask("GET", "/health")[1])["images"]
        good.note(images == 8 + good.tries, f"{images} images, expected {8 + good.tries}")
        bad.note(not (folder / "added" / "bad").exists(), "a folder added/bad is left")
        moved = folder.with_name("moved")
        folder.rename(moved)
        for method, asks, status in (
            ("POST", "/images?name=late.png", 500),
            ("GET", "/health", 503),
            ("POST", "/locate", 500),
        ):
            found = service.ask(method, asks, small if method == "POST" else None)
            gone.note(found[0] == status, f"{asks}: {found}")
        gone.note(not folder.exists(), "the map's folder is there again")
        moved.rename(folder)
        found = service.ask("POST", "/images?name=back.png", small)
        gone.note(found[0] == 201, f"moved back: {found}")
    return [good, bad, asked, long, gone]


def _png(width: int, height: int, *, depth: int = 8, colour: int = 2, channels: int = 3) -> bytes:
    """Return a small file of a large black PNG."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    deflate, row = zlib.compressobj(9), bytes(1 + width * channels * depth // 8)
    data = b"".join(deflate.compress(row) for _ in range(height)) + deflate.flush()
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", data), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def _saved(width: int, height: int, kind: str, **options: Any) -> bytes:
    """Return a picture without content, as Pillow writes it."""
    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, kind, **options)
    return file.getvalue()


def _scans(width: int, height: int, count: int) -> bytes:
    """Return a JPEG with its last scan many times."""
    whole = _saved(width, height, "JPEG", progressive=True)
    last = whole.rfind(b"\xff\xda")
    return whole[:-2] + whole[last:-2] * count + whole[-2:]


def _bmp(width: int, height: int) -> bytes:
    """Return a BMP in run lengths that ends at once."""
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 1, 2, 0, 0, 256, 0)
    return b"BM" + struct.pack("<IHHI", 1178, 0, 0, 1078) + head + bytes(1024) + b"\0\1"


def _tile() -> bytes:
    """Return a small grey TIFF in a large tile."""
    data, side = zlib.compress(bytes(8192 * 8192), 9), 8192
    fields = {256: 8, 257: 8, 258: 8, 259: 8, 262: 1, 277: 1, 322: side, 323: side, 324: 8}
    pairs = sorted({**fields, 325: len(data)}.items())
    entries = b"".join(struct.pack("<HHII", field, 4, 1, value) for field, value in pairs)
    data += bytes(len(data) % 2)
    head = b"II*\0" + struct.pack("<I", 8 + len(data)) + data
    return head + struct.pack("<H", len(pairs)) + entries + bytes(4)


BOMBS: Mapping[str, tuple[int, Callable[[], bytes]]] = {
    "WebP of 16383 x 16383": (400, lambda: _saved(16383, 16383, "WEBP", lossless=True, method=0)),
    "PNG of 16384 x 16384": (400, lambda: _png(16384, 16384)),
    "BMP of 16000 x 16000": (400, lambda: _bmp(16000, 16000)),
    "PNG of 1,000,000 x 268": (400, lambda: _png(1_000_000, 268)),
    "JPEG of 300 scans": (400, lambda: _scans(8000, 8000, 300)),
    "small JPEG of 300 scans": (400, lambda: _scans(1000, 1000, 300)),
    "Radiance": (400, lambda: cv2.imencode(".hdr", np.ones((9, 9, 3), np.float32))[1].tobytes()),
    "Sun raster": (400, lambda: cv2.imencode(".ras", np.ones((9, 9, 3), np.uint8))[1].tobytes()),
    "PNG of 8000 x 8000": (200, lambda: _png(8000, 8000)),
    "PNG of 8000 x 8000, 16 bits": (200, lambda: _png(8000, 8000, depth=16, colour=6, channels=4)),
    "WebP of 8000 x 8000": (200, lambda: _saved(8000, 8000, "WEBP", lossless=True, method=0)),
    "BMP of 8000 x 8000": (200, lambda: _bmp(8000, 8000)),
    "TIFF of 8000 x 8000": (200, lambda: _saved(8000, 8000, "TIFF", compression="tiff_deflate")),
    "JPEG 2000 of 8000 x 8000": (200, lambda: _saved(8000, 8000, "JPEG2000")),
    "AVIF of 8000 x 8000": (200, lambda: _saved(8000, 8000, "AVIF", speed=10)),
    "PNG of 1400 x 1400, 16 bits": (200, lambda: _png(1400, 1400, depth=16, colour=6, channels=4)),
    "TIFF of 8 x 8 in a tile of 8192 x 8192": (200, _tile),
    "progressive JPEG of 8000 x 8000": (200, lambda: _scans(8000, 8000, 0)),
}
"""Small files of pictures that take long to decode, and whether they are."""
MEMORY = 1500
"""Megabytes that the service takes at most for that, beyond its start."""


def attack_pictures(bench: Bench, scale: float) -> list[Row]:
    """Ask with pictures that take long to decode, alone and many at once."""
    alone = Row(
        "served pictures that take long: one at a time",
        f"answered, or 400 within {LIMIT:g} s; in less than {MEMORY:,} MB beyond the start",
    )
    beside = Row(
        "served pictures that take long: a query with 12 of each kind",
        f"it is answered within {3 * LIMIT:g} s",
    )
    names = [name for name, (status, _) in BOMBS.items() if scale >= 1 or status == 400]
    with served(bench, "pictures") as service:
        small, started = picture_bytes(), service.peak()
        for name in names:
            expected, make = BOMBS[name]
            bomb, start = make(), time.monotonic()
            status, words = service.ask("POST", "/locate?k=1", bomb)
            took = time.monotonic() - start
            bench.say(f"{name}: {len(bomb)} bytes, {status}, {took:.1f} s, {service.peak():.0f} MB")
            right = status == expected and (status == 200 or took < LIMIT)
            right = right and service.peak() - started < MEMORY
            alone.note(right, f"{name}: {status} {words!r}, {took:.1f} s, {service.peak():.0f} MB")
            if scale < 1:
                continue
            with concurrent.futures.ThreadPoolExecutor(12) as pool:
                bombs = [pool.submit(service.ask, "POST", "/locate?k=1", bomb) for _ in range(12)]
                time.sleep(0.3)
                start = time.monotonic()
                status, words = service.ask("POST", "/locate?k=1", small)
                took = time.monotonic() - start
                bench.say(f"    a question beside 12: {took:.2f} s")
                beside.note(status == 200 and took < 3 * LIMIT, f"{name}: {status}, {took:.1f} s")
                found = collections.Counter(bomb.result()[0] for bomb in bombs)
                beside.note(set(found) == {expected}, f"{name}: {found}")
            alone.note(service.peak() - started < MEMORY, f"12 of {name}: {service.peak():.0f} MB")
    return [alone, beside] if scale >= 1 else [alone]


NAMES = {
    "two": "a.png&name=b.png",
    "no UTF-8": "%ff%fe.png",
    "499 levels": "/".join("a" * 499),
    "a frame of a video": quote("walk.mp4#t=12.5"),
    "hidden": ".a.png",
    "upwards": "../a.png",
    "absolute": "/a.png",
    "a control character": "a%1b[2Jb.png",
    "turned letters": quote("a\u202egnp.exe"),
    "too long": "a" * 201,
}
HOSTS = (
    *("evil.com@127.0.0.1", "[::1].evil.com", "127.0.0.1.evil.com", "evil.com", "", "[", "a@[::1"),
    *("127.0.0.1:x", "127.0.0.1:", "localhost:80@evil.com", "[::1]:8000.evil.com", "localhost."),
)


def attack_requests(bench: Bench, scale: float) -> list[Row]:
    """Send names, hosts and bytes that are none."""
    names = Row("served requests: names of new images", "400 in one line of JSON")
    hosts = Row("served requests: other hosts", "400 in one line of JSON")
    garbage = Row("served requests: what is not HTTP", "400 in one line of JSON, no traceback")
    paths = Row("served requests: a slash too many", "404, no redirect by the Host")
    generator = random.Random(bench.seed)

    def is_problem(status: int, data: bytes) -> bool:
        return status == 400 and set(json.loads(data)) == {"error"}

    with served(bench, "requests") as service:
        for name, text in NAMES.items():
            status, words = service.ask("POST", f"/images?name={text}", picture_bytes())
            names.note(is_problem(status, words), f"{name}: {status} {words!r}")
        for path in ("/map/", "/health/", "/locate/", "/images/0/"):
            status, _ = service.ask("GET", path)
            paths.note(status == 404, f"{path}: {status}")
        lines = [b"GET /health HTTP/1.1", b"Host: %s", b"Connection: close", b"", b""]
        for host in HOSTS:
            head, _, data = service.raw(b"\r\n".join(lines) % host.encode()).partition(b"\r\n\r\n")
            right = is_problem(int(head.split()[1]), data)
            hosts.note(right, f"{host}: {head} {data}")
        for number in range(part_of(200, scale, least=10)):
            request = bytearray(b"\r\n".join(lines) % b"127.0.0.1")
            at = generator.randrange(len(request) - 4)
            request[at : at + 1] = generator.randbytes(number % 3)
            head, _, data = service.raw(bytes(request) + b"\r\n\r\n").partition(b"\r\n\r\n")
            status = int(head.split()[1]) if head.startswith(b"HTTP/1.1 ") else 0
            right = status in (200, 404, 405, 501) or is_problem(status, data)
            garbage.note(right, f"{bytes(request)}: {head} {data}")
        garbage.note(service.lines() < 3, f"the log: {service.log.read_text()[-500:]}")
    return [names, hosts, paths, garbage]


ATTACKS: Mapping[str, Attack] = {
    "half-open": attack_connections,
    "appends": attack_appends,
    "pictures": attack_pictures,
    "requests": attack_requests,
}

if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
