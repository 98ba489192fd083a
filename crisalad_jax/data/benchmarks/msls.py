"""Mapillary Street-Level Sequences as published (Warburg et al., CVPR 2020).

`train_val/{city}/{query,database}/` with `images/KEY.jpg` and tables whose rows are in the same
order: `raw.csv` (key, lon, lat, ca, captured_at, pano), `postprocessed.csv` (key, easting,
northing, ...) and `subtask_index.csv` (all, ...). `ca` is the compass angle in degrees.
"""

import csv
import os
import pathlib
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders_on_disk import find_images, listing, shown
from crisalad_jax.data.benchmarks.ground_truth import DEFAULT_RADIUS, check_radius, within
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.metres import on_ellipsoid
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source, real_path
from crisalad_jax.utils.shapes import Float, Float64, Int64

MSLS_CITIES = {
    "val": ("cph", "sf"),
    "train": (
        *("amman", "amsterdam", "austin", "bangkok", "berlin", "boston", "budapest", "goa"),
        *("helsinki", "london", "manila", "melbourne", "moscow", "nairobi", "ottawa", "paris"),
        *("phoenix", "saopaulo", "tokyo", "toronto", "trondheim", "zurich"),
    ),
}
"""The cities whose positions are published."""


def msls_title(cities: Collection[str]) -> str:
    """Name a set of these cities: "MSLS val", "MSLS train", or MSLS and the cities' names."""
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
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Read raw MSLS: all images but panoramas. A query without a match counts as a miss.

    VPR-datasets-downloader takes the same images: about 11,000 queries of val.

    Args:
        root: the folder with `train_val/`, or that one.
        split: `val` (the default) or `train`; those of its cities that are there.
        radius: in metres, inclusive. Images of different cities never match.
        max_heading_difference: largest difference of two compass angles in degrees, inclusive, for
            a match (the CriSALAD paper says 40); None lets any match, as the official code does.
        on_bad_image: "skip" lets images be missing, for whoever reads them to leave out.

    Raises:
        InputError: no such city, a table that is missing, without a column or of another length, a
            field that is no number, images that are missing, a negative radius, an angle that is
            not from 0 to 180.
    """
    return _read(root, split, radius, max_heading_difference, on_bad_image, subtask=False)


def read_msls_subtask(
    root: str | os.PathLike[str],
    split: str | None = None,
    radius: float = DEFAULT_RADIUS,
    *,
    max_heading_difference: float | None = None,
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Read raw MSLS as the official code does for val: the list of 740 queries.

    Images are those that `subtask_index.csv` marks as `all`, without panoramas. Queries need a
    database image within `radius`, by distance alone. A `max_heading_difference` leaves the queries
    the same, and those that it leaves without a match count as misses.

    Arguments and errors are those of `read_msls`.
    """
    return _read(root, split, radius, max_heading_difference, on_bad_image, subtask=True)


class _Side(NamedTuple):
    """The database or the queries of a city."""

    images: tuple[pathlib.Path, ...]
    positions: Float64[np.ndarray, "images 2"]
    degrees: Float64[np.ndarray, "images 2"]
    """Latitude and longitude; 0 where nothing asks for them."""
    headings: Float64[np.ndarray, " images"]

    def only(self, chosen: Int64[np.ndarray, " _"]) -> "_Side":
        images = tuple(self.images[i] for i in chosen)
        return _Side(images, self.positions[chosen], self.degrees[chosen], self.headings[chosen])


def _read(
    root: str | os.PathLike[str],
    split: str | None,
    radius: float,
    max_heading_difference: float | None,
    on_bad_image: OnBadImage,
    *,
    subtask: bool,
) -> Benchmark:
    root = pathlib.Path(root)
    check_radius(radius)
    turned = max_heading_difference is not None
    if turned and not 0 <= max_heading_difference <= 180:
        raise InputError(
            f"max heading difference: found {max_heading_difference}, expected degrees from 0 to "
            "180"
        )
    database: list[_Side] = []
    queries: list[_Side] = []
    positives: list[Int64[np.ndarray, " _"]] = []
    folders = _city_folders(root, split or "val")
    start = 0
    for folder in folders:
        there, asked = (
            _read_side(
                folder / part,
                on_bad_image,
                degrees=len(folders) > 1,
                headings=turned,
                subtask=subtask,
            )
            for part in ("database", "query")
        )
        near = within(there.positions, asked.positions, radius)
        if subtask:
            chosen = np.array([i for i, matches in enumerate(near) if matches.size], np.int64)
            asked, near = asked.only(chosen), tuple(near[i] for i in chosen)
        if max_heading_difference is not None:
            near = tuple(
                matches[
                    heading_difference(there.headings[matches], heading) <= max_heading_difference
                ]
                for matches, heading in zip(near, asked.headings, strict=True)
            )
        positives += [matches + start for matches in near]
        database.append(there)
        queries.append(asked)
        start += len(there.images)
    if not positives:
        raise InputError(f"{root}: found no query within {radius:g} m of the database")

    angle = f" and {max_heading_difference:g} degrees" if turned else ""
    title = msls_title([folder.name for folder in folders])
    kind = ", subtask all" if subtask else ""
    rule = f"UTM distance of at most {radius:g} m"
    if turned:
        rule += f" and compass angles at most {max_heading_difference:g} degrees apart"
    if subtask:
        rule += "; queries of the subtask all with a database image in that distance"
    return Benchmark(
        name=f"{title}, raw{kind}, {len(positives)} queries, {radius:g} m{angle}",
        root=root,
        database=tuple(path for side in database for path in side.images),
        queries=tuple(path for side in queries for path in side.images),
        positives=tuple(positives),
        rule=f"{rule}; no panoramas",
        database_positions=_positions(database),
        query_positions=_positions(queries),
        radius=radius,
    )


