"""Names of frames of videos and robot logs, which include the time.

A frame of a video is named `walk.mp4#t=12.500`, with its time in seconds. A frame of a log (a ROS
bag) is named `walk.mcap#/camera/image_raw#t=1700000000.123456789`, with its topic and time stamp.
Such names are accepted wherever the path of an image is accepted.
"""

import collections
import os
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

from crisalad_jax.utils.errors import InputError

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm")
"""Suffixes of videos, in lower case."""
LOG_SUFFIXES = (".mcap", ".bag", ".db3")
"""Suffixes of robot logs, in lower case."""
FASTEST = 1000.0
"""Maximum frames per second, because names of video frames have times in milliseconds."""
_TIME = re.compile(r"(.+)#t=(\d+)(?:\.(\d+))?", re.S)
_TOPIC = re.compile(r"(.+)#([^#\s]+)", re.S)
_OF_BAGS = b"rosbag2_bagfile_information"
"""Beginning of the `metadata.yaml` of a bag that is a folder."""
_SINCE_1970 = re.compile(r"(?<![\d.])(1\d{9})(?:\.(\d+)|(\d{3}|\d{6}|[_-]?\d{9}))?(?![\d])")
"""Seconds from 2001 to 2033, then decimals, or the digits of milli-, micro- or nanoseconds.
ROS writes seconds and nanoseconds separately."""
_UNIX = 1_000_000_000
"""Stamps from this one on (in 2001) are seconds since 1970; those of a simulation start at 0."""


class FrameName(NamedTuple):
    """The parts of a frame's name; the time counts from a video's start, or is a log's stamp."""

    file: str
    """The video or log."""
    topic: str | None
    """The topic in a log; None in a video."""
    nanoseconds: int

    @property
    def milliseconds(self) -> int:
        """The time in milliseconds, rounded."""
        return round(self.nanoseconds / 1_000_000)

    def __str__(self) -> str:
        """Return the name in its standard spelling."""
        if self.topic is None:
            return f"{self.file}#t={self.milliseconds / 1000:.3f}"
        seconds, rest = divmod(self.nanoseconds, 10**9)
        return f"{self.file}#{self.topic}#t={seconds}.{rest:09d}"


def is_video(path: str | os.PathLike[str]) -> bool:
    """Return whether a name has the suffix of a video."""
    return os.fspath(path).lower().endswith(VIDEO_SUFFIXES)


def is_log(path: str | os.PathLike[str]) -> bool:
    """Return whether a path has the suffix of a robot log, or is the folder of a ROS 2 bag."""
    about = pathlib.Path(path, "metadata.yaml")
    if not about.is_file():
        return os.fspath(path).lower().endswith(LOG_SUFFIXES) and not os.path.isdir(path)
    with about.open("rb") as file:
        return _OF_BAGS in file.read(4096)


