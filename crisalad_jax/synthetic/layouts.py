"""Write rendered sets of images to disk, completely or not at all, in layouts of real data sets.

A set is written from a stream of files, each a path within the set's folder and its content.
"""

import dataclasses
import itertools
import json
import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from crisalad_jax.synthetic.mesh import Rng
from crisalad_jax.synthetic.view import EYE, PITCH, Season, View
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_folder, read_json, write_json
from crisalad_jax.utils.progress import progress_bar

Files = Iterator[tuple[str, bytes]]

RENDERER = 1
"""Version of the renderer. Increase it if pictures change: sets on disk then no longer match."""
_FILE = "set.json"
_METRES_PER_DEGREE = 111_195.0
"""Metres in a degree of latitude, on a sphere of radius 6371 km."""
_LONGITUDE = -40.0
"""Degrees east of all training cities, which lie in an ocean."""
_UTM_ORIGIN = (500_000.0, 5_000_000.0)
"""Easting and northing of a test set's south-west corner, in zone 32T."""
_MONTHS: dict[Season, int] = {"spring": 4, "summer": 7, "autumn": 10, "winter": 1}


def write_set(root: str | os.PathLike[str], config: Any, files: Files, *, quiet: bool) -> bool:
    """Write a set into `root`, completely or not at all, unless it exists there already.

    Args:
        root: a folder that does not exist, or is empty, or holds this set.
        config: the set's configuration, a dataclass; it is stored as set.json in the folder.
        files: (path within `root`, content) of each file of the set.
        quiet: whether to hide the progress bar.

    Returns:
        Whether the set was written; False if it existed already.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    root = pathlib.Path(root)
    identity = json.loads(json.dumps({"renderer": RENDERER, **dataclasses.asdict(config)}))
    if (root / _FILE).is_file():
        existing = read_json(root / _FILE, "a rendered set")
        for name, value in identity.items():
            if existing.get(name) != value:
                raise InputError(
                    f"{root}: found a rendered set of another configuration ({name}: "
                    f"{existing.get(name, 'default')}, not {value}), expected a new or empty folder"
                )
        return False
    with (
        atomic_folder(root) as folder,
        progress_bar("rendering", config.images, "images", quiet=quiet) as bar,
    ):
        for name, data in files:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            bar.advance(path.suffix == ".jpg")
        write_json(folder / _FILE, identity)
    return True


class Shot(NamedTuple):
    """A picture of a set, and where and how it was taken."""

    place: int
    view: View
    picture: bytes
    rng: Rng
    """Random generator of the year and the panorama's name."""
    east: float = 0.0
    """Metres east of the set's south-west corner; `north` is the metres north of it."""
    north: float = 0.0
    northdeg: int = 0
    """Heading of the camera in degrees clockwise from north."""

    def draw_date(self) -> tuple[int, int]:
        """Draw a year, and return it with the month of the view's season, 1 to 12."""
        return int(self.rng.integers(2012, 2022)), _MONTHS[self.view.season]

    def draw_panoid(self) -> str:
        """Draw the panorama's name, 16 hexadecimal digits."""
        return self.rng.bytes(8).hex()


def gsv_city(city: str, latitude: float, shots: Iterable[Shot]) -> Files:
    """Yield the files of a city as GSV-Cities lays them out: images, and then their table."""
    per_degree = _METRES_PER_DEGREE * np.cos(np.deg2rad(latitude))
    rows = ["place_id,year,month,northdeg,city_id,lat,lon,panoid"]
    for shot in shots:
        lat = f"{latitude + shot.north / _METRES_PER_DEGREE:.7f}"
        lon = f"{_LONGITUDE + shot.east / per_degree:.7f}"
        (year, month), key = shot.draw_date(), shot.draw_panoid()
        rows.append(f"{shot.place},{year},{month},{shot.northdeg},{city},{lat},{lon},{key}")
        where = f"{year:04d}_{month:02d}_{shot.northdeg:03d}_{lat}_{lon}"
        name = f"{city}_{shot.place:07d}_{where}_{key}.jpg"
        yield f"train/Images/{city}/{name}", shot.picture
    yield f"train/Dataframes/{city}.csv", "".join(f"{row}\n" for row in rows).encode()


def utm_images(shots: Iterable[Shot], scenery: str = "", *, camera: bool = False) -> Files:
    """Yield test images as VPR-datasets-downloader lays them out: UTM metres are in their names.

    Args:
        shots: database images and queries, alternating.
        scenery: kind of the places, for the file names; empty to leave it out.
        camera: whether names include the direction and height of the camera, and the date.
    """
    for side, shot in zip(itertools.cycle(("database", "queries")), shots, strict=False):
        east, north = _UTM_ORIGIN[0] + shot.east, _UTM_ORIGIN[1] + shot.north
        pose = ("",) * 5
        if camera:
            year, month = shot.draw_date()
            pose = f"{shot.northdeg}", f"{PITCH:.0f}", "0", f"{EYE}", f"{year:04d}{month:02d}"
        note = "_".join(filter(None, (scenery, shot.view.season, shot.view.time)))
        position = f"{east:.2f}", f"{north:.2f}", "32", "T"
        fields = *position, "", "", shot.draw_panoid(), "", *pose, note
        yield f"test/images/test/{side}/@{'@'.join(fields)}@.jpg", shot.picture


def derive_seed(*numbers: int) -> int:
    """Derive a place's seed from some numbers, such as the set's seed, a split and an index."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0])


def jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Compress an RGB picture as a JPEG of quality 92."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 92))
    return data.tobytes()
