"""Training places: read from a layout such as GSV-Cities', or grouped by position or order."""

import dataclasses
import functools
import itertools
import math
import os
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks.msls import is_msls
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.named_places import COLUMNS as COLUMNS
from crisalad_jax.data.named_places import (
    TABLE,
    FoundPlace,
    places_by_order,
    places_by_position,
    read_gsv_cities,
    read_msls_places,
    read_named_places,
)
from crisalad_jax.data.remote import address_of, check_address, is_file, is_folder
from crisalad_jax.data.sources import ImageSource, check_frames, open_source
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64, Int32, Int64


@brief
@dataclasses.dataclass(frozen=True, eq=False)
class Places:
    """Images grouped by place: place p has the images `place_start[p]:place_start[p + 1]`.

    Example:
        >>> found = read_places(places, min_images=2)
        >>> len(found.names), found.image_counts[:2].tolist(), found.path(0).exists()
        (8, [3, 3], True)
    """

    root: pathlib.Path
    cities: tuple[str, ...]
    files: tuple[str, ...]
    """Paths of the images relative to `root`, as text: a Path takes ten times the memory."""
    place_start: Int64[np.ndarray, " places+1"]
    place_city: Int32[np.ndarray, " places"]
    """Index in `cities` of each place, ascending."""
    names: tuple[str, ...]
    """Name of each place."""
    views: Float64[np.ndarray, "images 3"] | None = None
    """Latitude, longitude and heading of each image in degrees; NaN for an unknown heading."""
    near: tuple[Int64[np.ndarray, " _"], ...] | None = None
    """For each place, the places too close to share a batch with it; None if any two places may."""

    @property
    def image_counts(self) -> Int64[np.ndarray, " places"]:
        """Number of images of each place."""
        return np.diff(self.place_start)

    @functools.cached_property
    def image_place(self) -> Int32[np.ndarray, " images"]:
        """Index of each image's place, ascending."""
        return np.repeat(np.arange(len(self.names), dtype=np.int32), self.image_counts)

    def path(self, image: int | np.integer) -> pathlib.Path:
        """Return the path of one image."""
        return self.root / self.files[image]


@dataclasses.dataclass(frozen=True, eq=False)
class JoinedPlaces:
    """The images of several training sets, numbered consecutively."""

    sets: tuple[Places, ...]

    @functools.cached_property
    def starts(self) -> Int64[np.ndarray, " sets+1"]:
        """Index of each set's first image, then the total number of images."""
        return np.cumsum([0, *(len(each.files) for each in self.sets)], dtype=np.int64)

    @property
    def files(self) -> Iterator[str]:
        """All images' paths, each relative to its set's root."""
        return itertools.chain.from_iterable(each.files for each in self.sets)

    def path(self, image: int | np.integer) -> pathlib.Path:
        """Return the path of one image."""
        number = int(np.searchsorted(self.starts, image, side="right")) - 1
        return self.sets[number].path(image - self.starts[number])


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
    topic: str | None = None,
    on_bad_image: OnBadImage = "stop",
) -> Places:
    """Read training places in a layout (GSV-Cities, MSLS or custom), or group images into places.

    `place_radius` or `place_frames` groups the images of any source into places, by position or
    order. Such places that are too close to tell apart (`Places.near`) never share a batch.

    A custom layout is a folder in which each folder with images is a place; or a table with the
    columns `name,place` and, if known, `lat,lon`, `heading` (all in degrees) and `city`. The table
    is `root` itself, or `places.csv` in `root`. Names are relative to the table. With several
    cities, or scenes, in a table, names of places only need to be unique within each.

    Places of MSLS are the clusters of its tables (`unique_cluster`), with the images of the
    database and of the queries, without panoramas.

    GSV-Cities' images may end in .jpg or .JPG, and may be in a folder named after the city id or
    the CSV file. A row that repeats an earlier one of its place is dropped.

    Args:
        root: folder that holds `Dataframes/` and `Images/`, or a custom layout, local or at an
            address such as s3://bucket/places (not MSLS); with `place_radius` or `place_frames` a
            source of images (`open_source`).
        cities: names of CSV files without the suffix, or of MSLS's folders; None reads all, or for
            MSLS those of its training set.
        min_images: places with fewer images are left out, and a warning counts them.
        place_radius: radius of a place in metres. In order, each image that is farther than this
            from all previous centres becomes a centre; then each image joins the place with the
            nearest centre. Centres in a batch are more than four radii apart.
        place_frames: number of consecutive images of a folder, or frames of a video, that make a
            place. Consecutive places never share a batch.
        positions: table or track of positions for `place_radius` (`read_image_table`,
            `read_track`). None takes those of the source if it is a table or a robot log, else
            those in @UTM names, else the EXIF data of JPEGs.
        fps: frames per second to take from videos and logs; None is 1.
        topic: the topic of images in a robot log; None takes the only one.
        on_bad_image: "stop" if an image that a table names is missing, or "skip" it.

    Returns:
        The places, with their image files.

    Raises:
        InputError: `root` has none of these layouts; a city is unknown or repeated; a table lacks a
            column or has a field that is not a number; an image is missing; no place has enough
            images; no image has a position; or arguments conflict.

    Example:
        >>> read_places(places, min_images=3).image_counts.tolist()
        [3, 3, 3, 3, 3, 3, 3, 3]
    """
    root = pathlib.Path(root)
    check_address(root)
    is_gsv = is_folder(root / "Dataframes")
    has_cities = is_gsv or (is_msls(root) and not is_file(root / TABLE))
    groupings = (place_radius is not None) + (place_frames is not None)
    if (
        groupings + has_cities > 1
        or (positions is not None and place_radius is None)
        or ((fps, topic) != (None, None) and not groupings)
        or (cities is not None and not has_cities)
    ):
        raise InputError(
            f"{address_of(root)}: found conflicting arguments, expected --cities "
            "for the layout of GSV-Cities or MSLS; for other images --place-radius, perhaps with "
            "--positions, or --place-frames, and --fps or --topic with either"
        )
    check_grouping(place_radius, place_frames)
    names: tuple[str, ...] = ()
    if is_gsv:
        names, found = read_gsv_cities(root, cities, on_bad_image)
    elif has_cities:
        names, found = read_msls_places(root, cities, on_bad_image)
    elif groupings:
        source = open_source(root, fps=fps, topic=topic, on_bad_image=on_bad_image)
        check_frames(source.paths, fps=fps, topic=topic)
        return group_images(source, place_radius, place_frames, positions, min_images=min_images)
    else:
        root, names, found = read_named_places(root, on_bad_image)
    return _places(root, names or (real_path(root).name,), found, min_images)


