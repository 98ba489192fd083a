"""`crisalad serve`."""

import os
import pathlib
import re

from crisalad_jax.cli.common import echo, find_given, refuse_without
from crisalad_jax.cli.flags import DecodeFlags, MapFlags, QueryRuntimeName
from crisalad_jax.retrieval.serve import serve_map
from crisalad_jax.retrieval.verification.verify import Verify
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_text

_LOCAL = re.compile(r"local(?::([1-9][0-9]{0,2}))?")


class Serve(DecodeFlags, MapFlags):
    """Answer over HTTP, and in a browser, where photographs were taken."""

    host: str = "127.0.0.1"
    """Name or address to listen on; one that other machines can reach needs a token."""
    port: int = 8000
    """Port to listen on; 0 is any free one."""
    token_file: pathlib.Path | None = None
    """File with the token that requests must send; by default the variable CRISALAD_TOKEN."""
    append: bool = False
    """Let requests add images to the map; no other process can append then."""
    map_images: pathlib.Path | None = None
    """Folder of the map's pictures, if they were moved."""
    runtime: QueryRuntimeName = "auto"
    """Engine that runs the model; see `crisalad query`."""
    k: int = 5
    """Number of answers per picture, if the request sets none."""
    tiles: str | None = None
    """URL of street map tiles, which browsers load behind the page's map, as in
    https://tile.openstreetmap.org/{z}/{x}/{y}.png."""
    tiles_attribution: str | None = None
    """Text to show with the tiles; by default OpenStreetMap's, for its tiles."""
    rerank: str | None = None
    """local:N verifies the N best answers by local features; local alone verifies the first 5
    (docs/verification.md)."""
    max_bytes: int = 20 * 2**20
    """Maximum bytes of a request."""
    max_pixels: int = 2**26
    """Maximum pixels of a picture; larger ones are not decoded."""


def run(arguments: Serve) -> None:
    """Serve the map until a signal ends it."""
    refuse_without("--tiles", arguments.tiles, tiles_attribution=arguments.tiles_attribution)
    if arguments.token_file is None:
        token = os.environ.get("CRISALAD_TOKEN")
    else:
        token = read_text(arguments.token_file, "a token in one line").strip()

    def ready(address: str, engine: str) -> None:
        needs = " with the token" if token else ""
        appends = ", and adds images to it" if arguments.append else ""
        echo(f"{address}{needs}: answers for {arguments.map}{appends}; by {engine}; Ctrl-C ends it")

    given = vars(arguments) | {"token": token, "ready": ready, "engine": arguments.runtime}
    runtime = arguments.runtime
    given["weights"] = find_given(arguments.weights, runtime=runtime, quiet=arguments.quiet)
    given |= {"rerank": _verify_of(arguments), "verify": arguments.checksums}
    for name in ("token_file", "plugin", "checksums", "runtime"):
        del given[name]
    serve_map(given.pop("map"), **given)


def _verify_of(arguments: Serve) -> Verify | None:
    """Read --rerank."""
    if arguments.rerank is None:
        return None
    match = _LOCAL.fullmatch(arguments.rerank)
    if match is None:
        raise InputError(f"--rerank: found {arguments.rerank}, expected local, or local:N")
    return Verify(answers=int(match[1] or 5), map_images=arguments.map_images)
