"""Training places in the layout of GSV-Cities (Ali-bey et al. 2022) or of one's own, in order.

The layout of GSV-Cities: `Dataframes/{city}.csv` with one row per image, and
`Images/{city_id}/{city_id}_{place_id:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{panoid}.jpg`.
"""

import dataclasses
import itertools
import math
import operator
import os
import pathlib
from collections.abc import Collection, Sequence
from typing import Any, Literal

import numpy as np

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.named_places import (
    NamedPlaces,
    places_by_order,
    places_by_position,
    read_named_places,
)
from crisalad_jax.data.tables import Disk, normal_name, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64, Int, Int32, Int64

COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
IDS_PER_CITY = 10**5
_TURNS = 20
"""Draws of all places after which no batch of places that are far from each other is expected."""

Order = Literal["within-city", "shuffled"]


@brief
@dataclasses.dataclass(frozen=True, eq=False)
class Places:
    """Images grouped by place: place p owns images `place_start[p]` to `place_start[p + 1]`."""

    root: pathlib.Path
    cities: tuple[str, ...]
    files: tuple[str, ...]
    """Image -> path relative to `root`, as text: a Path takes ten times the memory."""
    image_place: Int32[np.ndarray, " images"]
    """Image -> place, ascending."""
    place_city: Int32[np.ndarray, " places"]
    """Place -> position in `cities`, ascending."""
    place_id: Int64[np.ndarray, " places"]
    """The id in the CSV modulo 10**5, plus 10**5 times the position of the city: unique."""
    place_start: Int64[np.ndarray, " places+1"]
    names: tuple[str, ...] | None = None
    """Place -> its name; None in the layout of GSV-Cities, where places have ids, and files' names
    tell where they were taken."""
    views: Float64[np.ndarray, "images 3"] | None = None
    """Image -> latitude, longitude and heading of a table, NaN where it has no heading."""
    near: tuple[Int64[np.ndarray, " _"], ...] | None = None
    """Place -> other places that are too near to be in a batch with it; None where any two may."""

    @property
    def image_counts(self) -> Int64[np.ndarray, " places"]:
        """Number of images of each place."""
        return np.diff(self.place_start)

    def path(self, image: int | np.integer) -> pathlib.Path:
        """Return the path of one image."""
        return self.root / self.files[image]

    def describe_place(self, place: int | np.integer) -> str:
        """Name a place for a message: its name, or its city and its id as in the CSV."""
        if self.names is not None:
            return f"place {self.names[place]}"
        city = self.cities[self.place_city[place]]
        return f"place {self.place_id[place] % IDS_PER_CITY} of {city}"


@takes(root=PATH)
def read_places(
    root: str | os.PathLike[str],
    *,
    cities: Sequence[str] | None = None,
    min_images: int = 4,
    place_radius: float | None = None,
    place_frames: int | None = None,
    positions: str | os.PathLike[str] | None = None,
    fps: float | None = None,
    on_bad_image: OnBadImage = "stop",
) -> Places:
    """Read a folder in the layout of GSV-Cities or of one's own.

    Or make places of any source of images, by their positions or their order. Then places that are
    too near to tell apart, `Places.near`, never meet in a batch.

    A layout of one's own is a folder in which each folder with images is a place; or a table with
    the columns `name,place`, and `lat,lon` and `heading` in degrees where they are known: a file,
    or `places.csv` in the folder. Names are relative to the table.

    GSV-Cities' images may end in .jpg or .JPG, and may lie in a folder named by the city id or by
    the CSV file. A row that repeats an earlier one of its place is dropped: no picture is its own
    second view.

    Args:
        root: folder that holds `Dataframes/` and `Images/`, or a layout of one's own; with
            `place_radius` or `place_frames` a source of images (`open_source`).
        cities: names of CSV files without the suffix; None reads all, in alphabetical order.
        min_images: places with fewer images are left out.
        place_radius: metres from a place's centre, within which its images are. In the order of the
            images, one that is farther from all centres becomes a centre; then each image is of the
            place with the nearest. Centres of a batch are more than four radii apart.
        place_frames: number of consecutive images of a folder, or frames of a video, that are a
            place. The next place is not in a batch with it.
        positions: table of positions (`read_positions`) for `place_radius`. None is what the source
            says, if that is a table, else what @UTM names say, else the EXIF data of JPEGs.
        fps: frames a second taken of videos; None is one.
        on_bad_image: "stop" where an image that a table names is missing, or "skip" it.

    Returns:
        The places, with their images' files.

    Raises:
        InputError: none of these layouts, an unknown or repeated city, a CSV without a column or
            with a field that is not a number, a missing image, no place large enough, no position,
            or arguments that do not fit each other.

    Example:
        >>> read_places(places, min_images=3).image_counts.tolist()
        [3, 3, 3, 3, 3, 3, 3, 3]
    """
    root = pathlib.Path(root)
    if place_radius is not None and place_frames is not None:
        raise InputError(
            "--place-frames: found beside --place-radius, expected only one of the two"
        )
    if place_radius is None and positions is not None:
        raise InputError("--positions: found without --place-radius, expected both")
    is_grouped = (place_radius, place_frames) != (None, None)
    if fps is not None and not is_grouped:
        raise InputError("--fps: found without --place-radius or --place-frames, expected one")
    if not is_grouped and (root / "Dataframes").is_dir():
        return _gsv_cities(root, cities, min_images, on_bad_image)
    if cities is not None:
        raise InputError(
            f"cities: found {', '.join(cities)} for {root}, expected none: it is not in the "
            "layout of GSV-Cities"
        )
    if place_radius is not None:
        found = places_by_position(root, place_radius, positions, fps, on_bad_image)
        return _named_places(found, min_images, f" within {place_radius:g} m")
    if place_frames is not None:
        found = places_by_order(root, place_frames, fps, on_bad_image)
        return _named_places(found, min_images, f" of every {place_frames}")
    return _named_places(read_named_places(root, on_bad_image), min_images)


