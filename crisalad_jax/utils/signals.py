"""Signals that end a program: immediately, or after its work is saved.

This module imports nothing but the standard library, so that the command line can handle signals
before it imports anything else.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from types import FrameType
from typing import Any

from crisalad_jax.utils.errors import Interrupted, how_ended
from crisalad_jax.utils.temporaries import remove_all_in_use

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_SHOW_CURSOR = "\x1b[?25h\n"
"""What a terminal needs after a progress bar that was cut off."""


def end_at_signals() -> None:
    """Set up handlers that end this process at a signal: print one line, remove temporary files.

    Python runs handlers in the main thread, but not while a library works there: XLA may compile
    for minutes. A second thread then ends the process.

    Nothing is raised, because an exception at an arbitrary moment may be swallowed: in an import, a
    library's callback or a destructor. Files with a final name are always complete, so ending the
    process loses nothing else.
    """
    for number in _SIGNALS:
        # Ignored signals, as under nohup, stay ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    global _pipe
    reading, _pipe = os.pipe()
    os.set_blocking(_pipe, False)
    watch()
    threading.Thread(target=_end_late, args=(reading,), daemon=True).start()


_pipe = -1
"""Receives the number of each signal, for the second thread; -1 if there is none."""


def watch() -> None:
    """Watch for signals in a second thread; call again before a library works in the main thread.

    orbax writes with uvloop, which takes over the watching of signals, and does not give it back.
    """
    if _pipe >= 0 and threading.current_thread() is threading.main_thread():
        signal.set_wakeup_fd(_pipe, warn_on_full_buffer=False)


_holding = _waiting = 0
"""Number of blocks that hold signals back, and the signal that waits for their end."""


@contextlib.contextmanager
def block_signals() -> Iterator[None]:
    """Delay the effect of signals until after the block, for a few calls that belong together.

    An example is creating a file, and registering it for removal.
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
    _leave(number)


def _end_late(numbers: int) -> None:
    """End the process at a signal that the main thread has not handled after some time.

    Args:
        numbers: a pipe that receives the number of each signal.
    """
    excused = None
    while data := os.read(numbers, 1):
        state, number = SignalState.current, data[0]
        if number not in _SIGNALS:
            continue
        # The first signal waits for work that has to be saved.
        if state is not None and state.has_work and state is not excused:
            excused = state
            continue
        time.sleep(_PATIENCE)
        _leave(number)


_PATIENCE = 2.0
"""Seconds that the main thread has to handle a signal."""
_leaving = threading.Lock()


def _leave(number: int) -> None:
    _leaving.acquire()  # never released: one of the threads ends the process
    remove_all_in_use()
    with contextlib.suppress(OSError):
        os.write(
            2, f"{_SHOW_CURSOR if os.isatty(2) else ''}crisalad: {how_ended(number)}\n".encode()
        )
    os._exit(128 + number)


class SignalState:
    """The state of deferred signals: whether a signal has arrived."""

    current: "SignalState | None" = None
    """The state while signals are deferred, and after a signal has arrived; else None."""

    def __init__(self, before: Mapping[Any, Any] | None = None) -> None:
        """Start without a signal; `before` has the earlier handlers by signal number."""
        self.number = 0
        """Number of the last signal; 0 for none."""
        self.has_work = False
        """Whether there is work that has to be saved; without it a command ends immediately."""
        self._at_once = False
        self._before = before or {}

    def check(self) -> None:
        """Raise `Interrupted` if a signal has arrived."""
        if self.number:
            raise Interrupted(self.number)

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Raise `Interrupted` as soon as a signal arrives, in a block that is safe to interrupt."""
        self._at_once = True
        try:
            self.check()
            yield
        finally:
            self._at_once = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal by recording it; a second one interrupts without waiting."""
        first, self.number = self.number == 0, number
        earlier = self._before.get(number)
        if earlier is _end and not self.has_work:
            _end(number, frame)
        if not first:
            if callable(earlier):
                earlier(number, frame)
            raise KeyboardInterrupt
        if self._at_once:
            raise Interrupted(number)


@contextlib.contextmanager
def defer_signals() -> Iterator[SignalState]:
    """Defer SIGTERM, SIGHUP and SIGINT (Ctrl-C) to `SignalState.check` while the block runs.

    A signal after the last check has its usual effect after the block. Python sets handlers only in
    the main thread: in other threads this changes nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield SignalState()
        return
    # Ignored signals, as under nohup, stay ignored.
    before = {n: h for n in _SIGNALS if (h := signal.getsignal(n)) is not signal.SIG_IGN}
    state = SignalState.current = SignalState(before)
    watch()
    for number in before:
        signal.signal(number, state.handle)
    try:
        yield state
    finally:
        watch()
        if not state.number:
            SignalState.current = None
        for number, handler in before.items():
            signal.signal(number, handler)
    if state.number:
        signal.raise_signal(state.number)
