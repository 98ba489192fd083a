"""Sources of images: a folder, a file, a pattern, a list, a table, a video or a robot log."""

import collections
import glob
import math
import os
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Self

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import (
    check_rate,
    file_of,
    has_frames,
    is_log,
    is_video,
    parse_frame,
    sequence_of,
    stored_bytes,
)
from crisalad_jax.data.images import (
    OnBadImage,
    images_below,
    is_image,
    list_images,
    names_in,
    only_images,
)
from crisalad_jax.data.logs import list_log_frames, name_log_frame
from crisalad_jax.data.metres import on_ellipsoid
from crisalad_jax.data.positions import (
    AXES,
    Positions,
    exif_positions,
    positions_of,
    read_image_table,
    utm_positions,
)
from crisalad_jax.data.remote import address_of, check_address, is_remote, list_remote
from crisalad_jax.data.tables import Disk
from crisalad_jax.data.tracks import Track
from crisalad_jax.data.video import count_frames, list_frames, name_frame
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_source, read_text, real_path
from crisalad_jax.utils.output import warn

_FORMS = (
    "a folder of images, an image, a video, a ROS bag, a pattern such as 'frames/*.jpg', a list "
    "(.txt) or a table (.csv)"
)
_ROUNDING = 1e-3
"""Metres by which rounding may bring two positions closer together."""
_PATTERN = re.compile(r"[*?\[]")


@brief
class ImageSource(NamedTuple):
    """Images in order, and their names in descriptor files and maps."""

    root: pathlib.Path
    """Folder that the names are relative to; an address if the source is remote."""
    paths: list[pathlib.Path]
    """Files below the root; frames of videos and logs are named as in `data.frames`."""
    names: list[str]
    """Posix paths relative to the root, each once, in the order of `paths`."""
    positions: Positions | None = None
    """Positions from the columns of a table or a topic of a robot log; None without these."""

    def located(self, given: Positions | Track | str | os.PathLike[str] | None = None) -> Positions:
        """Return where the images were taken, as far as known.

        Args:
            given: positions by name, or a track, or their file (`positions_of`). None takes those
                of the source, else those in @UTM names, else those in the EXIF data of JPEGs.

        Raises:
            InputError: `given` is not valid, or has no position of these images.
        """
        if given is not None:
            return positions_of(given, self.names, self.paths, self.root)
        found = self.positions or utm_positions(self.names)
        each = zip(self.names, self.paths, strict=True)
        pictures = ((name, path) for name, path in each if parse_frame(path) is None)
        return found if found.of else exif_positions(pictures)

    def spaced(self, positions: Positions, metres: float) -> Self:
        """Leave out images closer than `metres` to the last one retained of the same sequence.

        A sequence is the images of a folder, a video or a topic of a log, in order. Images without
        a position stay.

        Args:
            positions: where the images were taken.
            metres: the smallest distance in metres between consecutive images.

        Raises:
            InputError: `metres` is not a distance, or no image has a position.
        """
        if not 0 < metres < math.inf:
            raise InputError(f"--every-metres: found {metres:g}, expected metres above 0")
        names = [name for name in self.names if name in positions.of]
        if not names:
            raise InputError(
                f"--every-metres: found no position of the {len(self.names)} images of "
                f"{self.root}, expected some (--positions)"
            )
        points = np.array([positions.of[name] for name in names], np.float64)
        if positions.axes == AXES[1]:
            points = on_ellipsoid(*points.T)
        point_of = dict(zip(names, points, strict=True))
        last: dict[str, np.ndarray] = {}
        kept: list[int] = []
        for number, (name, path) in enumerate(zip(self.names, self.paths, strict=True)):
            point, sequence = point_of.get(name), sequence_of(path)
            if point is None:
                kept.append(number)
            elif sequence not in last or math.dist(point, last[sequence]) >= metres - _ROUNDING:
                kept.append(number)
                last[sequence] = point
        paths, names = ([of[number] for number in kept] for of in (self.paths, self.names))
        return self._replace(paths=paths, names=names)


