"""Read Mapillary Street-Level Sequences (MSLS) as published (Warburg et al., CVPR 2020).

Each `train_val/{city}/{query,database}/` has `images/KEY.jpg`, and tables with the same row order:
`raw.csv` (key, lon, lat, ca, captured_at, pano), `postprocessed.csv` (key, easting, northing, ...)
and `subtask_index.csv` (all, ...). `ca` is the compass angle in degrees.
"""

import os
import pathlib
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.data.benchmarks.benchmark import DEFAULT_RADIUS, Benchmark, within
from crisalad_jax.data.benchmarks.on_disk import find_images, listing, shown
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.metres import on_ellipsoid
from crisalad_jax.data.remote import is_folder
from crisalad_jax.data.tables import read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.shapes import Float64

MSLS_CITIES = {
    "val": ("cph", "sf"),
    "train": (
        *("amman", "amsterdam", "austin", "bangkok", "berlin", "boston", "budapest", "goa"),
        *("helsinki", "london", "manila", "melbourne", "moscow", "nairobi", "ottawa", "paris"),
        *("phoenix", "saopaulo", "tokyo", "toronto", "trondheim", "zurich"),
    ),
}
"""The cities whose positions are published, by split."""


def msls_title(cities: Collection[str]) -> str:
    """Return a title for these cities: "MSLS val", "MSLS train", or "MSLS of" and their names."""
    for split, expected in MSLS_CITIES.items():
        if set(cities) == set(expected):
            return f"MSLS {split}"
    return f"MSLS of {', '.join(sorted(cities))}"


