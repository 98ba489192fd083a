"""Divide images into training places: by where they were taken, or by their order.

No two images of one batch are negatives of each other while they are as near as two images of one
place may be: places that are too near for that are listed as such, and do not meet in a batch.
"""

import collections
import itertools
import math
import os
import pathlib

import numpy as np

from crisalad_jax.data.exif import exif_positions
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.own_places import OwnPlaces
from crisalad_jax.data.positions import AXES, Positions, positions_of, utm_positions
from crisalad_jax.data.sources import ImageSource, check_rate_used, open_source
from crisalad_jax.data.video import file_of, frame_time
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64, Int64

_APART = 4
"""Radii between the centres of two places of a batch, at least. Images of one place are at most two
radii apart, and so those of two places are no nearer."""


def places_by_position(
    root: pathlib.Path,
    radius: float,
    positions: str | os.PathLike[str] | None,
    fps: float | None,
    on_bad_image: OnBadImage,
) -> OwnPlaces:
    """Group images into places of a radius, each called by the name of the image at its centre.

    In the order of the images, one that is farther than the radius from all centres becomes a
    centre. Then every image is of the place with the nearest centre.

    Args:
        root: a source of images (`open_source`).
        radius: in metres.
        positions: a table (`read_positions`); None is what the source says, if that is a table,
            else what @UTM names say, else the EXIF data of JPEGs.
        fps: frames a second of videos.
        on_bad_image: as of `open_source`.

    Raises:
        InputError: the radius is not above 0; no image has a position; or what `open_source` and
            `read_positions` raise.
    """
    if not 0 < radius < math.inf:
        raise InputError(f"--place-radius: found {radius:g}, expected metres above 0")
    source = _open(root, fps, on_bad_image)
    found = _positions(source, root, positions)
    names = [name for name in source.names if name in found.of]
    if not names:
        raise InputError(
            f"{root}: found no position of {len(source.names)} images, which --place-radius asks "
            "for, expected --positions TABLE (name,lat,lon or name,east,north or name,x,y), such a "
            "table as --data, @UTM names or EXIF data; --place-frames takes images in order"
        )
    if len(names) < len(source.names):
        warn(
            f"{root}: left out {len(source.names) - len(names)} of {len(source.names)} images, "
            "which have no position"
        )
    points = _points(found, names)
    centres = _centres(points, radius)
    place, near = _nearest(points, centres, radius)
    images: dict[str, list[str]] = {names[centre]: [] for centre in centres}
    called = list(images)
    for name, number in zip(names, place, strict=True):
        images[called[number]].append(name)
    neighbours = {
        name: [called[other] for other in others] for name, others in zip(called, near, strict=True)
    }
    return OwnPlaces(source.root, images, None, neighbours)


def places_by_order(
    root: pathlib.Path, frames: int, fps: float | None, on_bad_image: OnBadImage
) -> OwnPlaces:
    """Make a place of every so many images of a folder or video in order, called by the first one.

    A place and the next one of the same folder or video are too near for one batch.

    Args:
        root: a source of images (`open_source`).
        frames: number of images of a place.
        fps: frames a second of videos.
        on_bad_image: as of `open_source`.

    Raises:
        InputError: less than two frames, or what `open_source` raises.
    """
    if frames < 2:
        raise InputError(f"--place-frames: found {frames}, expected at least 2")
    source = _open(root, fps, on_bad_image)
    sequences: dict[pathlib.Path, list[str]] = collections.defaultdict(list)
    for path, name in zip(source.paths, source.names, strict=True):
        sequences[path.parent if frame_time(path) is None else file_of(path)].append(name)
    images: dict[str, list[str]] = {}
    near: dict[str, list[str]] = {}
    for sequence in sequences.values():
        parts = [sequence[start : start + frames] for start in range(0, len(sequence), frames)]
        images |= {part[0]: part for part in parts}
        near |= {part[0]: [] for part in parts}
        for (first, *_), (second, *_) in itertools.pairwise(parts):
            near[first].append(second)
            near[second].append(first)
    return OwnPlaces(source.root, images, None, near)


def _open(root: pathlib.Path, fps: float | None, on_bad_image: OnBadImage) -> ImageSource:
    if (root / "Dataframes").is_dir():
        raise InputError(
            f"{root}: found the layout of GSV-Cities, which has places, expected it without "
            "--place-radius and --place-frames"
        )
    source = open_source(root, fps=fps, on_bad_image=on_bad_image)
    check_rate_used(fps, source.paths)
    return source


def _positions(
    source: ImageSource, root: pathlib.Path, table: str | os.PathLike[str] | None
) -> Positions:
    if table is None:
        found = source.positions or utm_positions(source.names)
        pictures = [path for path in source.paths if frame_time(path) is None]
        if found.of or len(pictures) < len(source.paths):
            return found
        return exif_positions(zip(source.names, pictures, strict=True))
    return positions_of(table, source.names, root)


def _points(positions: Positions, names: list[str]) -> Float64[np.ndarray, "images axis"]:
    """Return points in metres whose straight distances are those on the ground."""
    points = np.array([positions.of[name] for name in names], np.float64)
    return comparable(*points.T) if positions.axes == AXES[1] else points


def _centres(
    points: Float64[np.ndarray, "images axis"], radius: float
) -> Int64[np.ndarray, " places"]:
    """Choose images, in their order, that are each farther than the radius from all before."""
    # A centre within the radius is in the same cell of a grid of that side, or beside it.
    beside = list(itertools.product((-1, 0, 1), repeat=points.shape[1]))
    cells: dict[tuple[int, ...], list[int]] = collections.defaultdict(list)
    centres = []
    for image, cell in enumerate(map(tuple, np.floor(points / radius).astype(np.int64).tolist())):
        others = [
            centre
            for step in beside
            for centre in cells.get(tuple(map(sum, zip(cell, step, strict=True))), ())
        ]
        if all(math.dist(points[image], points[other]) > radius for other in others):
            cells[cell].append(image)
            centres.append(image)
    return np.array(centres, np.int64)


def _nearest(
    points: Float64[np.ndarray, "images axis"], centres: Int64[np.ndarray, " places"], radius: float
) -> tuple[Int64[np.ndarray, " images"], list[list[int]]]:
    """Find each image's nearest centre, and the other places that are too near for each place."""
    from scipy.spatial import KDTree  # takes a fifth of a second, which few readers need

    tree = KDTree(points[centres])
    near = tree.query_ball_point(points[centres], _APART * radius, return_sorted=True)
    others = [[each for each in every if each != place] for place, every in enumerate(near)]
    return np.asarray(tree.query(points)[1]), others
