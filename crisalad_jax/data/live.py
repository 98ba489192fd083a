"""Images as they come: files that appear in a folder, and the newest frame of a camera."""

import contextlib
import os
import pathlib
import queue
import threading
import time
import urllib.parse
from collections.abc import Callable, Iterator
from typing import NamedTuple, Self

import cv2
import numpy as np

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.preprocessing import Size
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import check_rate, frame_name
from crisalad_jax.data.images import SELF_CHECKED, check_folder, is_image, read_pixels
from crisalad_jax.data.video import milliseconds_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_POLL = 0.05
"""Seconds between two looks into a folder, and four times what a look takes if that is longer."""
_SETTLED = 1.0
"""Seconds for which a file of another format stays as it is before it counts as whole."""
_PATIENCE = 5.0
"""Seconds for which an unreadable file stays as it is before it is given up."""
_TURN = 0.1
"""Longest seconds between two calls of `check`."""


@brief
class Frame(NamedTuple):
    """A picture with its moment."""

    name: str
    """The file's path in its folder, or the camera, or a video's name, and the time."""
    time: float
    """Seconds: into a video; else since 1970, of the file's last change or the camera's frame."""
    image: np.ndarray
    """RGB or grey, upright, in the depth of the file; a camera's of 8 bits."""
    taken: float
    """`time.perf_counter()` when it was in hand: a whole file, or a frame from the camera."""


class FolderWatch:
    """The images that appear in a folder and its subfolders, each once, when it is whole.

    Those that are there before are left out. The folder is looked at 20 times a second, which
    works on any file system. A JPEG or PNG is whole when it decodes; files of other formats when
    they have not changed for a second. A file that stays unreadable for five is left out, with a
    note.

    Example:
        >>> import shutil
        >>> from crisalad_jax import FolderWatch
        >>> watch = FolderWatch(folder)
        >>> _ = shutil.copy(pictures / "0.png", folder / "new.png")
        >>> next(watch.frames()).image.shape
        (60, 80, 3)
    """

    size: Size | None = None
    """Height and width of all frames; None where that is unknown."""
    dropped = 0
    """Number of frames passed over for newer ones: none."""

    @takes(folder=PATH)
    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Note what is there.

        Args:
            folder: the folder.

        Raises:
            InputError: there is no such folder.
        """
        self._folder = pathlib.Path(folder)
        check_folder(self._folder, "a folder to watch")
        self._done = set(self._scan())
        self.there = len(self._done)
        """Number of images that were there before."""

    def _scan(self) -> Iterator[pathlib.Path]:
        for parent, folders, files in os.walk(self._folder):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in files:
                if is_image(name) and not name.startswith("."):
                    yield pathlib.Path(parent, name)

    def frames(self, check: Callable[[], None] = lambda: None) -> Iterator[Frame]:
        """Yield images as they appear, without end; the oldest first where there are several.

        Args:
            check: called several times a second; it may raise, to end this.
        """
        waiting: dict[pathlib.Path, tuple[tuple[int, int], float]] = {}
        """Size and time of change of a file, and since when it has these."""
        while True:
            check()
            begun = time.monotonic()
            found: list[tuple[float, pathlib.Path]] = []
            for path in self._scan():
                if path not in self._done:
                    with contextlib.suppress(OSError):  # gone again
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


class Camera:
    """The newest frame of a camera, whenever one is asked for; older ones are passed over.

    A thread takes all frames from the camera, so that none waits in the camera's own queue. A
    video file plays at its own pace, as if it were a camera.

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
    def __init__(self, camera: int | str | os.PathLike[str], *, fps: float | None = None) -> None:
        """Open the camera.

        Args:
            camera: its number, from 0, or a URL, or a video file.
            fps: most frames a second that `frames` yields; None is as many as are asked for.

        Raises:
            InputError: it cannot be opened, or gives no frame; or a rate out of range.
        """
        if fps is not None:
            check_rate(fps)
        self._fps = fps
        given = os.fspath(camera) if isinstance(camera, os.PathLike) else str(camera)
        self._is_file = pathlib.Path(given).is_file()
        self.name = _name(given)
        """What messages call it: no user or password of a URL."""
        self._begins = pathlib.Path(given).name if self._is_file else self.name
        is_number = given.isdecimal() and len(given) < 10 and not self._is_file  # 32 bits
        known = self._is_file or is_number or "://" in given
        self._capture = cv2.VideoCapture(int(given) if is_number else given)
        whole = known and self._capture.isOpened() and self._capture.grab()
        if not whole:
            self._capture.release()
            raise InputError(
                f"camera: found no frame from {self.name}, expected a number from 0, a URL or a "
                "video file"
            )
        sides = (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
        height, width = (int(self._capture.get(side)) for side in sides)
        self.size: Size | None = (height, width) if height > 0 and width > 0 else None
        """Height and width of the frames; None where the camera does not tell."""
        self.dropped = 0
        """Number of frames passed over for newer ones."""
        self._newest: queue.Queue[Frame] = queue.Queue(1)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Return the camera itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the camera."""
        self.close()

    def frames(self, check: Callable[[], None] = lambda: None) -> Iterator[Frame]:
        """Yield the newest frame, time and again, until the camera or the video ends.

        Args:
            check: called several times a second; it may raise, to end this.

        Raises:
            InputError: a camera, which is no video file, gives no more frames.
        """
        self._thread = thread = threading.Thread(target=self._take, daemon=True)
        thread.start()
        due = 0.0
        while True:
            check()
            if (early := due - time.monotonic()) > 0:
                time.sleep(min(_TURN, early))
                continue
            goes_on = thread.is_alive()
            try:
                frame = self._newest.get(timeout=_TURN)
            except queue.Empty:
                if goes_on:
                    continue
                break
            due = 0 if self._fps is None else time.monotonic() + 1 / self._fps
            yield frame
        if not self._is_file and not self._closing.is_set():
            raise InputError(f"camera: found no more frames from {self.name}, expected it to go on")

    def _take(self) -> None:
        """Take frames until there are no more; a video's at their times."""
        begun, grabbed = time.monotonic(), True  # the first frame was grabbed to try the camera
        while grabbed and not self._closing.is_set():
            at = milliseconds_of(self._capture)
            found, image = self._capture.retrieve()
            if self._is_file:
                self._closing.wait(max(0.0, begun + at / 1000 - time.monotonic()))
            taken = time.perf_counter()
            when = at if self._is_file else round(1000 * time.time())
            if found:
                image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                with contextlib.suppress(queue.Empty):
                    self._newest.get_nowait()
                    self.dropped += 1
                name = frame_name(self._begins, when)
                self._newest.put(Frame(name, when / 1000, image, taken))
            grabbed = self._capture.grab()
        self._capture.release()

    def close(self) -> None:
        """Let go of the camera."""
        self._closing.set()
        if self._thread is None:
            self._capture.release()
        else:
            self._thread.join(timeout=1)  # a camera that hangs is left to the end of the process


def _name(camera: str) -> str:
    """Return a camera's name without what may be a secret in a URL."""
    if camera.isdecimal():
        return f"camera-{camera}"
    if "://" not in camera:
        return camera
    parts = urllib.parse.urlsplit(camera)
    host = parts.netloc.rpartition("@")[2]
    return urllib.parse.urlunsplit((parts.scheme, host, parts.path, "", ""))
