"""`crisalad map`."""

import bisect
import collections
import itertools
import pathlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import tyro

from crisalad_jax.cli.common import (
    echo,
    first_of,
    given_positions,
    open_flagged,
    pick,
    refuse_with,
    show_tables,
)
from crisalad_jax.cli.flags import JsonFlag, ModelFlags, PositionFlags, ReadFlags
from crisalad_jax.config.checks import require
from crisalad_jax.experiments.tables import Cell, Table
from crisalad_jax.retrieval.maps.contents import contents
from crisalad_jax.retrieval.maps.corrections import (
    MapChange,
    find_images,
    merge_maps,
    move_images,
    remove_images,
    replace_images,
)
from crisalad_jax.retrieval.maps.map import Map as OpenMap
from crisalad_jax.retrieval.maps.metadata import existing_metadata, model_config, weights_of
from crisalad_jax.utils.output import counted


class Map(ReadFlags, ModelFlags, PositionFlags, JsonFlag):
    """List what is in a map; remove, replace or move some of its images; or merge maps.

    Each change is atomic, even if the process is killed (docs/how-to/correct-a-map.md).
    """

    action: Annotated[
        tyro.conf.Positional[Literal["list", "remove", "replace", "move", "merge"]],
        tyro.conf.arg(metavar="{list,remove,replace,move,merge}"),
    ]
    """List folders, days and additions; remove images; replace those whose files in --images have
    changed; move images to --positions; or merge other maps into this or a new one."""
    map: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="MAP")]
    """The map's folder."""
    what: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME|PATTERN|MAP...")
    ] = ()
    """Names of images or patterns such as 'monday/*', for list and remove; other maps, for
    merge."""
    names: bool = False
    """With list: also print the names of the images."""
    addition: int | None = None
    """With list and remove: only images of this addition (what was added from one folder on one
    day), numbered as in `list`."""
    day: str | None = None
    """With list and remove: only images that were added on this day, as YYYY-MM-DD (UTC)."""
    store: str | None = None
    """With merge: where a new map stores descriptors, files or milvus:URI as in `index`."""
    images: pathlib.Path | None = None
    """With replace: source of the changed images, under the same names, as in `crisalad index`."""
    fps: float | None = None
    """With replace: frames per second from a video, by default 1."""


_FLAGS = {
    "list": ("names", "addition", "day"),
    "remove": ("addition", "day"),
    "replace": ("images", "fps", "weights"),
    "move": ("positions", "start_time", "time_offset"),
    "merge": ("store",),
}
"""The flags that only some actions have, by action."""


def needs_jax(arguments: Map) -> bool:
    """Return whether the command describes images with JAX."""
    return arguments.action == "replace" and arguments.runtime == "jax"


def run(arguments: Map) -> dict[str, Any]:
    """List or change the map, and print what was found or done; return the result for --json."""
    action = f"map {arguments.action}"
    others = {*itertools.chain(*_FLAGS.values())} - {*_FLAGS[arguments.action]}
    refuse_with(action, **pick(arguments, *sorted(others)))
    if arguments.action in ("replace", "move"):
        require(not arguments.what, f"{action}: found {arguments.what[:1]}, expected no names")
    if arguments.action == "list":
        return _list(arguments)
    change = _CHANGES[arguments.action](arguments)
    echo(f"{arguments.map}: {'; '.join(_words(change, arguments.action))}")
    return {"map": str(arguments.map), "action": arguments.action, **change._asdict()}


def _list(arguments: Map) -> dict[str, Any]:
    with OpenMap.open(arguments.map, verify=False, calibrated=False) as places:
        numbers, _ = find_images(places, arguments.what, arguments.addition, arguments.day)
        chosen = [places.images[number] for number in numbers]
        found = {
            "map": str(arguments.map),
            "images": len(chosen),
            "removed": len(places.removed.rows),
            "axes": places.axes,
            **contents(places, chosen),
        }
        ends = list(itertools.accumulate(each.images for each in places.additions))
    counts = collections.Counter(bisect.bisect(ends, number) for number in numbers)
    found["additions"] = [
        {"addition": index + 1, **each, "images": counts[index]}
        for index, each in enumerate(found["additions"])
    ]
    show_tables(
        _table(found["folders"], "folder", "images", "first", "last"),
        _table(found["additions"], "addition", "images", "day", "root"),
    )
    if arguments.names:
        found["names"] = [image.name for image in chosen]
        echo("\n".join(found["names"]))
    echo(f"{arguments.map}: {counted(len(chosen), 'image')}; {found['removed']} removed before")
    return found


def _table(rows: Sequence[dict[str, Any]], *columns: str) -> Table:
    cells = [[Cell(str(each.get(name) or "-")) for name in columns] for each in rows]
    return Table(columns, cells)


def _replace(arguments: Map) -> MapChange:
    out, images = arguments.map, arguments.images
    require(images is not None, "--images: found none, expected the folder of changed images")
    metadata = existing_metadata(out)
    weights = None if arguments.weights else weights_of(metadata, out)
    model, _, file = open_flagged(arguments, weights, like=model_config(metadata, out))
    assert images is not None
    more = pick(arguments, "fps", "reading")
    return replace_images(model, images, out, weights=file, **more)


def _move(arguments: Map) -> MapChange:
    positions = given_positions(arguments)
    require(positions is not None, "--positions: found none, expected a table of new positions")
    assert positions is not None
    return move_images(arguments.map, positions)


_CHANGES = {
    "remove": lambda given: remove_images(
        given.map, given.what, addition=given.addition, day=given.day
    ),
    "replace": _replace,
    "move": _move,
    "merge": lambda given: merge_maps(given.map, *given.what, store=given.store, quiet=given.quiet),
}
_DONE = {
    "remove": ("removed", "were removed before"),
    "replace": ("replaced", "have not changed"),
    "move": ("moved", "have these positions already"),
    "merge": ("added", "were there already"),
}
"""Text for images that an action changed, and for those that it did not need to."""


def _words(change: MapChange, action: str) -> list[str]:
    """Describe what became of the images in clauses; empty groups are left out."""
    done, there = _DONE[action]
    unmatched, unreadable = change.unmatched, change.unreadable
    fates = (
        (change.there, there),
        (change.stay_out, "were removed from this map and stay out"),
        (len(unmatched), f"are not in the map, {first_of(unmatched)}"),
        (len(unreadable), f"unreadable left unchanged, {first_of(unreadable)}"),
    )
    words = [
        f"{counted(len(change.names), 'image')} {done}" if change.names else "nothing to do",
        *(f"{count} {fate}" for count, fate in fates if count),
        f"{counted(change.images, 'image')} now",
    ]
    if change.stale_search is not None:
        kind = change.stale_search
        words.append(f"searched exactly until `crisalad index --search {kind}` builds it again")
    return words