def _named_places(found: NamedPlaces, min_images: int, words: str = "") -> Places:
    """Take the named places that are large enough; they are of one city."""
    kept = {name: files for name, files in found.images.items() if len(files) >= min_images}
    flags = " (--place-radius, --place-frames, --min-images)" if words else ""
    _check_some(found.root, kept, found.images.values(), min_images, words, flags)
    if len(kept) < len(found.images):
        warn(
            f"{found.root}: left out {len(found.images) - len(kept)} of {len(found.images)} places,"
            f" with fewer than {min_images} images{words}"
        )
    number = {name: place for place, name in enumerate(kept)}
    near, views = None, None
    if found.near is not None:
        near = tuple(
            np.array(sorted(number[other] for other in found.near[name] if other in number), int)
            for name in kept
        )
    if found.views is not None:
        views = np.array([found.views[file] for files in kept.values() for file in files])
    return Places(
        root=found.root,
        cities=(real_path(found.root).name,),
        **_by_place(list(kept.values())),
        place_city=np.zeros(len(kept), np.int32),
        place_id=np.arange(len(kept), dtype=np.int64),
        names=tuple(kept),
        views=views,
        near=near,
    )


def _check_some(
    root: pathlib.Path,
    kept: Collection[object],
    places: Collection[Sequence[str]],
    min_images: int,
    words: str = "",
    flags: str = "",
) -> None:
    """Check that some place is large enough."""
    if not kept:
        raise InputError(
            f"{root}: found no place with at least {min_images} images{words}; the largest has "
            f"{max(map(len, places), default=0)}, of {len(places)} places{flags}"
        )