def open_source(
    images: str | os.PathLike[str],
    *,
    fps: float | None = None,
    topic: str | None = None,
    position_topic: str | None = None,
    on_bad_image: OnBadImage = "stop",
) -> ImageSource:
    """List the images of a source.

    Args:
        images: a folder, searched with its subfolders; an image; a video; a robot log (`open_log`);
            a pattern, where ** matches any folders; a list (.txt) with one path per line; or a
            table (.csv) with a column `name` (see `read_image_table`). Paths in lists and tables
            are relative to their folder.
        fps: frames per second to take from videos and logs; None is 1, with a warning.
        topic: the topic of images in logs; None takes the only one.
        position_topic: the topic of positions in logs; None takes the only one of NavSatFix, else
            the only one of odometry or poses; "none" takes none.
        on_bad_image: "stop" refuses missing files; "skip" lists them like the others, to be left
            out by the function that reads them.

    Returns:
        The images. Names are relative to the given folder; to the folder of a file; to the part of
        a pattern before its first wildcard; or to the folder of a list or table (if a path leads
        out of that folder, to the root of the file system).

    Raises:
        InputError: the source is missing or has no image; a path is repeated; a file is missing; or
            a name does not fit in one line of text.
    """
    if not os.fspath(images):
        raise InputError(f"images: found an empty name, expected {_FORMS}")
    check_rate(1.0 if fps is None else fps)
    path = pathlib.Path(images)
    if is_remote(path):
        return _remote(path)
    frames = _Frames(path, fps, topic, position_topic)
    if path.is_dir() and is_log(path):
        path = path if path.name.strip(".") else pathlib.Path(os.path.abspath(path))
        return _taken(path.parent, frames, [path], on_bad_image)
    if path.is_dir():
        return _source(path, list_images(path), path)
    suffix = path.suffix.lower()
    if suffix == ".txt":
        text = read_text(path, "a list of images, a path a line")
        names = [line.strip() for line in text.splitlines() if line.strip()]
        return _listed(path, names, None, frames, on_bad_image)
    if suffix == ".csv":
        return _listed(path, *read_image_table(path), frames, on_bad_image)
    root, found = file_of(path).parent, [path]
    if _PATTERN.search(str(path)) and not path.exists() and parse_frame(path) is None:
        root, found = _matching(path)
    skips: OnBadImage = on_bad_image if suffix else "stop"  # a folder is not an image to skip
    return _taken(root, frames, found, skips)


def _remote(path: pathlib.Path) -> ImageSource:
    """List the images at an address: a single one, or those of a folder or a pattern.

    Raises:
        InputError: there are none.
    """
    check_address(path)
    if is_image(path) and not _PATTERN.search(str(path)):
        return _source(path.parent, [path], path)
    root, pattern = (_before_pattern(path), path) if _PATTERN.search(str(path)) else (path, None)
    return _source(root, images_below(root, list_remote(root, pattern), path), path)


def open_sources(
    images: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    fps: float | None = None,
    topic: str | None = None,
    position_topic: str | None = None,
    on_bad_image: OnBadImage = "stop",
) -> list[ImageSource]:
    """List the images of one or several sources, each as `open_source` does.

    Raises:
        InputError: no source is given, an option has no effect, or `open_source` refuses a source.
    """
    given = [images] if isinstance(images, str | os.PathLike) else list(images)
    if not given:
        raise InputError("images: found none, expected at least one image")
    how = {"fps": fps, "topic": topic, "position_topic": position_topic}
    sources = [open_source(each, **how, on_bad_image=on_bad_image) for each in given]
    check_frames([path for source in sources for path in source.paths], **how)
    return sources


