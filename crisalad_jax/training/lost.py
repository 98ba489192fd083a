"""End a process with a one-line error if its run loses another process or that process's host.

JAX ends the remaining processes in one of two ways. If the kernel of the lost process's host closes
its connections, the next exchange of arrays raises an error. Otherwise JAX's coordination service
misses that process's heartbeats, and aborts the others in C++, at any point, with a page of text.
"""

import atexit
import functools
import os
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax

from crisalad_jax.utils.errors import InputError

_P = ParamSpec("_P")
_T = TypeVar("_T")
HEARTBEAT = 60
"""Seconds without a heartbeat after which a process counts as lost."""
_OF_EXCHANGES = re.compile(r"gloo|nccl|coordination service|connection (reset|closed)", re.I)
"""What JAX's error says when another process has left an exchange."""
_NEXT = "the same command resumes from the last saved state, with any number of processes"
_FILTER = """
import re, sys
of_jax, page = False, b""
for line in sys.stdin.buffer:
    if re.match(rb"[IWEF]\\d{4} \\d\\d:|crisalad:", line):
        of_jax = b"coordination_service" in line or b"JAX distributed service" in line
    if of_jax:
        page += line
    elif not line.startswith(b"[Gloo] Rank "):
        sys.stderr.buffer.write(line)
        sys.stderr.buffer.flush()
if b"Terminating process" in page:
    found = re.search(rb"[Tt]ask (\\d+) heartbeat|heartbeats\\):\\s+(\\d+)", page)
    lost = next(filter(None, found.groups())).decode() if found else "0"
    print(f"crisalad: processes: lost process {lost}; " + sys.argv[1], file=sys.stderr)
"""
_filters: list[subprocess.Popen[bytes]] = []


def filter_aborts() -> None:
    """Filter C++ output through a small program that shortens JAX's abort messages to one line.

    All C++ output then goes to standard error; Python's output goes where it went before.
    """
    program = subprocess.Popen(
        [sys.executable, "-ISc", _FILTER, _NEXT], stdin=subprocess.PIPE, start_new_session=True
    )
    assert program.stdin is not None
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        stream.flush()
        # The stream stays the same object, which others hold. Unbuffered, it is the file itself.
        file: Any = getattr(stream.buffer, "raw", stream.buffer)
        file.__init__(os.dup(number), "w", closefd=False)
        os.dup2(program.stdin.fileno(), number)
    program.stdin.close()
    _filters.append(program)


def ends_with_the_others(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Wrap a function that all processes call together: if one is lost, the others raise.

    The function's context managers exit first, so that a state that is being written is completed.
    This process later exits without JAX's shutdown, which would wait for the lost process.

    Raises:
        InputError: an exchange with another process failed; this replaces JAX's error.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **options: _P.kwargs) -> _T:
        try:
            return function(*args, **options)
        except (RuntimeError, ValueError) as error:
            text = " ".join(str(error).split())
            is_lost = jax.process_count() > 1 and _OF_EXCHANGES.search(text)
            if isinstance(error, InputError) or not is_lost:
                raise
            for program in _filters:  # this process prints the line itself
                program.kill()
            atexit.register(_leave)
            raise InputError(f"processes: lost another process ({text[:120]}); {_NEXT}") from error

    return call


def _leave() -> None:
    sys.stdout.flush()
    os._exit(2)
