"""Street map tiles behind the page's map of places, from a server that the user names."""

import dataclasses
import re

from crisalad_jax.data.positions import AXES
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.utils.errors import InputError

_ADDRESS = re.compile(r"(https?://[\w.-]+(?::\d+)?)/[^\s{}]*(?:\{[xyz]\}[^\s{}]*){3}", re.ASCII)
_OPENSTREETMAP = "© OpenStreetMap contributors"


@dataclasses.dataclass(frozen=True)
class Tiles:
    """The source of a browser's map tiles, which are 256 pixels square, in Web Mercator."""

    url: str
    """Address with {z}, {x} and {y} for the zoom, column and row of a tile."""
    attribution: str
    """Text that the page shows with the tiles."""

    @property
    def origin(self) -> str:
        """Scheme, host and port of the address, which the content security policy allows."""
        return self.url[: self.url.index("/", len("https://"))]


def open_tiles(url: str, attribution: str | None, places: Map) -> Tiles:
    """Make `Tiles`, after checking their address and that a map's positions fit on them.

    Args:
        url: the tiles' address, with {z}, {x} and {y}.
        attribution: text to show with the tiles; None is the text that OpenStreetMap requires for
            its own tiles, and no text for others.
        places: the map.

    Raises:
        InputError: the address is not http(s) with {z}, {x} and {y}; or the map's positions are
            neither in degrees nor in metres of a known UTM zone.
    """
    if not _ADDRESS.fullmatch(url) or any(url.count(f"{{{axis}}}") != 1 for axis in "xyz"):
        raise InputError(
            f"tiles: found {url!r}, expected an address with {{z}}, {{x}} and {{y}}, such as "
            "https://tile.openstreetmap.org/{z}/{x}/{y}.png"
        )
    if places.axes not in (None, AXES[1]) and places.zone is None:
        raise InputError(
            f"tiles: found positions in {', '.join(places.axes or ())} without a zone of UTM in "
            f"{places.folder}, expected degrees, or metres of a known zone"
        )
    if attribution is None:
        host = url.split("/")[2].partition(":")[0]
        is_open = host == "openstreetmap.org" or host.endswith(".openstreetmap.org")
        attribution = _OPENSTREETMAP if is_open else ""
    return Tiles(url, attribution)
