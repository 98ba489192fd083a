"""Frames of video files, named as in `data.frames`: `walk.mp4#t=12.500`.

Times are those in the file, so videos with a variable frame rate work too. Commands name a frame by
its actual time in whole milliseconds, even if a user wrote a time between two frames: `frame_name`
writes such a name, and `name_frame` finds it for a time that a user wrote.
"""

import bisect
import functools
import os
import pathlib
import threading

import cv2
import numpy as np

from crisalad_jax.data.frames import VIDEO_SUFFIXES, FrameName, frame_name, sampled
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_source
from crisalad_jax.utils.shapes import UInt8

# Our errors say what the user needs to know. OpenCV reads this when it opens its first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

_VIDEO = f"a video ({' '.join(VIDEO_SUFFIXES)})"
_OPEN = 2
"""Number of videos that stay open between frames."""
_FAR = 30_000
"""Milliseconds ahead from which seeking is faster than decoding everything in between."""
_BEFORE_KEY = 2_000
"""Milliseconds before a wanted frame to seek to: some decoders land too late."""


def milliseconds_of(capture: cv2.VideoCapture) -> int:
    """Return the time in milliseconds of the frame that was read last from a video."""
    return round(capture.get(cv2.CAP_PROP_POS_MSEC))


def list_frames(video: str | os.PathLike[str], fps: float = 1.0) -> list[pathlib.Path]:
    """List the first frame of a video at or after each multiple of 1 / fps seconds.

    Times are read from the container. The end is decoded as a check; if that fails, everything is.

    Args:
        video: the file.
        fps: frames per second, above 0; a rate above that of the video lists all frames.

    Returns:
        Names of the frames in order of time, which `read_image` reads.

    Raises:
        InputError: the file is missing, or is not a video.
    """
    times = _video(video).times
    return [pathlib.Path(frame_name(video, times[index])) for index in sampled(times, fps)]


def count_frames(video: str | os.PathLike[str]) -> int:
    """Count all frames of a video.

    Raises:
        InputError: the file is missing, or is not a video.
    """
    return len(_video(video).times)


def name_frame(frame: FrameName) -> pathlib.Path:
    """Return the name of a frame with its actual time; between two frames, name the later one.

    Args:
        frame: a video and a time in it.

    Returns:
        The name. A time after the last frame is unchanged; `read_frame` then raises an error.

    Raises:
        InputError: the video is missing or does not decode.
    """
    times, wanted = _video(frame.file).times, frame.milliseconds
    at = bisect.bisect_left(times, wanted)
    return pathlib.Path(frame_name(frame.file, times[at] if at < len(times) else wanted))


class _Video:
    """A video, which is read forwards where possible."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._capture = _opened(file)
        self._at = -1
        """Time of the last frame in milliseconds; -1 before the first."""

    @functools.cached_property
    def times(self) -> list[int]:
        """Times of all frames in milliseconds, in order, each once."""
        times = self._grabbed_times(decoded=False)
        # A video trimmed without re-encoding still contains frames that are not shown.
        if not times or _Video(self._file).read(times[-1]) is None:
            times = self._grabbed_times(decoded=True)
        if not times:
            raise InputError(f"{self._file}: found no frame, expected {_VIDEO}")
        return times

    def _grabbed_times(self, *, decoded: bool) -> list[int]:
        capture = _opened(self._file)
        if not decoded:  # raw packets, in decoding order
            capture.set(cv2.CAP_PROP_FORMAT, -1)
        times = set()
        while capture.grab():
            times.add(milliseconds_of(capture))
        return sorted(time for time in times if time >= 0)

    def read(self, wanted: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """Read the first frame at or after a time; None after the last one."""
        if not self._at <= wanted < self._at + _FAR:
            self._seek(wanted)
        while self._at < wanted:
            if not self._grab():
                return None
        found, image = self._capture.retrieve()
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if found else None

    def _grab(self) -> bool:
        if not self._capture.grab():
            return False
        self._at = milliseconds_of(self._capture)
        return True

    def _seek(self, wanted: int) -> None:
        self._capture.set(cv2.CAP_PROP_POS_MSEC, max(0, wanted - _BEFORE_KEY))
        if not self._grab() or self._at > wanted:
            self._capture, self._at = _opened(self._file), -1


def _opened(video: str) -> cv2.VideoCapture:
    return cv2.VideoCapture(video, cv2.CAP_FFMPEG)


_lock = threading.Lock()
"""Lock for all videos: two threads must not read with OpenCV at once."""


def _video(path: str | os.PathLike[str]) -> _Video:
    """Open a video in its current state; the last ones stay open."""
    check_source(path, _VIDEO)
    there = os.stat(path)
    return _as_of(os.path.abspath(path), there.st_size, there.st_mtime_ns)


@functools.lru_cache(maxsize=_OPEN)  # a list may name thousands of frames of a video
def _as_of(file: str, size: int, changed: int) -> _Video:
    """Open a file; its size and time of change are part of the cache's key."""
    return _Video(file)


def read_frame(frame: FrameName) -> UInt8[np.ndarray, "h w 3"]:
    """Read a frame as 8-bit RGB, upright: the first one at or after the time in its name.

    Reading frames in order of time avoids seeking, so only one thread should read a given video.

    Raises:
        InputError: the file is not a video, or has no such frame.
    """
    video = _video(frame.file)
    with _lock:
        image = video.read(frame.milliseconds)
    if image is None:
        raise InputError(f"{frame}: found no frame there, expected a time in the video")
    return image
