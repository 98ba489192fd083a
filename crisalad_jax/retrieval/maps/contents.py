"""What is in a map: its folders and videos, its additions, and where its images were taken."""

import collections
import datetime
import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from crisalad_jax.data.video import Moment, moment_of

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.map import Map, MapImage


def contents(places: "Map") -> dict[str, Any]:
    """List what is in a map as JSON values by name.

    Returns:
        `folders`: each folder below a root, or video, with its number of images and, where all of
        their names say times, the first and the last (in seconds of a video, else in UTC);
        `additions`: the numbers of images that were appended one after the other on a day, in UTC,
        from one root; `extent`: the smallest and largest of each axis of the positions, or None.
    """
    folders: dict[str, list[Moment | None]] = collections.defaultdict(list)
    for image in places.images:
        moment = moment_of(image.name)
        video = moment.clock if moment else ""
        folders[video or pathlib.PurePosixPath(image.name).parent.as_posix()].append(moment)
    return {
        "folders": [
            {"folder": name, "images": len(moments), **_times(moments)}
            for name, moments in folders.items()
        ],
        "additions": [
            {"day": day, "root": root, "images": sum(len(each["names"]) for each in records)}
            for (day, root), records in itertools.groupby(places.records, _day_and_root)
        ],
        "extent": _extent(places.images, places.axes),
    }


def _day_and_root(record: Mapping[str, Any]) -> tuple[str | None, str]:
    return record["added"] and record["added"][:10], record["root"]


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
