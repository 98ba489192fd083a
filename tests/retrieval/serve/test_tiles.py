"""Tiles behind the page's map: addresses, the page's policy, and where a browser draws them."""

import contextlib
import http.server
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator

import cv2
import numpy as np
import pyproj
import pytest

from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import Positions
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.serve.app import headers
from crisalad_jax.retrieval.serve.tiles import Tiles, open_tiles
from crisalad_jax.utils.errors import InputError
from tests.retrieval.maps.test_stores import unit_rows
from tests.retrieval.maps.test_tracking import made, numbered
from tests.retrieval.serve.conftest import serving

OSM = "https://tile.openstreetmap.org/{z}/{x}/{y}.png"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WORLD = 2 * np.pi * 6_378_137
"""Side of Web Mercator's square in metres (EPSG:3857)."""


@pytest.mark.parametrize(
    ("url", "attribution", "origin", "words"),
    [
        (OSM, None, "https://tile.openstreetmap.org", "© OpenStreetMap contributors"),
        (OSM, "mine", "https://tile.openstreetmap.org", "mine"),
        ("http://t:8080/{x}/{y}/{z}?key=a", None, "http://t:8080", ""),
        ("https://a.notopenstreetmap.org/{z}{x}{y}", None, "https://a.notopenstreetmap.org", ""),
    ],
)
def test_addresses_of_tiles(folder, url, attribution, origin, words):
    with Map.open(folder) as places:
        tiles = open_tiles(url, attribution, places)
    assert (tiles.url, tiles.origin, tiles.attribution) == (url, origin, words)


@pytest.mark.parametrize(
    "url",
    [
        *("", "tile.example/{z}/{x}/{y}", "ftp://a/{z}/{x}/{y}", "https://a/{z}/{x}.png"),
        *("https://{s}.a/{z}/{x}/{y}", "https://a/{z}/{x}/{y}/{x}", "https://a/{x}/{x}/{y}"),
        *("https://a; script-src *//{z}/{x}/{y}", "https://a'/{z}/{x}/{y}", "https:///{z}/{x}/{y}"),
    ],
)
def test_addresses_that_are_refused(folder, url):
    with Map.open(folder) as places, pytest.raises(InputError, match=r"tiles: found .* expected"):
        open_tiles(url, None, places)


@pytest.mark.parametrize("axes", [("x", "y"), ("east", "north")])
def test_positions_that_no_tile_has(tmp_path, axes):
    positions = Positions(axes, {"0000.jpg": (1.0, 2.0)})
    with made(tmp_path, numbered(range(2)), unit_rows(2), positions) as places:
        words = f"tiles: found positions in {axes[0]}, {axes[1]} without a zone of UTM in"
        with pytest.raises(InputError, match=words):
            open_tiles(OSM, None, places)


def test_the_policy_allows_one_more_host():
    """And OpenStreetMap asks browsers to say whose page it is."""
    usual, tiled = headers(), headers(Tiles(OSM, "words"))
    policy = "Content-Security-Policy"
    assert "openstreetmap" not in usual[policy]
    allowed = "img-src 'self' blob: data: https://tile.openstreetmap.org;"
    assert tiled[policy] == usual[policy].replace("img-src 'self' blob: data:;", allowed)
    assert tiled[policy] != usual[policy]
    assert (usual["Referrer-Policy"], tiled["Referrer-Policy"]) == ("no-referrer", "strict-origin")
    assert {**tiled, policy: "", "Referrer-Policy": ""} == {
        **usual,
        policy: "",
        "Referrer-Policy": "",
    }


def test_the_map_names_its_tiles(folder, params, service):
    assert service.ask("GET", "/map").json["tiles"] is None
    with serving(folder, params, tiles=Tiles(OSM, "words")) as running:
        answer = running.ask("GET", "/map")
        assert answer.json["tiles"] == {"url": OSM, "attribution": "words"}
        assert "https://tile.openstreetmap.org" in answer.headers["content-security-policy"]


