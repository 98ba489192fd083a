"""What is in a map: its folders and videos, its additions, and where its images were taken."""

import collections
import datetime
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from crisalad_jax.data.frames import Moment, moment_of, sequence_of

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.map import Map, MapImage


class MapAddition(NamedTuple):
    """Images that were appended to a map from one folder on one day."""

    day: str | None
    """The day, as YYYY-MM-DD in UTC; None where its record says none."""
    root: str
    """The folder that their names are relative to."""
    images: int


def with_addition(
    additions: list[MapAddition], added: str | None, root: str, images: int
) -> list[MapAddition]:
    """Return additions with one more, which counts to the last if that is of its day and root."""
    day = added and added[:10]
    if additions and additions[-1][:2] == (day, root):
        *additions, last = additions
        images += last.images
    return [*additions, MapAddition(day, root, images)]


def contents(places: "Map") -> dict[str, Any]:
    """List what is in a map as JSON values by name.

    Returns:
        `folders`: each folder below a root, or video, with its number of images and, where all of
        their names say times, the first and the last (in seconds of a video, else in UTC);
        `additions`; `extent`: the smallest and the largest of each axis of the positions, or None.
    """
    folders: dict[str, list[Moment | None]] = collections.defaultdict(list)
    for image in places.images:
        moment = moment_of(image.name)
        folders[sequence_of(pathlib.PurePosixPath(image.name))].append(moment)
    return {
        "folders": [
            {"folder": name, "images": len(moments), **_times(moments)}
            for name, moments in folders.items()
        ],
        "additions": [each._asdict() for each in places.additions],
        "extent": _extent(places.images, places.axes),
    }


def _times(moments: Sequence[Moment | None]) -> dict[str, float | str]:
    known = [moment for moment in moments if moment is not None]
    if len(known) < len(moments) or len({moment.clock for moment in known}) > 1:
        return {}
    ends = {"first": min(known), "last": max(known)}
    return {
        name: moment.seconds if moment.clock else _day_and_time(moment.seconds)
        for name, moment in ends.items()
    }


def _day_and_time(seconds: float) -> str:
    when = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    return when.strftime("%Y-%m-%dT%H:%M:%SZ")


def _extent(
    images: Sequence["MapImage"], axes: tuple[str, str] | None
) -> dict[str, list[float]] | None:
    known = [image.position for image in images if image.position is not None]
    if axes is None or not known:
        return None
    columns = zip(*known, strict=True)
    return {axis: [min(each), max(each)] for axis, each in zip(axes, columns, strict=True)}
