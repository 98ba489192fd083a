"""When images were taken, by their names: times of video frames, and Unix times of loggers."""

import os
import pathlib
import re
from typing import NamedTuple

_FRAME = re.compile(r"(.+)#t=(\d+(?:\.\d+)?)", re.S)
_SINCE_1970 = re.compile(r"(?<![\d.])(1\d{9})(?:\.(\d+)|(\d{3}|\d{6}|\d{9}))?(?![\d])")
"""Seconds from 2001 to 2033, then decimals, or the digits of milli-, micro- or nanoseconds."""


class Moment(NamedTuple):
    """A time on some clock: moments of two clocks say nothing of each other."""

    clock: str
    """The video that the time is in; "" is seconds since 1970."""
    seconds: float


def moment_of(name: str | os.PathLike[str]) -> Moment | None:
    """Read the moment in an image's name; None where it has none, or several.

    Example:
        >>> moment_of("walk.mp4#t=12.500")
        Moment(clock='walk.mp4', seconds=12.5)
        >>> moment_of("left/1403636579763555584.png").seconds  # of EuRoC: nanoseconds
        1403636579.7635555
        >>> moment_of("0001.png")
    """
    text = os.fspath(name)
    if match := _FRAME.fullmatch(text):
        return Moment(match[1], float(match[2]))
    found = _SINCE_1970.findall(pathlib.PurePath(text).stem)
    if len(found) != 1:
        return None
    whole, decimals, digits = found[0]
    return Moment("", float(f"{whole}.{decimals or digits or 0}"))
