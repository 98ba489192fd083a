"""Signals that end a program: at once, or after its work is saved.

This module imports nothing but the standard library, so that the command line can handle signals
before it imports anything else.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

from crisalad_jax.utils.errors import Stopped
from crisalad_jax.utils.temporaries import remove_all_in_use

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_SHOW_CURSOR = "\x1b[?25h\n"
"""What a terminal needs after a progress bar that was cut off."""


def end_at_signals() -> None:
    """End this process at a signal with one line, its temporary files removed.

    Nothing is raised. An exception at any moment may be swallowed: inside of an import, of a
    library's callback or of a destructor. Files with a final name are whole at any moment, so that
    the end of the process loses nothing else.
    """
    for number in _SIGNALS:
        # Ignored signals, as under nohup, stay ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


_holding = _waiting = 0
"""How many blocks hold signals back, and the number of a signal that waits for their end."""


@contextlib.contextmanager
def held_signals() -> Iterator[None]:
    """Let a signal end this process after the block: for a few calls that belong together.

    An example is to make a file, and to note that it has to be removed.
    """
    global _holding, _waiting
    _holding += 1
    try:
        yield
    finally:
        _holding -= 1
        if _waiting and not _holding:
            number, _waiting = _waiting, 0
            signal.raise_signal(number)


def _end(number: int, frame: FrameType | None) -> None:
    global _waiting
    if _holding:
        _waiting = number
        return
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    remove_all_in_use()
    how = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    with contextlib.suppress(OSError):
        os.write(2, f"{_SHOW_CURSOR if os.isatty(2) else ''}crisalad: {how}\n".encode())
    os._exit(128 + number)


class SignalState:
    """The state of deferred signals: whether a signal has arrived."""

    def __init__(self) -> None:
        """Start without a signal."""
        self.number = 0
        """Number of the last one; 0 for none."""
        self._at_once = False
        self._before: dict[int, Any] = {}

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
        """Record a signal, as its handler; the second one means: do not wait."""
        first, self.number = self.number == 0, number
        if not first:
            earlier = self._before.get(number)
            if callable(earlier):
                earlier(number, frame)
            raise KeyboardInterrupt
        if self._at_once:
            raise Stopped(number)

    def defer(self) -> None:
        """Handle all signals that are not ignored."""
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self.handle)

    def restore(self) -> None:
        """Give the signals back to their handlers."""
        for number, handler in self._before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def defer_signals() -> Iterator[SignalState]:
    """Defer SIGTERM, SIGHUP and SIGINT (Ctrl-C) to `SignalState.check` while the block runs.

    One that came after the last check has its usual effect after the block. Python sets handlers in
    the main thread alone: in other threads this changes nothing.
    """
    stop = SignalState()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    stop.defer()
    try:
        yield stop
    finally:
        stop.restore()
    if stop.number:
        signal.raise_signal(stop.number)
