"""Live images: files that appear in a folder, and the newest frame of a camera."""

import contextlib
import math
import os
import pathlib
import threading
import time
import urllib.parse
from collections.abc import Callable, Generator, Iterator
from typing import NamedTuple, Self

import cv2
import numpy as np

from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.config.preprocessing import Size
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import FrameName, check_rate, frame_name, is_log
from crisalad_jax.data.images import SELF_CHECKED, check_folder, is_image, read_pixels
from crisalad_jax.data.logs import Log, open_log
from crisalad_jax.data.video import milliseconds_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_POLL = 0.05
"""Seconds between two scans of a folder, or four times a scan's duration if that is longer."""
_SETTLED = 1.0
"""Seconds for which a file other than a JPEG or PNG must stay unchanged to count as complete."""
_PATIENCE = 5.0
"""Seconds for which an unreadable file must stay unchanged to be given up."""
_TURN = 0.1
"""Longest time in seconds between two calls of `check`."""


@brief
class Frame(NamedTuple):
    """An image and its time."""

    name: str
    """Path of the file relative to the folder, or name of the camera or video and the time."""
    time: float
    """Seconds from a video's start, or since 1970: a file's last change, or the frame's stamp."""
    image: np.ndarray
    """RGB or grey, upright, at the file's bit depth; 8 bits from a camera."""
    taken: float
    """`time.perf_counter()` when the file was complete, or the camera's frame arrived."""
    dropped: int = 0
    """Number of frames dropped between the previously taken frame and this one."""


class FolderWatch:
    """A source of the images that appear in a folder and its subfolders, each once, when complete.

    Existing images are left out. The folder is scanned up to 20 times a second, so any file system
    will do. A JPEG or PNG is complete when it decodes; a file of another format when it has not
    changed for a second. A file that stays unreadable for five seconds is left out, with a warning.

    Example:
        >>> import shutil
        >>> from crisalad_jax import FolderWatch
        >>> watch = FolderWatch(folder)
        >>> _ = shutil.copy(pictures / "0.png", folder / "new.png")
        >>> next(watch.frames()).image.shape
        (60, 80, 3)
    """

    size: Size | None = None
    """Height and width of all frames; None if unknown."""
    dropped = 0
    """Number of frames dropped for newer ones: always 0."""

    @takes(folder=PATH)
    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """List the existing images.

        Args:
            folder: the folder to watch.

        Raises:
            InputError: there is no such folder.
        """
        self._folder = pathlib.Path(folder)
        check_folder(self._folder, "a folder to watch")
        self._done = set(self._scan())
        self.there = len(self._done)
        """Number of images that existed when watching began."""

    def _scan(self) -> Iterator[pathlib.Path]:
        for parent, folders, files in os.walk(self._folder):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in files:
                if is_image(name) and not name.startswith("."):
                    yield pathlib.Path(parent, name)

    def frames(self, check: Callable[[], None] = lambda: None) -> Iterator[Frame]:
        """Yield images as they appear, without end, the oldest of several first.

        Args:
            check: called several times a second; it may raise to end the loop.
        """
        waiting: dict[pathlib.Path, tuple[tuple[int, int], float]] = {}
        """A file's size and time of change, and when these were first seen."""
        while True:
            check()
            begun = time.monotonic()
            found: list[tuple[float, pathlib.Path]] = []
            for path in self._scan():
                if path not in self._done:
                    with contextlib.suppress(OSError):  # deleted meanwhile
                        there = path.stat()
                        state = (there.st_size, there.st_mtime_ns)
                        if path not in waiting or waiting[path][0] != state:
                            waiting[path] = state, begun
                        waits = 0.0 if path.suffix.lower() in SELF_CHECKED else _SETTLED
                        if begun - waiting[path][1] >= waits:
                            found.append((there.st_mtime, path))
            arrived = False
            for changed, path in sorted(found):
                check()
                taken = time.perf_counter()
                try:
                    image = read_pixels(path)
                except InputError as error:
                    if begun - waiting[path][1] > _PATIENCE:
                        self._done.add(path)
                        if path.exists():
                            warn(f"{error}; it is left out")
                    continue
                arrived = True
                self._done.add(path)
                yield Frame(path.relative_to(self._folder).as_posix(), changed, image, taken)
            if not arrived:
                time.sleep(max(_POLL, 4 * (time.monotonic() - begun)))

    def close(self) -> None:
        """Do nothing: no file is open."""