def _by_place(images: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Return the fields of `Places` that say which images each place has."""
    counts = [len(files) for files in images]
    return {
        "files": tuple(itertools.chain.from_iterable(images)),
        "image_place": np.repeat(np.arange(len(counts), dtype=np.int32), counts),
        "place_start": np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
    }


def _gsv_cities(
    root: pathlib.Path, cities: Sequence[str] | None, min_images: int, on_bad_image: OnBadImage
) -> Places:
    """Read the layout of GSV-Cities."""
    tables = _find_tables(root, cities)
    listings = _Listings(root / "Images")
    read = [
        (city, place, images)
        for city, table in enumerate(tables)
        for place, images in _read_city(root, table, listings, on_bad_image)
    ]
    kept = [each for each in read if len(each[2]) >= min_images]
    _check_some(root, kept, [images for *_, images in read], min_images)
    return Places(
        root=root,
        cities=tuple(table.stem for table in tables),
        **_by_place([images for *_, images in kept]),
        place_city=np.array([city for city, *_ in kept], np.int32),
        place_id=np.array(
            [city * IDS_PER_CITY + place % IDS_PER_CITY for city, place, _ in kept], np.int64
        ),
    )


class _Listings(dict[str, tuple[str, dict[str, str]]]):
    """Folder in Images/ as a table names it -> its name on disk, and the names in it."""

    def __init__(self, images: pathlib.Path) -> None:
        self._images, self._disk = images, Disk()

    def __missing__(self, folder: str) -> tuple[str, dict[str, str]]:
        path = self._disk.find(self._images, folder)
        self[folder] = ("", {}) if path is None else (path.name, self._disk.names(path))
        return self[folder]

    def find(self, folders: Sequence[str], stem: str) -> str | None:
        """Return the path of an image relative to the root; None where there is none."""
        for folder in folders:
            there, files = self[folder]
            for name in (f"{stem}.jpg", f"{stem}.JPG"):
                if (file := files.get(name) or files.get(normal_name(name))) is not None:
                    return f"Images/{there}/{file}"
        return None


def _find_tables(root: pathlib.Path, cities: Sequence[str] | None) -> list[pathlib.Path]:
    folder = root / "Dataframes"
    tables = {path.stem: path for path in sorted(folder.glob("*.csv"))}
    if not tables:
        raise InputError(f"{folder}: found no CSV file, expected one for each city")
    chosen = list(tables) if cities is None else cities
    if not chosen or len(set(chosen)) < len(chosen):
        raise InputError(f"cities: found {list(chosen)}, expected at least one, each named once")
    unknown = [name for name in chosen if name not in tables]
    if unknown:
        raise InputError(
            f"cities (--cities): found {', '.join(unknown)}, expected some of those in {folder}: "
            f"{', '.join(tables)}"
        )
    return [tables[name] for name in chosen]


def _read_city(
    root: pathlib.Path, path: pathlib.Path, listings: _Listings, on_bad_image: OnBadImage
) -> list[tuple[int, list[str]]]:
    """Read one city's places, ascending by id, with the images of each."""
    # The inner dict serves as an ordered set.
    places: dict[int, dict[str, None]] = {}
    missing = 0
    city = path.stem
    table = read_table(path, *COLUMNS)
    fields = operator.itemgetter(*map(table.columns.index, COLUMNS))
    for line, row in table.lines:
        *numbers, city_id, latitude, longitude, panorama = fields(row)
        try:
            place, year, month, north = map(int, numbers)
            whole = min(place, year, month, north) >= 0
            whole &= math.isfinite(float(latitude)) and math.isfinite(float(longitude))
        except ValueError:
            whole = False
        if not whole:
            raise InputError(
                f"{path}: line {line}: found {', '.join(fields(row)[:-1])}, expected whole numbers "
                "from 0 for place_id, year, month and northdeg, and numbers for lat and lon"
            )
        stem = (
            f"{city_id}_{place % IDS_PER_CITY:07d}_{year:04d}_{month:02d}_{north:03d}"
            f"_{latitude}_{longitude}_{panorama}"
        )
        image = listings.find((city_id, city), stem)
        if image is not None:
            places.setdefault(place, {})[image] = None
        elif on_bad_image == "skip":
            missing += 1
        else:
            raise _no_image(root, path, line, (city_id, city), stem)
    if missing:
        warn(f"{path}: left out {missing} rows, whose images are missing")
    ids = {place % IDS_PER_CITY: place for place in places}
    if len(ids) < len(places):
        first = next(place for place in places if ids[place % IDS_PER_CITY] != place)
        raise InputError(
            f"{path}: found place_id {first} and {ids[first % IDS_PER_CITY]}, whose files have "
            f"the same names; expected ids that differ modulo {IDS_PER_CITY}"
        )
    return [(place, list(places[place])) for place in sorted(places)]


def _no_image(
    root: pathlib.Path, table: pathlib.Path, line: int, folders: tuple[str, ...], stem: str
) -> InputError:
    """Make the error of a row without an image; where a city has none, it says what to read."""
    images = root / "Images"
    if not any((images / folder).is_dir() for folder in folders):
        there = {path.name for path in images.glob("*") if path.is_dir()}
        cities = [path.stem for path in sorted(table.parent.glob("*.csv")) if path.stem in there]
        return InputError(
            f"{table}: found no folder {' nor '.join(dict.fromkeys(folders))} in {images}, "
            "expected the images of all cities, or the names of some as --cities: there are "
            f"{', '.join(cities) or 'none'}"
        )
    return InputError(
        f"{table}: line {line}: found no file Images/{folders[0]}/{stem}.jpg (nor .JPG, nor under "
        f"Images/{folders[1]}/), expected every row to have its image"
    )


def epoch_batches(
    places: Places,
    *,
    places_per_batch: int,
    images_per_place: int,
    order: Order,
    seed: int,
    epoch: int,
    steps: int | None = None,
) -> Int[np.ndarray, "steps places images"]:
    """Draw the images of every batch of an epoch, as a pure function of (seed, epoch).

    Every place comes at most once, with `images_per_place` of its images sampled without
    replacement. An incomplete last batch is dropped. "within-city" shuffles the places of each
    city and joins the cities in random order, as the public loaders do. A batch is then nearly
    always of one city, whose places are hard to tell apart. "shuffled" mixes all cities.

    With `steps` the epoch has exactly this number of batches: it is cut short, or continued with
    new draws of all places.

    Places that are `Places.near` each other are never in one batch: in its turn, a place goes into
    the first unfinished batch without a place that is near. Then epochs without `steps` may differ
    in length.

    Raises:
        InputError: a place has fewer than `images_per_place` images, there are fewer places than
            `places_per_batch` (or too few that are not near each other), an unknown order, a
            negative seed or epoch, less than one step.
    """
    for name, value, least in (
        ("places_per_batch", places_per_batch, 1),
        ("images_per_place", images_per_place, 1),
        ("seed", seed, 0),
        ("epoch", epoch, 0),
        ("steps", 1 if steps is None else steps, 1),
    ):
        if value < least:
            raise InputError(f"{name}: found {value}, expected at least {least}")
    counts = places.image_counts
    if counts.min() < images_per_place:
        place = int(counts.argmin())
        raise InputError(
            f"{places.root}: {places.describe_place(place)} has {counts[place]} images, expected "
            f"at least images_per_place {images_per_place}"
        )
    if len(counts) < places_per_batch:
        raise InputError(
            f"{places.root}: found {len(counts)} places, expected at least places_per_batch "
            f"{places_per_batch} (--places-per-batch)"
        )
    drawn: list[np.ndarray] = []
    for turn in itertools.count():
        # The spawn key makes this stream independent of the loader's from (seed, epoch). The
        # first turn draws the same as an epoch without `steps`.
        entropy = (seed, epoch, turn) if turn else (seed, epoch)
        generator = np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=(0,)))
        drawn.append(_draw(places, places_per_batch, images_per_place, order, generator))
        found = sum(map(len, drawn))
        if not found and turn == _TURNS - 1:
            raise InputError(
                f"{places.root}: found {len(counts)} places, of which no {places_per_batch} are "
                "far enough from each other for a batch (places_per_batch, --places-per-batch), "
                "expected fewer in a batch, or smaller places"
            )
        if found >= (steps or 1):
            break
    return np.concatenate(drawn)[:steps]


