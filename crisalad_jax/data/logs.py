"""Images and positions of robot logs: ROS 1 bags (.bag), ROS 2 bags (.mcap, .db3, or a folder).

The fields of messages are those of ROS's common_interfaces; the encodings of images are those of
its `sensor_msgs/image_encodings.hpp` and of cv_bridge.
"""

import contextlib
import functools
import os
import pathlib
import threading
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.data.frames import LOG_SUFFIXES, FrameName, sampled, stored_bytes
from crisalad_jax.data.images import decode_image
from crisalad_jax.data.positions import AXES, Positions
from crisalad_jax.data.tracks import Track
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.files import check_source
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.shapes import Int64

_LOG = f"a ROS bag ({' '.join(LOG_SUFFIXES)}, or the folder of a ROS 2 bag)"
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FIXES = ("sensor_msgs/msg/NavSatFix",)
_POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)
_READ = (*_IMAGES, *_FIXES, *_POSES)
_NO_FIX = -1
"""STATUS_NO_FIX of NavSatStatus."""
_OPEN = 2
"""Number of logs that stay open between frames."""
_FAR = 30 * 10**9
"""Nanoseconds ahead from which opening a log there is faster than reading all in between."""
_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "rgb8": ("u1", 3, None),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "rgb16": ("u2", 3, None),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2RGB),
    **dict.fromkeys(("bgr8", "8UC3"), ("u1", 3, cv2.COLOR_BGR2RGB)),
    **dict.fromkeys(("bgra8", "8UC4"), ("u1", 4, cv2.COLOR_BGRA2RGB)),
    **dict.fromkeys(("mono8", "8UC1"), ("u1", 1, None)),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1, None)),
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGRBG2RGB),
    **dict.fromkeys(("yuv422", "uyvy"), ("u1", 2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), ("u1", 2, cv2.COLOR_YUV2RGB_YUY2)),
    "32FC1": ("f4", 1, None),
}
"""Type of a value, values per pixel, and OpenCV's conversion to RGB."""


class Topic(NamedTuple):
    """A topic of a log."""

    name: str
    type: str
    """Type of its messages as ROS 2 writes it, such as sensor_msgs/msg/Image."""
    count: int
    """Number of its messages."""

    def __str__(self) -> str:
        """Return its name, type and number of messages, for a list."""
        return f"{self.name} ({self.type.rpartition('/')[2]}, {self.count})"


class _Frames(NamedTuple):
    """The images of a topic."""

    stamps: Int64[np.ndarray, " n"]
    """In order, each once."""
    numbers: Int64[np.ndarray, " n"]
    """Number of each image's message, in the log's order."""
    logged: Int64[np.ndarray, " m"]
    """When each message was logged, in the log's order."""