_Played = Generator[tuple[float, tuple[np.ndarray, float, str]]]
"""When a frame is due, in seconds from the beginning; its image, time and name."""


class LatestFrame:
    """A source with a queue of one frame, which other code fills, for example a ROS callback.

    A frame that is not taken before the next one arrives is dropped, and counted. Any thread may
    `put` frames while another one takes them.

    Example:
        >>> import numpy as np
        >>> from crisalad_jax import LatestFrame
        >>> latest = LatestFrame()
        >>> for stamp in (1767225600.0, 1767225600.1, 1767225600.2):
        ...     latest.put(np.zeros((60, 80, 3), np.uint8), stamp)
        >>> latest.close()
        >>> [(frame.name, frame.dropped) for frame in latest.frames()]
        [('camera#t=1767225600.200', 2)]
    """

    size: Size | None = None
    """Height and width of all frames; None if unknown."""

    def __init__(self, *, fps: float | None = None) -> None:
        """Create an empty queue.

        Args:
            fps: maximum frames per second that `frames` yields; None yields as many as requested.

        Raises:
            InputError: `fps` is not above 0, or is above 1000.
        """
        if fps is not None:
            check_rate(fps)
        self._fps = fps
        self.dropped = 0
        """Number of frames dropped for newer ones."""
        self._changed = threading.Condition()
        self._newest: Frame | None = None
        self._ended = False

    def __enter__(self) -> Self:
        """Return the source itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the source."""
        self.close()

    def put(self, image: np.ndarray, stamp: float, name: str | None = None) -> None:
        """Add the newest frame, in place of one that has not been taken yet.

        Args:
            image: 8-bit RGB (height, width, 3), or anything else that `prepare_image` takes. It
                must not change afterwards.
            stamp: time of the image in seconds, for example since 1970.
            name: the frame's name (`Frame.name`); None makes one from "camera" and the time.
        """
        taken = time.perf_counter()
        name = frame_name("camera", round(1000 * stamp)) if name is None else name
        with self._changed:
            passed = 0 if self._newest is None else self._newest.dropped + 1
            self.dropped += passed > 0
            self._newest = Frame(name, stamp, image, taken, passed)
            self._changed.notify()

    def frames(self, check: Callable[[], None] = lambda: None) -> Iterator[Frame]:
        """Yield the newest frame, repeatedly, until the source is closed.

        Args:
            check: called several times a second; it may raise to end the loop.
        """
        due = 0.0
        while True:
            check()
            if (early := due - time.monotonic()) > 0:
                time.sleep(min(_TURN, early))
                continue
            with self._changed:
                if self._newest is None and not self._ended:
                    self._changed.wait(_TURN)
                frame, self._newest = self._newest, None
                ended = self._ended
            if frame is not None:
                due = 0 if self._fps is None else time.monotonic() + 1 / self._fps
                yield frame
            elif ended:
                return

    def close(self) -> None:
        """End `frames` as soon as it has yielded the frame that waits, if any."""
        with self._changed:
            self._ended = True
            self._changed.notify()