def _positions(sides: list[_Side]) -> Float64[np.ndarray, "images axis"]:
    """Return the metres of one city, or points of several, each of which has its own zone."""
    if len(sides) == 1:
        return sides[0].positions
    return on_ellipsoid(*np.concatenate([side.degrees for side in sides]).T)


def heading_difference(
    first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"] | float
) -> Float64[np.ndarray, " n"]:
    """Compute the angle between two compass angles in degrees, from 0 to 180."""
    turn = np.abs(np.subtract(first, second, dtype=np.float64)) % 360
    return np.minimum(turn, 360 - turn)


def is_msls(root: pathlib.Path) -> bool:
    """Return whether a folder is raw MSLS: it holds train_val/ or is itself train_val/."""
    return (root / "train_val").is_dir() or real_path(root).name == "train_val"


def _city_folders(root: pathlib.Path, split: str) -> list[pathlib.Path]:
    """List the folders of a split's cities that are on disk."""
    if split not in MSLS_CITIES:
        raise InputError(
            f"split: found {split!r}, expected val or train: no other part of MSLS has positions"
        )
    parent = root / "train_val" if (root / "train_val").is_dir() else root
    folders = [parent / city for city in MSLS_CITIES[split] if (parent / city).is_dir()]
    if not folders:
        raise InputError(
            f"{parent}: found {listing(parent)}, expected some of "
            f"{shown(f'{city}/' for city in MSLS_CITIES[split])} for {split}"
        )
    return folders


def _read_side(
    folder: pathlib.Path,
    on_bad_image: OnBadImage,
    *,
    degrees: bool,
    headings: bool,
    subtask: bool,
) -> _Side:
    """Read a folder's images that are no panoramas, in the order of the tables."""
    more = ("lat", "lon") * degrees + ("ca",) * headings
    raw = _read_table(folder / "raw.csv", ("key", "pano", *more))
    columns = ("key", "easting", "northing")
    tables = {"postprocessed.csv": _read_table(folder / "postprocessed.csv", columns)}
    if subtask:
        tables["subtask_index.csv"] = _read_table(folder / "subtask_index.csv", ("all",))
    for name, table in tables.items():
        keys = [row.get("key", first["key"]) for first, row in zip(raw, table, strict=False)]
        if len(table) != len(raw) or keys != [row["key"] for row in raw]:
            raise InputError(
                f"{folder / name}: found {len(table)} rows, expected the same {len(raw)} images as "
                "in raw.csv, in the same order"
            )
    chosen = []
    for row, first in enumerate(raw):
        marked = not subtask or _truth(
            folder / "subtask_index.csv", row, "all", tables["subtask_index.csv"]
        )
        if marked and not _truth(folder / "raw.csv", row, "pano", raw):
            chosen.append((row, first["key"]))
    if not chosen:
        raise InputError(f"{folder}: found {len(raw)} images, expected some that are no panoramas")
    names = [f"{key}.jpg" for _, key in chosen]
    path = folder / "postprocessed.csv"
    positions = [
        [_number(path, row, name, tables[path.name]) for name in ("easting", "northing")]
        for row, _ in chosen
    ]
    places = [
        [_number(folder / "raw.csv", row, name, raw) if degrees else 0.0 for name in ("lat", "lon")]
        for row, _ in chosen
    ]
    angles = [_number(folder / "raw.csv", row, "ca", raw) if headings else 0.0 for row, _ in chosen]
    return _Side(
        images=find_images(folder / "raw.csv", folder / "images", names, on_bad_image=on_bad_image),
        positions=np.array(positions),
        degrees=np.array(places),
        headings=np.array(angles),
    )


_Table = list[dict[str, str]]


def _read_table(path: pathlib.Path, columns: tuple[str, ...]) -> _Table:
    check_source(path, "a table of UTF-8 CSV", largest=LARGEST)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restval="")
            header = reader.fieldnames or []
            missing = [name for name in columns if name not in header]
            if missing:
                raise InputError(
                    f"{path}: found columns {', '.join(header) or 'none'}; missing "
                    f"{', '.join(missing)}"
                )
            return list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 CSV: {error}") from error


def _truth(path: pathlib.Path, row: int, column: str, table: _Table) -> bool:
    text = table[row][column]
    if text not in ("True", "False"):
        raise InputError(f"{path}: row {row + 1}: {column}: found {text!r}, expected True or False")
    return text == "True"


def _number(path: pathlib.Path, row: int, column: str, table: _Table) -> float:
    text = table[row][column]
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: row {row + 1}: {column}: found {text!r}, expected a number")
    return value