def has_frames(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a video or a robot log."""
    return is_video(path) or is_log(path)


def parse_frame(path: str | os.PathLike[str]) -> FrameName | None:
    """Parse a frame's name, with any number of decimals in its time; return None for other names.

    Example:
        >>> parse_frame("walk.bag#/camera#t=1700000000.5")
        FrameName(file='walk.bag', topic='/camera', nanoseconds=1700000000500000000)
    """
    timed = _TIME.fullmatch(os.fspath(path))
    if timed is None:
        return None
    file, seconds, decimals = timed.groups("")
    nanoseconds = int(seconds) * 10**9 + int(decimals[:9].ljust(9, "0"))
    if is_video(file):
        return FrameName(file, None, nanoseconds)
    of_log = _TOPIC.fullmatch(file)
    return of_log and FrameName(of_log[1], of_log[2], nanoseconds)


def frame_name(video: str | os.PathLike[str], milliseconds: int) -> str:
    """Return the name of a frame of a video.

    Example:
        >>> frame_name("walk.mp4", 12_500)
        'walk.mp4#t=12.500'
    """
    return str(FrameName(os.fspath(video), None, milliseconds * 1_000_000))


def spelled(name: str) -> str:
    """Return a frame's name in its standard spelling, and other names unchanged.

    Example:
        >>> spelled("walk.mp4#t=12.5"), spelled("a.jpg")
        ('walk.mp4#t=12.500', 'a.jpg')
    """
    frame = parse_frame(name)
    return name if frame is None else str(frame)


def frame_time(path: str | os.PathLike[str]) -> float | None:
    """Return the seconds in a frame's name; None for other names.

    Example:
        >>> frame_time("walk.mp4#t=12.500")
        12.5
    """
    frame = parse_frame(path)
    return None if frame is None else frame.nanoseconds / 10**9


def file_of(path: str | os.PathLike[str]) -> pathlib.Path:
    """Return the file that holds an image; for a frame its video or log, which may be a folder."""
    frame = parse_frame(path)
    return pathlib.Path(path if frame is None else frame.file)


def stored_bytes(path: str | os.PathLike[str]) -> int | None:
    """Return the size in bytes of the file that holds an image (`file_of`); None if missing."""
    file = file_of(path)
    files = file.iterdir() if file.is_dir() and is_log(file) else [file]
    sizes = [each.stat().st_size for each in files if each.is_file()]
    return sum(sizes) if sizes else None


def sequence_of(path: pathlib.PurePath) -> str:
    """Return the sequence that an image belongs to: its video, its log and topic, or its folder.

    Example:
        >>> sequence_of(pathlib.PurePosixPath("a/walk.bag#/camera#t=1700000000.5"))
        'a/walk.bag#/camera'
    """
    is_frame = parse_frame(path) is not None
    return path.as_posix().rpartition("#t=")[0] if is_frame else path.parent.as_posix()


def by_sequence(paths: Sequence[pathlib.PurePath]) -> list[list[int]]:
    """Group the indices of images by their sequence (`sequence_of`), in order.

    Example:
        >>> by_sequence([pathlib.PurePosixPath(name) for name in ("a/1.jpg", "b/1.jpg", "a/2.jpg")])
        [[0, 2], [1]]
    """
    found: dict[str, list[int]] = collections.defaultdict(list)
    for number, path in enumerate(paths):
        found[sequence_of(path)].append(number)
    return list(found.values())


def check_rate(fps: float) -> None:
    """Raise InputError unless a number of frames per second is above 0 and at most `FASTEST`."""
    if not 0 < fps <= FASTEST:
        raise InputError(f"fps: found {fps:g}, expected more than 0, and at most {FASTEST:g}")


def sampled(milliseconds: Sequence[int], fps: float) -> list[int]:
    """Choose the first frame at or after each multiple of 1 / fps seconds.

    Args:
        milliseconds: times of all frames, in order.
        fps: frames per second (see `check_rate`); a rate above the video's chooses all.

    Returns:
        The indices of these frames.

    Example:
        >>> sampled([0, 400, 800, 1200, 1600, 2000], 1)
        [0, 3, 5]
    """
    chosen: list[int] = []
    due = 0.0
    for index, time in enumerate(milliseconds):
        if time + 1 > due:  # times are rounded to a millisecond
            chosen.append(index)
            due = (int((time + 1) * fps / 1000) + 1) * 1000 / fps
    return chosen


class Moment(NamedTuple):
    """A time on some clock; times on different clocks cannot be compared."""

    clock: str
    """Name of the video, camera or simulation whose clock it is; "" for seconds since 1970."""
    seconds: float


def moment_of(name: str | os.PathLike[str]) -> Moment | None:
    """Read the time in an image's name; None if the name has no time, or several.

    Example:
        >>> moment_of("walk.mp4#t=12.500")
        Moment(clock='walk.mp4', seconds=12.5)
        >>> moment_of("walk.bag#/camera#t=1700000000.500000000")
        Moment(clock='', seconds=1700000000.5)
        >>> moment_of("left/1403636579763555584.png").seconds  # of EuRoC: nanoseconds
        1403636579.7635555
        >>> moment_of("0001.png")
    """
    if timed := _TIME.fullmatch(os.fspath(name)):
        frame = parse_frame(name)
        seconds = float(f"{timed[2]}.{timed[3] or 0}")
        is_unix = frame is not None and frame.topic is not None and seconds >= _UNIX
        return Moment("" if is_unix else timed[1], seconds)
    found = _SINCE_1970.findall(os.path.splitext(os.path.basename(name))[0])
    if len(found) != 1:
        return None
    whole, decimals, digits = found[0]
    return Moment("", float(f"{whole}.{decimals or digits.lstrip('_-') or 0}"))