def join_sources(sources: Sequence[ImageSource]) -> ImageSource:
    """Join the images of several sources.

    Args:
        sources: sources from `open_sources`.

    Returns:
        A single source, unchanged. Images of several sources appear once each, named relative to a
        common folder, and have positions if all known positions share their axes and zone.

    Raises:
        InputError: there are several sources, and one of them is at an address.
    """
    if len(sources) == 1:
        return sources[0]
    far = [address_of(source.root) for source in sources if is_remote(source.root)]
    if far:
        raise InputError(f"--images: found {', '.join(far)} among several sources, expected one")
    placed: dict[pathlib.Path, tuple[float, float] | None] = {}
    for source in sources:
        of = {} if source.positions is None else source.positions.of
        for name in source.names:
            placed.setdefault(real_path(source.root) / name, of.get(name))
    root = pathlib.Path(os.path.commonpath([real_path(each.root) for each in sources]))
    names = names_in(root, list(placed))
    known = [each.positions for each in sources if each.positions is not None]
    kinds = {(each.axes, each.zone) for each in known}
    of = {name: at for name, at in zip(names, placed.values(), strict=True) if at is not None}
    positions = known[0]._replace(of=of) if len(kinds) == 1 and of else None
    return ImageSource(root, list(placed), names, positions)


class _Frames(NamedTuple):
    """Options for the frames to take from videos and logs."""

    given: pathlib.Path
    """What the user named, for messages."""
    fps: float | None
    topic: str | None
    position_topic: str | None

    def of(
        self, found: Sequence[pathlib.Path], expected: str, on_bad_image: OnBadImage
    ) -> tuple[list[pathlib.Path], Positions | None]:
        """Replace videos and logs with their frames, and name single frames by their actual times.

        Under "skip", missing files stay in the list, to be skipped when they are read.

        Returns:
            The images, and the positions that logs have of them, by path.
        """
        paths: list[pathlib.Path] = []
        positions: Positions | None = None
        taken = there = 0
        rate = 1.0 if self.fps is None else self.fps
        for path in found:
            file, frame = file_of(path), parse_frame(path)
            if on_bad_image == "skip" and stored_bytes(file) is None:
                paths.append(path)
                continue
            if not (file.is_dir() and is_log(file)):
                check_source(file, expected)
            if frame is not None:
                paths.append(name_frame(frame) if frame.topic is None else name_log_frame(frame))
            elif is_video(path):
                frames = list_frames(path, rate)
                taken, there = taken + len(frames), there + count_frames(path)
                paths += frames
            elif is_log(path):
                listed = list_log_frames(
                    path, rate, topic=self.topic, position_topic=self.position_topic
                )
                taken, there = taken + len(listed.paths), there + listed.there
                paths += listed.paths
                positions = _joined(positions, listed.positions, path)
            else:
                paths.append(path)
        if self.fps is None and taken < there:
            warn(f"{self.given}: took {taken} of {there} frames, 1 per second (--fps)")
        return paths, positions


def _joined(
    positions: Positions | None, more: Positions | None, path: pathlib.Path
) -> Positions | None:
    """Add the positions of a log to those of earlier logs."""
    if positions is None or more is None:
        return positions or more
    if positions.axes != more.axes:
        raise InputError(
            f"{path}: found positions in {', '.join(more.axes)}, expected "
            f"{', '.join(positions.axes)} as in the logs before it (--position-topic)"
        )
    return positions._replace(of=positions.of | more.of)


def check_frames(
    paths: Iterable[pathlib.Path],
    *,
    fps: float | None = None,
    topic: str | None = None,
    position_topic: str | None = None,
) -> None:
    """Check that options for choosing frames are given only if some image is a frame.

    Args:
        paths: the images of all sources.
        fps: frames per second; None if not given.
        topic: the topic of images in a log; None if not given.
        position_topic: the topic of positions in a log; None if not given.

    Raises:
        InputError: an option has no effect.
    """
    if (fps, topic, position_topic) == (None, None, None):
        return
    frames = [frame for frame in map(parse_frame, paths) if frame is not None]
    if fps is not None and not frames:
        raise InputError(f"--fps: found {fps:g} without a video among the images, expected both")
    for flag, value in (("--topic", topic), ("--position-topic", position_topic)):
        if value not in (None, "none") and not any(frame.topic for frame in frames):
            raise InputError(f"{flag}: found {value} without a ROS bag among the images")


