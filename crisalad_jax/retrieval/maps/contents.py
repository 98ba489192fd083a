"""Contents of a map: its folders and videos, its additions, and where its images were taken."""

import collections
import datetime
import functools
import itertools
import operator
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from crisalad_jax.data.frames import Moment, moment_of, sequence_of

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.images import Images, MapImage
    from crisalad_jax.retrieval.maps.map import Map


class MapAddition(NamedTuple):
    """Images that were appended to a map from one folder on one day."""

    day: str | None
    """The day, as YYYY-MM-DD in UTC; None if it was not recorded."""
    root: str
    """The folder that names of its images are relative to."""
    images: int
    """Number of its images that have not been removed."""


def additions_of(images: "Images") -> list[MapAddition]:
    """Group a map's images into additions: consecutive ones of the same day and folder."""
    counts = np.diff(images.starts).tolist()
    days = ((part.added and part.added[:10], part.root) for part in images.parts)
    return [
        MapAddition(day, root, sum(count for _, count in some))
        for (day, root), some in itertools.groupby(
            zip(days, counts, strict=True), key=operator.itemgetter(0)
        )
    ]


def contents(places: "Map", chosen: "Sequence[MapImage] | None" = None) -> dict[str, Any]:
    """List the contents of a map as JSON values by name.

    Args:
        places: the map.
        chosen: images to which `folders` and `extent` are limited; None is all.

    Returns:
        `folders`: each folder below a root, or video, with its number of images and, if all their
        names contain times, the first and last time (seconds into a video, else UTC); `additions`:
        see `Map.additions`; `extent`: the minimum and maximum position on each axis, or None.
    """
    folders: dict[str, list[Moment | None]] = collections.defaultdict(list)
    images = places.images if chosen is None else chosen
    for image in images:
        moment = moment_of(image.name)
        folders[sequence_of(pathlib.PurePosixPath(image.name))].append(moment)
    return {
        "folders": [
            {"folder": name, "images": len(moments), **_times(moments)}
            for name, moments in folders.items()
        ],
        "additions": [each._asdict() for each in places.additions],
        "extent": _extent(images, places.axes),
    }


def _times(moments: Sequence[Moment | None]) -> dict[str, float | str]:
    known = [moment for moment in moments if moment is not None]
    if len(known) < len(moments) or len({moment.clock for moment in known}) > 1:
        return {}
    ends = {"first": min(known), "last": max(known)}
    if known[0].clock:
        return {name: moment.seconds for name, moment in ends.items()}
    utc = functools.partial(datetime.datetime.fromtimestamp, tz=datetime.UTC)
    return {name: f"{utc(moment.seconds):%Y-%m-%dT%H:%M:%SZ}" for name, moment in ends.items()}


def _extent(
    images: Sequence["MapImage"], axes: tuple[str, str] | None
) -> dict[str, list[float]] | None:
    known = [image.position for image in images if image.position is not None]
    if axes is None or not known:
        return None
    columns = zip(*known, strict=True)
    return {axis: [min(each), max(each)] for axis, each in zip(axes, columns, strict=True)}