class Camera(LatestFrame):
    """The newest frame of a camera, whenever one is requested; older ones are dropped.

    A thread reads all frames from the camera, so that none waits in the camera's queue. A video
    file or a robot log plays at its recorded speed, like a camera.

    Example:
        >>> import cv2, numpy as np
        >>> video = str(folder / "walk.avi")
        >>> writer = cv2.VideoWriter(video, cv2.VideoWriter.fourcc(*"MJPG"), 20, (80, 60))
        >>> _ = [writer.write(np.zeros((60, 80, 3), np.uint8)) for _ in range(4)]
        >>> writer.release()
        >>> with Camera(video) as camera:
        ...     frames = list(camera.frames())
        >>> frames[-1].time, frames[-1].image.shape
        (0.15, (60, 80, 3))
    """

    @takes(camera=(int, str, os.PathLike))
    def __init__(
        self,
        camera: int | str | os.PathLike[str],
        *,
        fps: float | None = None,
        rate: float = 1.0,
        topic: str | None = None,
    ) -> None:
        """Open the camera.

        Args:
            camera: number of the camera from 0, a URL, a video file, or a robot log (a ROS bag).
            fps: maximum frames per second that `frames` yields; None yields as many as requested.
            rate: speed at which a file plays, as a multiple of the recorded speed.
            topic: topic of the images in a robot log; None takes the only topic that has images.

        Raises:
            InputError: the camera cannot be opened, or gives no frame; `fps` or `rate` is out of
                range; or the log does not have the topic.
        """
        super().__init__(fps=fps)
        require(0 < rate < math.inf, f"rate: found {rate:g}, expected more than 0")
        given = os.fspath(camera) if isinstance(camera, os.PathLike) else str(camera)
        from_log = is_log(given)
        require(
            from_log or topic is None,
            f"topic: found {topic} with {_name(given)}, expected a robot log",
        )
        self._is_file = from_log or pathlib.Path(given).is_file()
        self._rate = rate
        self.name = _name(given)
        """Name of the camera in messages, without the user, password and query of a URL."""
        self._begins = pathlib.Path(given).name if self._is_file else self.name
        self.size: Size | None
        """Height and width of the frames; None if the camera does not report it."""
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None
        self._capture: cv2.VideoCapture | None = None
        if from_log:
            log = open_log(given)
            topic = log.image_topic(topic)
            first = next(log.images(topic), None)
            if first is None:
                raise InputError(f"{given}: found no image in {topic}, expected at least one")
            self.size = first[1].shape[:2]
            self._played = self._logged(log, topic)
            return
        is_number = given.isdecimal() and len(given) < 10 and not self._is_file  # 32 bits
        known = self._is_file or is_number or "://" in given
        self._capture = capture = cv2.VideoCapture(int(given) if is_number else given)
        whole = known and capture.isOpened() and capture.grab()
        if not whole:
            capture.release()
            raise InputError(
                f"camera: found no frame from {self.name}, expected a number from 0, a URL or a "
                "video file"
            )
        sides = (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
        height, width = (int(capture.get(side)) for side in sides)
        self.size = (height, width) if height > 0 and width > 0 else None
        self._played = self._captured(capture)

    def frames(self, check: Callable[[], None] = lambda: None) -> Iterator[Frame]:
        """Yield the newest frame, repeatedly, until the camera or the video ends.

        Args:
            check: called several times a second; it may raise to end the loop.

        Raises:
            InputError: a camera that is not a file gives no more frames.
        """
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()
        yield from super().frames(check)
        if self._failure is not None:
            raise self._failure
        if not self._is_file and not self._closing.is_set():
            raise InputError(f"camera: found no more frames from {self.name}, expected more")

    def _play(self) -> None:
        """Put frames until there are no more; those of a file at their times."""
        begun = time.monotonic()
        try:
            with contextlib.closing(self._played) as frames:
                for due, frame in frames:
                    self._closing.wait(max(0.0, begun + due / self._rate - time.monotonic()))
                    if self._closing.is_set():
                        break
                    self.put(*frame)
        except Exception as error:  # `frames` raises it in the caller's thread
            self._failure = error
        finally:
            super().close()

    def _captured(self, capture: cv2.VideoCapture) -> _Played:
        """Yield when each frame of a camera or video is due, and the arguments of `put`.

        The first frame has already been grabbed.
        """
        try:
            grabbed = True
            while grabbed:
                at = milliseconds_of(capture)
                found, image = capture.retrieve()
                when = at if self._is_file else round(1000 * time.time())
                if found:
                    image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                    due = at / 1000 if self._is_file else 0.0
                    yield due, (image, when / 1000, frame_name(self._begins, when))
                grabbed = capture.grab() and not self._closing.is_set()
        finally:
            capture.release()

    def _logged(self, log: Log, topic: str) -> _Played:
        """Yield when each frame of a log is due, and the arguments of `put`."""
        begun = None
        for stamp, image in log.images(topic):
            begun = stamp if begun is None else begun
            name = str(FrameName(self._begins, topic, stamp))
            yield (stamp - begun) / 10**9, (image, stamp / 10**9, name)

    def close(self) -> None:
        """Release the camera."""
        self._closing.set()
        if self._thread is None:
            if self._capture is not None:
                self._capture.release()
        else:
            self._thread.join(timeout=1)  # a hanging camera is released when the process ends


def _name(camera: str) -> str:
    """Return a camera's name without the parts of a URL that may be secret."""
    if camera.isdecimal():
        return f"camera-{camera}"
    if "://" not in camera:
        return camera
    parts = urllib.parse.urlsplit(camera)
    host = parts.netloc.rpartition("@")[2]
    return urllib.parse.urlunsplit((parts.scheme, host, parts.path, "", ""))