def check_grouping(place_radius: float | None, place_frames: int | None) -> None:
    """Check the arguments that group images into places; see `read_places`.

    Raises:
        InputError: the radius is not a distance above 0, or `place_frames` is below 2.
    """
    if place_radius is not None and not 0 < place_radius < math.inf:
        raise InputError(f"--place-radius: found {place_radius:g}, expected metres above 0")
    if place_frames is not None and place_frames < 2:
        raise InputError(f"--place-frames: found {place_frames}, expected at least 2")


def group_images(
    source: ImageSource,
    place_radius: float | None = None,
    place_frames: int | None = None,
    positions: str | os.PathLike[str] | None = None,
    *,
    min_images: int = 1,
) -> Places:
    """Make places from a source's images, by position or order, or one place per image.

    Args:
        source: the images.
        place_radius: see `read_places`, also for the arguments below.
        place_frames: number of consecutive images.
        positions: table or track; None takes the positions of the source.
        min_images: places with fewer images are left out.

    Raises:
        InputError: no image has a position, or no place is large enough.
    """
    if place_radius is not None:
        found = places_by_position(source, place_radius, positions)
    elif place_frames is not None:
        found = places_by_order(source, place_frames)
    else:
        found = [FoundPlace(name, {name: None}) for name in source.names]
    return _places(source.root, (real_path(source.root).name,), found, min_images)


def _places(
    root: pathlib.Path, cities: tuple[str, ...], found: Sequence[FoundPlace], min_images: int
) -> Places:
    """Make `Places` from those that are large enough."""
    large = {i: place for i, place in enumerate(found) if len(place.images) >= min_images}
    if not large:
        most = max((len(place.images) for place in found), default=0)
        raise InputError(
            f"{address_of(root)}: found no place with at least {min_images} images; the largest "
            f"has {most}, of {len(found)} places (--place-radius, --place-frames, --min-images)"
        )
    if len(large) < len(found):
        warn(
            f"{address_of(root)}: left out {len(found) - len(large)} of {len(found)} places, "
            f"with fewer than {min_images} images"
        )
    images = [each for place in large.values() for each in place.images.items()]
    views = [view for _, view in images if view is not None]
    counts = [len(place.images) for place in large.values()]
    number = {old: new for new, old in enumerate(large)}
    near = tuple(
        np.array([number[other] for other in place.near if other in number], np.int64)
        for place in large.values()
    )
    return Places(
        root=root,
        cities=cities,
        files=tuple(file for file, _ in images),
        place_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        place_city=np.array([place.city for place in large.values()], np.int32),
        names=tuple(place.name for place in large.values()),
        views=np.array(views) if views else None,
        near=near if any(place.near for place in found) else None,
    )
