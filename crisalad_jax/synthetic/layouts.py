"""Rendered sets on disk: a folder that is written whole or not at all, and the layouts in it.

A set is written from a stream of files, each its path within the set's folder and its bytes.
"""

import dataclasses
import json
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from crisalad_jax.synthetic.mesh import Rng
from crisalad_jax.synthetic.view import Season
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_folder, check_new_folder, read_json, write_json

Files = Iterator[tuple[str, bytes]]
Progress = Callable[[int], object] | None

RENDERER = 1
"""Version of the renderer: increase it if pictures change, and sets on disk no longer match."""
METRES_PER_DEGREE = 111_195.0
"""Metres in a degree of latitude, on a sphere of radius 6371 km."""
UTM_ORIGIN = (500_000.0, 5_000_000.0)
"""East and north in zone 32T of a test set's south-west corner."""
MONTHS: dict[Season, int] = {"spring": 4, "summer": 7, "autumn": 10, "winter": 1}


def holds(root: str | os.PathLike[str], file: str, config: Any) -> bool:
    """Return whether a folder holds this set already; False where it can be written there.

    Args:
        root: the folder.
        file: name of the file that says what the folder holds.
        config: the set's configuration, a dataclass.

    Raises:
        InputError: `root` is a file, or holds anything else.
    """
    root = pathlib.Path(root)
    if not (root / file).is_file():
        check_new_folder(root)
        return False
    existing = read_json(root / file, "a rendered set")
    for name, value in _identity(config).items():
        if existing.get(name) != value:
            raise InputError(
                f"{root}: found a rendered set of another configuration ({name}: "
                f"{existing.get(name, 'default')}, not {value}), expected a new or empty folder"
            )
    return True


def _identity(config: Any) -> dict[str, Any]:
    """Return what tells a set from others, as JSON has it."""
    return json.loads(json.dumps({"renderer": RENDERER, **dataclasses.asdict(config)}))


def write_set(
    root: str | os.PathLike[str], file: str, config: Any, files: Files, progress: Progress
) -> None:
    """Write a set into `root`, whole or not at all, unless it is there.

    Args:
        root: a folder that does not exist, or is empty, or holds this set.
        file: name of the file that says what the folder holds.
        config: the set's configuration, a dataclass.
        files: the set.
        progress: called with 1 after every picture.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    if holds(root, file, config):
        return
    with atomic_folder(root) as folder:
        for name, data in files:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            if progress is not None and path.suffix == ".jpg":
                progress(1)
        write_json(folder / file, _identity(config))


class TrainImage(NamedTuple):
    """An image of a training city."""

    place: int
    picture: bytes
    lat: str
    lon: str
    northdeg: int
    season: Season
    rng: Rng
    """Draws the year and the panorama's name."""


def gsv_city(city: str, images: Iterable[TrainImage]) -> Files:
    """Lay out a city as GSV-Cities does: its images, and a table of them."""
    rows = ["place_id,year,month,northdeg,city_id,lat,lon,panoid"]
    for place, picture, lat, lon, northdeg, season, rng in images:
        year, month = int(rng.integers(2012, 2022)), MONTHS[season]
        key = panoid(rng)
        rows.append(f"{place},{year},{month},{northdeg},{city},{lat},{lon},{key}")
        date = f"{year:04d}_{month:02d}"
        name = f"{city}_{place:07d}_{date}_{northdeg:03d}_{lat}_{lon}_{key}.jpg"
        yield f"train/Images/{city}/{name}", picture
    yield f"train/Dataframes/{city}.csv", "".join(f"{row}\n" for row in rows).encode()


def utm_path(
    side: str, east: float, north: float, key: str, note: str, camera: Sequence[str] = ("",) * 5
) -> str:
    """Name a test image as VPR-datasets-downloader does, which has its position in metres.

    Args:
        side: "database" or "queries".
        east: metres east in zone 32T.
        north: metres north.
        key: the panorama's name.
        note: what else is known.
        camera: degrees from north, of pitch and of roll; metres from the ground; year and month.
    """
    fields = f"{east:.2f}", f"{north:.2f}", "32", "T", "", "", key, "", *camera, note
    return f"test/images/test/{side}/@{'@'.join(fields)}@.jpg"


def panoid(rng: Rng) -> str:
    """Draw the name of a panorama."""
    return rng.bytes(8).hex()


def jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Compress a picture with quality 92."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 92))
    return data.tobytes()
