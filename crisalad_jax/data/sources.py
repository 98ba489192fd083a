"""Sources of images: a folder, a file, a pattern, a list, a table or a video."""

import collections
import glob
import os
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import OnBadImage, list_images, names_in, only_images
from crisalad_jax.data.positions import Positions, read_image_table
from crisalad_jax.data.tables import Disk
from crisalad_jax.data.video import (
    check_rate,
    count_frames,
    file_of,
    frame_time,
    is_video,
    list_frames,
    name_frame,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_source, read_text
from crisalad_jax.utils.output import warn

_FORMS = (
    "a folder of images, an image, a video, a pattern such as 'frames/*.jpg', a list (.txt) or a "
    "table (.csv)"
)
_PATTERN = re.compile(r"[*?\[]")


@brief
class ImageSource(NamedTuple):
    """Images in order, and the names that descriptors and maps know them by."""

    root: pathlib.Path
    """Folder that names are relative to."""
    paths: list[pathlib.Path]
    """Below the root; frames of videos under the names of `data.video`."""
    names: list[str]
    """Posix paths relative to the root, each once."""
    positions: Positions | None = None
    """What the columns of a table say; None without such columns."""


def open_source(
    images: str | os.PathLike[str], *, fps: float | None = None, on_bad_image: OnBadImage = "stop"
) -> ImageSource:
    """List the images of a source.

    Args:
        images: a folder, searched with its subfolders; an image; a video; a pattern, where ** is
            any folders; a list, .txt, of a path a line; or a table, .csv, with a column `name`
            (see `read_image_table`). Paths in lists and tables are relative to their folder.
        fps: frames a second taken of videos; None is one, and a note says so.
        on_bad_image: "skip" lists a missing file like the others, and whoever reads it leaves it
            out; "stop" refuses it.

    Returns:
        The images. Names are relative to the folder; to that of the file; to the part of a pattern
        before its first wildcard; to the folder of a list or table or, where a path leads out of
        it, to the root of the file system.

    Raises:
        InputError: no such source, no image in it, a path twice, or a file that is missing or that
            no line of text can name.
    """
    if not os.fspath(images):
        raise InputError(f"images: found an empty name, expected {_FORMS}")
    check_rate(1.0 if fps is None else fps)
    path = pathlib.Path(images)
    if path.is_dir():
        return _source(path, list_images(path), path)
    suffix = path.suffix.lower()
    if suffix == ".txt":
        text = read_text(path, "a list of images, a path a line")
        names = [line.strip() for line in text.splitlines() if line.strip()]
        return _listed(path, names, None, fps, on_bad_image)
    if suffix == ".csv":
        return _listed(path, *read_image_table(path), fps, on_bad_image)
    root, found = path.parent, [path]
    if _PATTERN.search(str(path)) and not path.exists() and frame_time(path) is None:
        root, found = _matching(path)
    skips: OnBadImage = on_bad_image if suffix else "stop"  # a folder is no image to be skipped
    return _source(root, _frames(found, path, _FORMS, fps, skips), path)


def open_sources(
    images: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    fps: float | None = None,
    on_bad_image: OnBadImage = "stop",
) -> list[ImageSource]:
    """List the images of one source or of several, as `open_source` does each.

    Raises:
        InputError: no source; a rate without a video among the images; or what `open_source`
            raises.
    """
    given = [images] if isinstance(images, str | os.PathLike) else list(images)
    if not given:
        raise InputError("images: found none, expected at least one image")
    sources = [open_source(each, fps=fps, on_bad_image=on_bad_image) for each in given]
    check_rate_used(fps, [path for source in sources for path in source.paths])
    return sources


def _frames(
    found: Sequence[pathlib.Path],
    given: pathlib.Path,
    expected: str,
    fps: float | None,
    on_bad_image: OnBadImage,
) -> list[pathlib.Path]:
    """Put a video's frames in its place, and name single frames by their own times.

    What is missing stays as it is under "skip", to be skipped by who reads it.
    """
    paths: list[pathlib.Path] = []
    taken = there = 0
    for path in found:
        if on_bad_image == "skip" and not file_of(path).is_file():
            paths.append(path)
            continue
        check_source(file_of(path), expected)
        if is_video(path):
            frames = list_frames(path, 1.0 if fps is None else fps)
            taken, there = taken + len(frames), there + count_frames(path)
            paths += frames
        else:
            paths.append(name_frame(path))
    if fps is None and taken < there:
        warn(f"{given}: {taken} of {there} frames, 1 per second: --fps")
    return paths


def check_rate_used(fps: float | None, paths: Iterable[pathlib.Path]) -> None:
    """Check that a rate is given only where some image is a frame of a video.

    Args:
        fps: the rate; None where none is given.
        paths: the images of all sources.

    Raises:
        InputError: it is of no use.
    """
    if fps is not None and not any(frame_time(path) is not None for path in paths):
        raise InputError(f"--fps: found {fps:g} without a video among the images, expected both")


def _source(
    root: pathlib.Path,
    paths: list[pathlib.Path],
    given: pathlib.Path,
    positions: Positions | None = None,
) -> ImageSource:
    names = names_in(root, paths)
    twice = [name for name, count in collections.Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{given}: found {twice[0]!r} twice, expected it once")
    return ImageSource(root, paths, names, positions)


def _matching(pattern: pathlib.Path) -> tuple[pathlib.Path, list[pathlib.Path]]:
    """Find the images and videos of a pattern, and the folder before its first wildcard."""
    parts = pattern.parts
    first = next(number for number, part in enumerate(parts) if _PATTERN.search(part))
    root = pathlib.Path(*parts[:first])
    matches = [pathlib.Path(match) for match in glob.glob(str(pattern), recursive=True)]
    files = [match for match in matches if match.is_file()]
    found = only_images(files, pattern, videos=True)
    return root, sorted(found, key=lambda match: match.relative_to(root).as_posix())


def _listed(
    source: pathlib.Path,
    names: Sequence[str],
    positions: Positions | None,
    fps: float | None,
    on_bad_image: OnBadImage,
) -> ImageSource:
    """List the images that a text or table names, with the positions by the source's own names."""
    folder, disk = source.parent, Disk()
    found: list[pathlib.Path] = []
    for name in names:
        # Written out, so that a name has no .. in it, and a path that is there twice is found.
        text = os.path.normpath(name)
        file = os.fspath(file_of(text))
        path = disk.find(folder, file) or folder / file
        found.append(pathlib.Path(os.path.normpath(f"{path}{text[len(file) :]}")))
    if not found or (positions is not None and any(map(is_video, found))):
        videos = f"the video {next(filter(is_video, found))}" if found else "no image"
        raise InputError(f"{source}: found {videos}, expected images, or frames as walk.mp4#t=12.5")
    try:
        paths = _frames(found, source, "an image file", fps, on_bad_image)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    root = pathlib.Path(os.path.normpath(folder))
    below = [path.relative_to(root).parts for path in paths if path.is_relative_to(root)]
    if len(below) < len(paths) or any(".." in parts for parts in below):
        paths = [pathlib.Path(os.path.abspath(path)) for path in paths]
        root = pathlib.Path(paths[0].anchor)
    if positions is not None:
        own = dict(zip(names, names_in(root, paths), strict=True))
        of = {own[name]: position for name, position in positions.of.items()}
        positions = positions._replace(of=of) if of else None
    return _source(root, paths, source, positions)
