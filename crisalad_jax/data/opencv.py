"""Contexts that change a global setting of OpenCV while any thread is in them."""

import threading
from collections.abc import Callable

import cv2

MAX_PIXELS = "OPENCV_IO_MAX_IMAGE_PIXELS"
"""Environment variable of the largest image in pixels, which OpenCV reads as it is imported and
checks before it decodes. A small file can claim an image that fills the memory: this package sets
2**28, which takes 0.8 GB, where the variable is not set."""


class _Setting:
    """A context that changes a setting; any number of threads may be in it."""

    def __init__(self, change: Callable[[], int], restore: Callable[[int], object]) -> None:
        """Take `change`, which returns the old value, and `restore`, which the last thread runs."""
        self._change, self._restore = change, restore
        self._lock = threading.Lock()
        self._users = self._before = 0

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                self._before = self._change()
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._restore(self._before)


def _one_thread() -> int:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    return before


QUIET = _Setting(
    lambda: cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT),
    cv2.utils.logging.setLogLevel,
)
"""Context without OpenCV's log on stderr: our errors say what the user needs."""
ONE_THREAD = _Setting(_one_thread, cv2.setNumThreads)
"""Context without OpenCV's own threads, for images that are already decoded on all cores."""