def read_msls(
    root: str | os.PathLike[str],
    split: str | None = None,
    radius: float = DEFAULT_RADIUS,
    *,
    max_heading_difference: float | None = None,
    subtask: bool = False,
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Read MSLS as published: all images except panoramas.

    A query without a match counts as a miss. VPR-datasets-downloader uses the same images; val has
    about 11,000 queries.

    With `subtask`, the set is that of the official code, which has 740 queries in val: images that
    `subtask_index.csv` marks as `all`, and only queries with a database image within `radius`. A
    query that then loses all matches to `max_heading_difference` stays, and counts as a miss.

    Args:
        root: the folder with `train_val/`, or `train_val/` itself.
        split: `val` (the default) or `train`; those of its cities that are in the folder are read.
        radius: radius of positives in metres, inclusive. Images of different cities never match.
        max_heading_difference: largest difference of two compass angles in degrees, inclusive, for
            a match (the CriSALAD paper says 40); None allows any, as the official code does.
        subtask: whether to read only the subtask `all`.
        on_bad_image: "stop" refuses missing images; under "skip" `evaluate` leaves them out.

    Raises:
        InputError: there is no such split, or none of its cities; a table is missing, lacks a
            column or has other rows than `raw.csv`; a field is not a number; images are missing; no
            query is left; `radius` is negative; or `max_heading_difference` is not from 0 to 180.
    """
    root, limit = pathlib.Path(root), max_heading_difference
    if limit is not None and not 0 <= limit <= 180:
        raise InputError(f"max heading difference: found {limit}, expected degrees from 0 to 180")
    cities = choose("split", split or "val", MSLS_CITIES)
    folders = city_folders(root, cities)
    database, queries, positives = [], [], []
    for folder in folders:
        there, asked = (
            read_side(folder / part, on_bad_image, headings=limit is not None, subtask=subtask)
            for part in ("database", "query")
        )
        near = within(there.metres, asked.metres, radius)
        chosen = [query for query, matches in enumerate(near) if matches.size or not subtask]
        start = sum(len(side.images) for side in database)
        for query in chosen:
            matches = near[query]
            if limit is not None:
                turn = np.abs(there.headings[matches] - asked.headings[query]) % 360
                matches = matches[np.minimum(turn, 360 - turn) <= limit]
            positives.append(matches + start)
        database.append(there)
        queries.append(_Side(*(part[chosen] for part in asked)))
    if not positives:
        raise InputError(f"{root}: found no query within {radius:g} m of the database")

    name = f"{msls_title([folder.name for folder in folders])}, raw{', subtask all' * subtask}"
    name += f", {len(positives)} queries, {radius:g} m"
    rule = f"UTM distance of at most {radius:g} m"
    if limit is not None:
        name += f" and {limit:g} degrees"
        rule += f" and compass angles at most {limit:g} degrees apart"
    if subtask:
        rule += "; queries of the subtask all with a database image within that distance"
    images, asking = (
        tuple(path for side in sides for path in side.images) for sides in (database, queries)
    )
    places, asked = _positions(database), _positions(queries)
    rule = f"{rule}; no panoramas"
    return Benchmark(name, root, images, asking, tuple(positives), rule, places, asked, radius)


def city_folders(root: pathlib.Path, cities: Collection[str]) -> list[pathlib.Path]:
    """Return the existing folders of these cities; raise InputError if there are none."""
    parent = root / "train_val" if (root / "train_val").is_dir() else root
    folders = [parent / city for city in cities if (parent / city).is_dir()]
    if not folders:
        raise InputError(
            f"{parent}: found {listing(parent)}, expected some of "
            f"{shown(f'{city}/' for city in cities)}"
        )
    return folders


class _Side(NamedTuple):
    """The database or the queries of a city."""

    images: np.ndarray
    """Paths."""
    metres: Float64[np.ndarray, "images 2"]
    """East and north in the city's zone."""
    degrees: Float64[np.ndarray, "images 2"]
    """Latitude and longitude."""
    headings: Float64[np.ndarray, " images"]
    """Compass angles in degrees; 0 if not requested."""
    clusters: np.ndarray
    """Name of each image's place, within the city; empty strings if not requested."""


def _positions(sides: list[_Side]) -> Float64[np.ndarray, "images axis"]:
    """Return the metres of one city; of several, which differ in zone, points on the ellipsoid."""
    if len(sides) == 1:
        return sides[0].metres
    return on_ellipsoid(*np.concatenate([side.degrees for side in sides]).T)


def is_msls(root: pathlib.Path) -> bool:
    """Return whether a folder is MSLS as published: it holds train_val/, or is train_val/."""
    return is_folder(root / "train_val") or real_path(root).name == "train_val"


def read_side(
    folder: pathlib.Path,
    on_bad_image: OnBadImage,
    *,
    headings: bool,
    subtask: bool = False,
    clusters: bool = False,
) -> _Side:
    """Read a city's database or queries, except panoramas, in the order of the tables."""
    columns = ("lat", "lon", *["ca"] * headings)
    raw = list(read_table(folder / "raw.csv", "key", "pano", *columns).rows())
    needed = ("key", "easting", "northing", *["unique_cluster"] * clusters)
    placed = list(read_table(folder / "postprocessed.csv", *needed).rows())
    marked = list(read_table(folder / "subtask_index.csv", "all").rows()) if subtask else raw
    keys = [row.fields["key"] for row in raw]
    for name, rows in {"postprocessed.csv": placed, "subtask_index.csv": marked}.items():
        same = [row.fields.get("key", key) for row, key in zip(rows, keys, strict=False)] == keys
        if not same or len(rows) != len(keys):
            raise InputError(
                f"{folder / name}: found {len(rows)} rows, expected the same {len(raw)} images as "
                "in raw.csv, in the same order"
            )
    kept = [
        (row, place)
        for row, place, mark in zip(raw, placed, marked, strict=True)
        if row.fields["pano"] == "False" and (not subtask or mark.fields["all"] == "True")
    ]
    if not kept:
        raise InputError(f"{folder}: found {len(raw)} images, expected some that are not panoramas")
    names = [f"{row.fields['key']}.jpg" for row, _ in kept]
    images = find_images(folder / "raw.csv", names, folder / "images", on_bad_image)
    metres = np.array([[place.number("easting"), place.number("northing")] for _, place in kept])
    numbers = np.array([[row.number(column) for column in columns] for row, _ in kept])
    angles = numbers[:, 2] if headings else np.zeros(len(kept))
    of_place = [place.text("unique_cluster") if clusters else "" for _, place in kept]
    return _Side(np.array(images, object), metres, numbers[:, :2], angles, np.array(of_place))