class Log:
    """A robot log: its topics, the images of one topic, and the positions of another.

    Stamps are nanoseconds since 1970: from the message's header or, if that has none, the time of
    logging. Only stamps and positions stay in memory, and threads may share a log.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open the log at `path`; unlike `open_log`, do not reuse an open one."""
        self.path = pathlib.Path(path)
        with _reader(self.path) as reader:
            found: dict[str, Topic] = {}
            for each in reader.connections:
                count = each.msgcount + (found[each.topic].count if each.topic in found else 0)
                found[each.topic] = Topic(each.topic, each.msgtype, count)
        self.topics: Sequence[Topic] = sorted(found.values())
        """All topics, sorted by name."""
        self._lock = threading.RLock()
        self._rows: dict[str, list[tuple[float, ...]]] = {}
        self._known: dict[str, _Frames] = {}
        self._stream: Iterator[tuple[int, Any]] = iter(())
        self._begun: tuple[str, int] = ("", 0)
        """Topic of the stream, and when its first message was logged."""
        self._next = 0
        """Number of the message that the stream is at."""

    def image_topic(self, name: str | None = None) -> str:
        """Return the name of the topic that images are taken from.

        Args:
            name: the topic's name; None takes the only one that has images.

        Raises:
            InputError: there is no such topic with images, or several and `name` is None.
        """
        found = self._topics(_IMAGES)
        if name is None and len(found) == 1:
            return found[0].name
        chosen = next((each.name for each in found if each.name == name), None)
        if chosen is None:
            raise self._no_topic(name, found, "images", "--topic")
        return chosen

    def position_topic(self, name: str | None = None) -> str | None:
        """Return the name of the topic that positions are taken from; None if there is none.

        Args:
            name: the topic's name; "none" takes none. None takes the only topic of NavSatFix or,
                without any of that type, of odometry or poses; of several it takes none, and warns.

        Raises:
            InputError: the log has no such topic, or the topic has no positions.
        """
        fixes, poses = self._topics(_FIXES), self._topics(_POSES)
        if name == "none":
            return None
        if name is None:
            found = fixes or poses
            if len(found) > 1:
                listed = ", ".join(map(str, found))
                warn(f"{self.path}: took no positions from {listed}: --position-topic chooses one")
            return found[0].name if len(found) == 1 else None
        if name not in (each.name for each in fixes + poses):
            raise self._no_topic(name, fixes + poses, "positions", "--position-topic")
        return name

    def _topics(self, types: Sequence[str]) -> list[Topic]:
        return [topic for topic in self.topics if topic.type in types and topic.count]

    def _no_topic(
        self, name: str | None, there: Sequence[Topic], kind: str, flag: str
    ) -> InputError:
        listed = ", ".join(map(str, there or self.topics)) or "none"
        if not there:
            words = f"no topic of {kind} among {listed}, expected one"
        elif name is None:
            words = f"{len(there)} topics of {kind}, expected {flag} with one of {listed}"
        else:
            words = f"{flag} {name}, expected a topic of {kind}: {listed}"
        return InputError(f"{self.path}: found {words}")

    def images(self, topic: str | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the stamp (in nanoseconds) and pixels of each image of a topic, in the log's order.

        Args:
            topic: see `image_topic`.

        Raises:
            InputError: the topic is not one that `image_topic` accepts, or an image cannot be read.
        """
        name = self.image_topic(topic)
        for _, logged, message in self._messages([name]):
            stamp = _stamp(message, logged)
            yield stamp, decode_message(message, str(FrameName(str(self.path), name, stamp)))

    def stamps(self, topic: str) -> Int64[np.ndarray, " n"]:
        """Return a topic's image stamps in nanoseconds, sorted and unique; warn if they were not.

        Raises:
            InputError: the log cannot be read.
        """
        return self._frames(topic).stamps

    def read(self, topic: str, stamp: int, *, enough: tuple[int, int] | None = None) -> np.ndarray:
        """Read a topic's first image at or after a stamp in nanoseconds, as `read_pixels` does.

        Raises:
            InputError: there is no such image, or it cannot be decoded.
        """
        name = str(FrameName(str(self.path), topic, stamp))
        self.image_topic(topic)
        with self._lock:
            frames = self._frames(topic)
            at = int(np.searchsorted(frames.stamps, stamp))
            if at == len(frames.stamps):
                raise InputError(f"{name}: found no image there, expected a stamp in the log")
            message = self._message(topic, int(frames.numbers[at]), frames.logged)
        return decode_message(message, name, enough=enough)

    def positions(self, topic: str | None = None) -> Track | None:
        """Read positions over time; None if the log has none.

        Messages without a fix, or with values that are not finite, are left out.

        Args:
            topic: see `position_topic`.

        Raises:
            InputError: `position_topic` does not accept the topic, the topic has no position, or
                the log cannot be read.
        """
        name = self.position_topic(topic)
        if name is None:
            return None
        self.scan(name)
        rows = self._rows[name]
        if not rows:
            if topic is None:
                warn(f"{self.path}: took no positions: {name} has no message with a fix")
                return None
            raise InputError(f"{self.path}: found no fix in {name}, expected at least one")
        is_fix = name in (each.name for each in self._topics(_FIXES))
        times, first = np.unique([row[0] for row in rows], return_index=True)
        points = np.array([row[1:] for row in rows])[first]
        return Track(f"{self.path}#{name}", AXES[1 if is_fix else 2], times / 10**9, points)

    def scan(self, *topics: str) -> None:
        """Read and store the stamps and positions of topics in one pass, for later calls.

        Raises:
            InputError: the log cannot be read.
        """
        with self._lock:
            new = [topic for topic in topics if topic not in self._rows]
            rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in new}
            for topic, logged, message in self._messages(new) if new else ():
                stamp = _stamp(message, logged)
                if message.__msgtype__ in _IMAGES:
                    rows[topic].append((stamp, logged))
                elif (position := _position(message)) is not None:
                    rows[topic].append((stamp, *position))
            self._rows |= rows

    def _frames(self, topic: str) -> _Frames:
        with self._lock:
            if topic not in self._known:
                self.scan(topic)
                times = np.array(self._rows[topic], np.int64).reshape(-1, 2)
                if not len(times):
                    raise InputError(f"{self.path}: found no image in {topic}, expected some")
                self._known[topic] = _Frames(*self._ordered(topic, times[:, 0]), times[:, 1])
            return self._known[topic]

    def _ordered(self, topic: str, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sort stamps, and leave out repeated ones."""
        ordered, numbers = np.unique(stamps, return_index=True)
        back = -np.diff(stamps)[np.diff(stamps) < 0]
        if len(back):
            warn(
                f"{self.path}: the stamps of {topic} go back {counted(len(back), 'time')}, by up "
                f"to {back.max() / 10**9:.6g} s: its images are in the order of their stamps"
            )
        if len(ordered) < len(stamps):
            warn(
                f"{self.path}: left out {len(stamps) - len(ordered)} of {len(stamps)} images of "
                f"{topic}, whose stamps repeat earlier ones"
            )
        return ordered, numbers

    def _message(self, topic: str, number: int, logged: np.ndarray) -> Any:
        """Read a message, forwards from the last one if it is not far ahead."""
        time, (of, start) = int(logged[number]), self._begun
        self._begun = ("", 0)  # a stream that fails is not used again
        forwards = of == topic and time >= start and number >= self._next
        if not forwards or time > logged[self._next] + _FAR:
            numbers, start = np.flatnonzero(logged >= time).tolist(), time
            messages = (message for _, _, message in self._messages([topic], start))
            self._stream = zip(numbers, messages, strict=False)
        for found, message in self._stream:
            if found == number:
                self._begun, self._next = (topic, start), found + 1
                return message
        raise InputError(f"{self.path}: found another file than before, expected the same log")

    def _messages(
        self, topics: Sequence[str], start: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of logging and content of messages logged from a time on."""
        read = _typestore(self.path.suffix.lower() == ".bag")
        with _reader(self.path) as reader:
            there = [each for each in reader.connections if each.msgtype in _READ]
            chosen = [each for each in there if each.topic in topics]
            for connection, logged, data in reader.messages(chosen, start=start):
                yield connection.topic, logged, read(data, connection.msgtype)


def open_log(path: str | os.PathLike[str]) -> Log:
    """Open a robot log; the two opened last are cached until their files change.

    Args:
        path: a ROS 1 bag (.bag), or a ROS 2 bag: a file .mcap or .db3, or its folder.

    Raises:
        InputError: the file is missing or incomplete, or the extra `robot` is not installed.
    """
    path = pathlib.Path(path)
    if not path.is_dir():
        check_source(path, _LOG)
    files = [path, *(path.iterdir() if path.is_dir() else ())]
    changed = max(file.stat().st_mtime_ns for file in files)
    return _as_of(os.path.abspath(path), stored_bytes(path), changed)


@functools.lru_cache(maxsize=_OPEN)
def _as_of(path: str, size: int | None, changed: int) -> Log:
    """Open a log; its size and time of change are part of the cache's key."""
    return Log(path)


@contextlib.contextmanager
def _reader(path: pathlib.Path) -> Iterator[Any]:
    """Open a reader of a log; any error in the file becomes an InputError."""
    try:
        from rosbags import rosbag1, rosbag2
    except ModuleNotFoundError as error:
        raise InputError(missing_extra(error, str(path))) from error
    # For a damaged file, rosbags raises whatever its parsers, decompressors and SQLite raise.
    try:
        with (rosbag1 if path.suffix.lower() == ".bag" else rosbag2).Reader(path) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{path}: found a log that cannot be read ({type(error).__name__}: {error}), expected "
            f"{_LOG} that is whole; `mcap recover`, `rosbag reindex` or `ros2 bag reindex` may "
            "repair it"
        ) from error


@functools.cache
def _typestore(is_ros1: bool) -> Any:
    """Return the decoder of ROS 1 or ROS 2 messages; all releases share the common types."""
    from rosbags.typesys import Stores, get_typestore

    if is_ros1:
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr


def _stamp(message: Any, logged: int) -> int:
    stamp = message.header.stamp
    nanoseconds = stamp.sec * 10**9 + stamp.nanosec
    return nanoseconds if nanoseconds > 0 else logged


def _position(message: Any) -> tuple[float, float] | None:
    """Return latitude and longitude, or x and y; None without a fix."""
    if message.__msgtype__ in _FIXES:
        at = message.latitude, message.longitude
        is_fix = message.status.status != _NO_FIX and abs(at[0]) <= 90 and abs(at[1]) <= 180
        return at if is_fix else None
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    at = pose.position.x, pose.position.y
    return at if np.isfinite(at).all() else None


def decode_message(
    message: Any, name: str = "message", *, enough: tuple[int, int] | None = None
) -> np.ndarray:
    """Decode a ROS image message as `read_pixels` decodes a file.

    Args:
        message: sensor_msgs/Image or CompressedImage, from rosbags or rclpy.
        name: prefix of error messages.
        enough: see `read_image`.

    Returns:
        RGB (height, width, 3) or grey (height, width); 8 bits, or more as in `mono16`.

    Raises:
        InputError: the encoding is unknown, there are fewer bytes than the image needs, or
            compressed data does not decode.

    Example:
        >>> import types
        >>> from crisalad_jax import decode_message
        >>> grey = {"encoding": "mono8", "height": 2, "width": 3, "step": 4, "is_bigendian": 0}
        >>> decode_message(types.SimpleNamespace(**grey, data=bytes(range(8)))).tolist()
        [[0, 1, 2], [4, 5, 6]]
    """
    data = np.frombuffer(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        return decode_image(data.tobytes(), f"{name} ({message.format!r})", enough=enough)
    if message.encoding not in _ENCODINGS:
        raise InputError(
            f"{name}: found an image of encoding {message.encoding!r}, expected one of "
            f"{', '.join(_ENCODINGS)}"
        )
    kind, channels, conversion = _ENCODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = message.height, message.width, message.step
    row = width * channels * dtype.itemsize
    if not (height and 0 < row <= step and height * step <= data.size):
        raise InputError(
            f"{name}: found {data.size} bytes of {height} rows of {step}, expected rows of at "
            f"least {row}, for {width} pixels of {message.encoding}"
        )
    rows = np.array(data[: height * step].reshape(height, step)[:, :row])
    pixels = rows.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    image = pixels if channels == 1 else pixels.reshape(height, width, channels)
    try:
        return image if conversion is None else cv2.cvtColor(image, conversion)
    except cv2.error as error:  # such as an odd width of YUV 4:2:2
        raise InputError(f"{name}: found {' '.join(error.err.split())}") from error


def name_log_frame(frame: FrameName) -> pathlib.Path:
    """Name a log's frame by its actual stamp: the first at or after the frame's time.

    Returns:
        The name. A time after the last frame is unchanged; reading that frame then fails.

    Raises:
        InputError: the log cannot be read, or has no such topic.
    """
    log = open_log(frame.file)
    stamps = log.stamps(log.image_topic(frame.topic))
    at = int(np.searchsorted(stamps, frame.nanoseconds))
    own = int(stamps[at]) if at < len(stamps) else frame.nanoseconds
    return pathlib.Path(str(frame._replace(nanoseconds=own)))


class ListedFrames(NamedTuple):
    """The frames that `list_log_frames` takes from a log."""

    paths: list[pathlib.Path]
    there: int
    """Number of all frames of the topic, including those not taken."""
    positions: Positions | None
    """Positions of these frames by path; None if the log has none."""


def list_log_frames(
    path: pathlib.Path,
    fps: float = 1.0,
    *,
    topic: str | None = None,
    position_topic: str | None = None,
) -> ListedFrames:
    """List a log's first image at or after each multiple of 1 / fps seconds, with its position.

    Args:
        path: the log.
        fps: frames per second, counted from the first image; a rate above the log's lists all.
        topic: see `Log.image_topic`.
        position_topic: see `Log.position_topic`.

    Raises:
        InputError: the log cannot be read, or does not have the topics.
    """
    log = open_log(path)
    name, place = log.image_topic(topic), log.position_topic(position_topic)
    log.scan(name, *([] if place is None else [place]))
    stamps = log.stamps(name)
    since = (stamps - stamps[0]) // 1_000_000
    chosen = stamps[sampled(since.tolist(), fps)]
    paths = [pathlib.Path(str(FrameName(str(path), name, each))) for each in chosen.tolist()]
    track = None if place is None else log.positions(position_topic)
    if track is None:
        return ListedFrames(paths, len(stamps), None)
    points, gaps = track.interpolate(chosen / 10**9)
    (inside,) = np.isfinite(points[:, 0]).nonzero()
    outside = len(chosen) - len(inside)
    warn(
        f"{path}: {place} has positions of {len(inside)} of {len(chosen)} images"
        + (f", {outside} are outside its time" if outside else "")
        + (f"; the largest gap is {gaps[inside].max():.3g} s" if len(inside) else "")
    )
    of = {str(paths[i]): (float(points[i, 0]), float(points[i, 1])) for i in inside}
    return ListedFrames(paths, len(stamps), Positions(track.axes, of) if of else None)