def _draw(
    places: Places,
    places_per_batch: int,
    images_per_place: int,
    order: Order,
    generator: np.random.Generator,
) -> Int[np.ndarray, "steps places images"]:
    """Draw the batches of one turn, in which every place comes once."""
    counts = places.image_counts
    if order == "within-city":
        city_rank = generator.permutation(len(places.cities))[places.place_city]
    elif order == "shuffled":
        city_rank = np.zeros(len(counts), np.int64)
    else:
        raise InputError(f"order: found {order!r}, expected one of shuffled, within-city")
    place_order = np.lexsort((generator.random(len(counts)), city_rank))
    if places.near is None:
        steps = len(counts) // places_per_batch
        chosen = place_order[: steps * places_per_batch].reshape(steps, places_per_batch)
    else:
        chosen = _apart(place_order.tolist(), places.near, places_per_batch)
    # Sorting all images by (place, random key) shuffles the images within each place.
    shuffled = np.lexsort((generator.random(len(places.files)), places.image_place))
    return shuffled[places.place_start[chosen][..., None] + np.arange(images_per_place)]


def _apart(
    order: Sequence[int], near: Sequence[Int64[np.ndarray, " _"]], size: int
) -> Int64[np.ndarray, "steps places"]:
    """Fill batches with places in this order, so that none is near another of its batch."""
    full: list[list[int]] = []
    unfinished: list[tuple[list[int], set[int]]] = []
    for place in order:
        fitting = (number for number, (_, near_it) in enumerate(unfinished) if place not in near_it)
        number = next(fitting, len(unfinished))
        if number == len(unfinished):
            unfinished.append(([], set()))
        batch, near_it = unfinished[number]
        batch.append(place)
        near_it.update(near[place].tolist())
        if len(batch) == size:
            full.append(unfinished.pop(number)[0])
    return np.array(full, np.int64).reshape(-1, size)
