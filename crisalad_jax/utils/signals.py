"""Defer the signals that end a program until its work is saved."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from crisalad_jax.utils.errors import Stopped

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class SignalState:
    """The state of deferred signals: whether a signal has arrived."""

    def __init__(self) -> None:
        """Start without a signal."""
        self.number = 0
        """Number of the last one; 0 for none."""
        self._at_once = False

    def check(self) -> None:
        """Raise `Stopped` if a signal has come."""
        if self.number:
            raise Stopped(self.number)

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Raise `Stopped` as soon as a signal arrives, in a block that leaves nothing half done."""
        self._at_once = True
        try:
            self.check()
            yield
        finally:
            self._at_once = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Record a signal, as its handler; raise on the second one."""
        first, self.number = self.number == 0, number
        if not first:  # a second signal means: do not wait
            raise KeyboardInterrupt
        if self._at_once:
            raise Stopped(number)


@contextlib.contextmanager
def defer_signals() -> Iterator[SignalState]:
    """Defer SIGTERM and SIGINT (Ctrl-C) to `SignalState.check` while the block runs.

    Python sets handlers in the main thread alone: in other threads this changes nothing.
    """
    stop = SignalState()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop.handle) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
