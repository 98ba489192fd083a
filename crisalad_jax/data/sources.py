"""Sources of images: a folder, a file, a pattern, a list, a table or a video."""

import glob
import os
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import (
    OnBadImage,
    is_image,
    list_images,
    names_in,
    only_images,
)
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
_AN_IMAGE = "an image file"
_ARRAYS = (".npy", ".npz")


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
    images: str | os.PathLike[str],
    *,
    fps: float | None = None,
    on_bad_image: OnBadImage = "stop",
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
    frames = _Frames(1.0 if fps is None else fps, on_bad_image)
    source = _opened(images, frames)
    if fps is None and frames.taken < frames.there:
        warn(f"{images}: {frames.taken} of {frames.there} frames, 1 per second: --fps")
    return source


class _Frames:
    """Put a video's frames in its place, and count them."""

    def __init__(self, fps: float, on_bad_image: OnBadImage) -> None:
        check_rate(fps)
        self.fps, self.taken, self.there = fps, 0, 0
        self._skips = on_bad_image == "skip"

    def of(self, paths: Sequence[pathlib.Path]) -> list[pathlib.Path]:
        """List images, of a video its frames; single frames are named by their own times.

        What is missing stays as it is under "skip", to be skipped by who reads it.
        """
        return [each for path in paths for each in self._of_one(path)]

    def _of_one(self, path: pathlib.Path) -> list[pathlib.Path]:
        if self._skips and not file_of(path).is_file():
            return [path]
        check_source(file_of(path), _AN_IMAGE)
        if not is_video(path):
            return [name_frame(path)]
        chosen = list_frames(path, self.fps)
        self.taken += len(chosen)
        self.there += count_frames(path)
        return chosen


def _opened(images: str | os.PathLike[str], frames: _Frames) -> ImageSource:
    if not os.fspath(images):
        raise InputError(f"images: found an empty name, expected {_FORMS}")
    path = pathlib.Path(images)
    if path.is_dir():
        return _source(path, list_images(path), path)
    if not path.exists() and frame_time(path) is None:
        if _PATTERN.search(str(path)):
            root, found = _matching(path)
            return _source(root, frames.of(found), path)
        if not is_image(path):
            raise InputError(f"{path}: found nothing, expected {_FORMS}")
    suffix = path.suffix.lower()
    if suffix == ".txt":
        lines = enumerate(read_text(path, "a list of images, a path a line").splitlines(), 1)
        return _listed(path, [(number, line.strip()) for number, line in lines], None, frames)
    if suffix == ".csv":
        table = read_image_table(path)
        return _listed(path, table.rows, table.positions, frames)
    if suffix in _ARRAYS:
        raise InputError(
            f"{path}: found arrays of NumPy, expected {_FORMS}; `describe_images` takes arrays"
        )
    return _source(path.parent, frames.of([path]), path)


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


def _is_below(root: pathlib.Path, path: pathlib.Path) -> bool:
    return path.is_relative_to(root) and ".." not in path.relative_to(root).parts


def _source(
    root: pathlib.Path,
    paths: list[pathlib.Path],
    given: pathlib.Path,
    positions: Positions | None = None,
) -> ImageSource:
    names = names_in(root, paths)
    if len(set(names)) < len(names):
        twice = next(name for number, name in enumerate(names) if name in names[:number])
        raise InputError(f"{given}: found {twice!r} twice, expected it once")
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
    rows: Sequence[tuple[int, str]],
    positions: Positions | None,
    frames: _Frames,
) -> ImageSource:
    """List the images that a text or table names, with the positions by the source's own names."""
    folder, disk = source.parent, Disk()
    paths: list[pathlib.Path] = []
    lines: dict[pathlib.Path, int] = {}
    for number, line in rows:
        if not line:
            continue
        # Written out, so that a name has no .. in it, and a path that is there twice is found.
        text = os.path.normpath(line)
        file = os.fspath(file_of(text))
        path = disk.find(folder, file) or folder / file
        path = pathlib.Path(os.path.normpath(f"{path}{text[len(file) :]}"))
        where = f"{source}: line {number}"
        try:
            listed = frames.of([path])
            if not is_video(path):
                (path,) = listed  # a frame of a video by its own name
            if path in lines:
                raise InputError(
                    f"found {line!r}, which is on line {lines[path]} too, expected it once"
                )
            lines[path] = number
            if positions is not None and is_video(path):
                raise InputError(
                    f"{path}: found a video, expected {_AN_IMAGE}, or a frame such as "
                    f"{path.name}#t=12.500"
                )
            paths += listed
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    if not paths:
        raise InputError(f"{source}: found no image, expected a path a line")
    root = pathlib.Path(os.path.normpath(folder))
    if not all(_is_below(root, path) for path in paths):
        paths = [pathlib.Path(os.path.abspath(path)) for path in paths]
        root = pathlib.Path(paths[0].anchor)
    if positions is not None:
        names = dict(zip((line for _, line in rows), names_in(root, paths), strict=True))
        of = {names[name]: position for name, position in positions.of.items()}
        positions = positions._replace(of=of) if of else None
    return _source(root, paths, source, positions)