def _taken(
    root: pathlib.Path, frames: _Frames, found: list[pathlib.Path], on_bad_image: OnBadImage
) -> ImageSource:
    paths, positions = frames.of(found, _FORMS, on_bad_image)
    return _source(root, paths, frames.given, positions, map(str, paths))


def _source(
    root: pathlib.Path,
    paths: list[pathlib.Path],
    given: pathlib.Path,
    positions: Positions | None = None,
    keys: Iterable[str] = (),
) -> ImageSource:
    """Name the images; `positions` refers to them by `keys`."""
    names = names_in(root, paths)
    twice = [name for name, count in collections.Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{given}: found {twice[0]!r} twice, expected it once")
    if positions is not None:
        own = dict(zip(keys, names, strict=True))
        of = {own[key]: position for key, position in positions.of.items()}
        positions = positions._replace(of=of) if of else None
    return ImageSource(root, paths, names, positions)


def _before_pattern(pattern: pathlib.Path) -> pathlib.Path:
    """Return the folder before a pattern's first wildcard."""
    parts = pattern.parts
    first = next(number for number, part in enumerate(parts) if _PATTERN.search(part))
    return pathlib.Path(*parts[:first])


def _matching(pattern: pathlib.Path) -> tuple[pathlib.Path, list[pathlib.Path]]:
    """Find the images, videos and logs of a pattern, and the folder before its first wildcard."""
    root = _before_pattern(pattern)
    matches = [pathlib.Path(match) for match in glob.glob(str(pattern), recursive=True)]
    files = [match for match in matches if match.is_file() or is_log(match)]
    found = only_images(files, pattern, frames=True)
    return root, sorted(found, key=lambda match: match.relative_to(root).as_posix())


def _listed(
    source: pathlib.Path,
    names: Sequence[str],
    positions: Positions | None,
    frames: _Frames,
    on_bad_image: OnBadImage,
) -> ImageSource:
    """List the images that a list or table names; positions are by the names in that file."""
    if any(map(is_remote, names)):
        root, paths = _addresses(source, names)
        return _source(root, paths, source, positions, names)
    folder, disk = source.parent, Disk()
    found: list[pathlib.Path] = []
    for name in names:
        # Normalised, so that names contain no .., and repeated paths are found.
        text = os.path.normpath(name)
        file = os.fspath(file_of(text))
        path = disk.find(folder, file) or folder / file
        found.append(pathlib.Path(os.path.normpath(f"{path}{text[len(file) :]}")))
    whole = next(filter(has_frames, found), None) if positions is not None else None
    if not found or whole is not None:
        kind = "video" if whole is not None and is_video(whole) else "ROS bag"
        words = "no image" if whole is None else f"the {kind} {whole}"
        raise InputError(f"{source}: found {words}, expected images or frames like walk.mp4#t=12.5")
    try:
        paths, of_logs = frames.of(found, "an image file", on_bad_image)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    if positions is None:
        positions, names = of_logs, list(map(str, paths))
    root = pathlib.Path(os.path.normpath(folder))
    below = [path.relative_to(root).parts for path in paths if path.is_relative_to(root)]
    if len(below) < len(paths) or any(".." in parts for parts in below):
        paths = [pathlib.Path(os.path.abspath(path)) for path in paths]
        root = pathlib.Path(paths[0].anchor)
    return _source(root, paths, source, positions, names)


def _addresses(
    source: pathlib.Path, names: Sequence[str]
) -> tuple[pathlib.Path, list[pathlib.Path]]:
    """Return the paths of addresses in a list or table, and their host or bucket.

    Raises:
        InputError: some are not images at addresses, or not all are of one host or bucket.
    """
    paths = list(map(pathlib.Path, names))
    for path in paths:
        check_address(path)
    other = next((path for path in paths if not is_remote(path) or has_frames(path)), None)
    if other is not None:
        raise InputError(f"{source}: found {other} among addresses, expected images at addresses")
    roots = sorted({pathlib.Path(*path.parts[:2]) for path in paths})
    if len(roots) > 1:
        raise InputError(
            f"{source}: found addresses of {address_of(roots[0])} and {address_of(roots[1])}, "
            "expected those of one host or bucket"
        )
    return roots[0], paths
