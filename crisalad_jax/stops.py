"""Signals that end a program, put off until its work is saved."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from crisalad_jax.errors import Stopped

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Stop:
    """Whether a signal has come."""

    def __init__(self) -> None:
        """None has."""
        self._number: int | None = None
        self._at_once = False

    def check(self, agree: Callable[[int], int] = int) -> None:
        """Raise `Stopped` if a signal has come.

        `agree` is given its number, or 0, and says whose it is for all: another process's, too.
        """
        number = agree(self._number or 0)
        if number:
            raise Stopped(number)

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Where nothing can be left half done: a signal raises `Stopped` when it comes."""
        self._at_once = True
        try:
            self.check()
            yield
        finally:
            self._at_once = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """What the signals call."""
        first, self._number = self._number is None, number
        if not first:  # who asks twice does not want to wait
            raise KeyboardInterrupt
        if self._at_once:
            raise Stopped(number)


@contextlib.contextmanager
def put_off_signals() -> Iterator[Stop]:
    """While the block runs SIGTERM and SIGINT (Ctrl-C) wait for `Stop.check`.

    In other threads than the main one, where Python sets no handlers, they stay what they are.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop.handle) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