@contextlib.contextmanager
def tile_server() -> Iterator[tuple[str, list[tuple[str, str | None]]]]:
    """Serve one picture at every address; the address, and the paths and referrers asked."""
    asked: list[tuple[str, str | None]] = []
    picture = np.full((256, 256, 3), (200, 225, 205), np.uint8)
    cv2.rectangle(picture, (0, 0), (255, 255), (90, 120, 90), 2)
    data = cv2.imencode(".png", picture)[1].tobytes()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append((self.path, self.headers.get("Referer")))
            self.send_response(200)
            self.send_header("Content-Type", "image/png")
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}", asked
    server.shutdown()
    server.server_close()


def browsed(address: str, *more: str) -> str:
    """Open a page in a browser until it is at rest; its elements as text."""
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1100,700"]
    command += ["--virtual-time-budget=10000", *more, address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def attributes(tag: str, page: str) -> list[dict[str, str]]:
    found = re.findall(rf"<{tag} ([^>]*)>", page)
    return [dict(re.findall(r'([\w-]+)="([^"]*)"', each)) for each in found]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize("zone", [Zone(33, False), Zone(56, True), None])
def test_a_browser_draws_places_where_the_tiles_have_them(folder, params, tmp_path, zone):
    """Where the dots lie within the tiles, beside pyproj's Web Mercator."""
    code = 4326 if zone is None else 32_700 + zone.number if zone.south else 32_600 + zone.number
    generator = np.random.default_rng(2)
    to_mercator = pyproj.Transformer.from_crs(code, 3857, always_xy=True).transform
    first = [2.2945, 48.8584] if zone is None else [334_000.0, 6_252_000.0]
    places = generator.uniform(0, 0.01 if zone is None else 1000, (7, 2)) + first
    given = places[:, ::-1] if zone is None else places
    with Map.open(folder) as old:
        names = [image.name.rpartition("@")[2] for image in old.images]
        names = [f"{number}-{name}" for number, name in enumerate(names)]
        rows = np.concatenate(list(old.descriptors))
        metadata = old.metadata
    axes = ("lat", "lon") if zone is None else ("east", "north")
    of = dict(zip(names, map(tuple, given.tolist()), strict=True))
    with open_for_appending(tmp_path / "map", metadata) as target:
        target.append(names, [1] * 7, rows, root="/", positions=Positions(axes, of, zone))
    with tile_server() as (host, asked):
        tiles = Tiles(host + "/{z}/{x}/{y}.png", "© OpenStreetMap contributors")
        with serving(tmp_path / "map", params, tiles=tiles) as running:
            address = f"http://127.0.0.1:{running.port}/"
            page = browsed(address, "--dump-dom")
    images, dots = attributes("image", page), attributes("circle", page)
    assert {each["href"].removeprefix(host) for each in images} == {path for path, _ in asked}
    assert {referrer for _, referrer in asked} == {address}
    assert (len(dots), len(images) > 1) == (7, True)
    assert "© OpenStreetMap contributors" in page
    zoom, column, row = map(int, re.findall(r"\d+", images[0]["href"].removeprefix(host)))
    side = WORLD / 2**zoom
    left, top, width = (float(images[0][name]) for name in ("x", "y", "width"))
    scale = (width - 0.5) / side  # tiles overlap by half a pixel, so that no seam shows
    found = np.array(
        [
            [
                column * side - WORLD / 2 + (float(dot["cx"]) - left) / scale,
                WORLD / 2 - row * side - (float(dot["cy"]) - top) / scale,
            ]
            for dot in dots
        ]
    )
    expected = np.stack(to_mercator(*places.T), axis=1)
    # Dots are printed with one decimal of a pixel, tiles with two.
    np.testing.assert_allclose(found, expected, atol=0.1 / scale, rtol=0)
    assert 1 / scale < 20  # metres a pixel: a kilometre fills the map
