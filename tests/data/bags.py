"""ROS bags for tests, written by rosbags and, as an independent writer, by mcap-ros2-support."""

import pathlib
import shutil
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
"""Stamp of the first message of most bags."""
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
FORMS = ("walk.bag", "walk.db3", "walk.mcap", "walk", "other.mcap")
"""Files that `write_bag` makes: `walk` is a folder, `other.mcap` is by mcap-ros2-support."""


class Message(NamedTuple):
    topic: str
    logged: int
    type: str
    fields: dict[str, Any]


def header(stamp: int) -> dict[str, Any]:
    seconds, nanoseconds = divmod(stamp, SECOND)
    return {"seq": 0, "stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "camera"}


def image(
    stamp: int,
    pixels: np.ndarray,
    encoding: str = "rgb8",
    *,
    topic: str = "/camera/image_raw",
    logged: int | None = None,
    padding: int = 0,
    big: bool = False,
    **fields: Any,
) -> Message:
    """An image of pixels as they lie in memory, each row with some bytes of padding after it."""
    swapped = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = np.ascontiguousarray(swapped).view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    content = {
        "header": header(stamp),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": int(big),
        "step": data.shape[1],
        "data": data.reshape(-1),
    }
    when = stamp if logged is None else logged
    return Message(topic, when, "sensor_msgs/msg/Image", content | fields)


def compressed(
    stamp: int, data: bytes, kind: str = "jpeg", topic: str = "/camera/compressed"
) -> Message:
    content = {"header": header(stamp), "format": kind, "data": np.frombuffer(data, np.uint8)}
    return Message(topic, stamp, "sensor_msgs/msg/CompressedImage", content)


def fix(
    stamp: int, latitude: float, longitude: float, status: int = 0, topic: str = "/gps/fix"
) -> Message:
    content = {
        "header": header(stamp),
        "status": {"status": status, "service": 1},
        "latitude": latitude,
        "longitude": longitude,
        "altitude": 0.0,
        "position_covariance": np.zeros(9),
        "position_covariance_type": 0,
    }
    return Message(topic, stamp, "sensor_msgs/msg/NavSatFix", content)


def pose(stamp: int, x: float, y: float, kind: str = "Odometry", topic: str = "/odom") -> Message:
    place = {
        "position": {"x": x, "y": y, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    uncertain = {"pose": place, "covariance": np.zeros(36)}
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    twist = {"twist": {"linear": zero, "angular": zero}, "covariance": np.zeros(36)}
    content: dict[str, Any] = {"header": header(stamp)}
    if kind == "Odometry":
        content |= {"child_frame_id": "base", "pose": uncertain, "twist": twist}
        return Message(topic, stamp, "nav_msgs/msg/Odometry", content)
    content["pose"] = place if kind == "PoseStamped" else uncertain
    return Message(topic, stamp, f"geometry_msgs/msg/{kind}", content)


def text(stamp: int, topic: str = "/chatter") -> Message:
    return Message(topic, stamp, "std_msgs/msg/String", {"data": "hello"})


def _made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """A message of rosbags, from plain fields."""
    values = {
        name: _made(store, what[1], fields[name]) if what[0] == Nodetype.NAME else fields[name]
        for name, what in store.fielddefs[kind][1]
    }
    return store.types[kind](**values)


def write_bag(path: pathlib.Path, messages: Iterable[Message], **options: Any) -> pathlib.Path:
    """Write a bag of the form that the path says: a suffix, or none for a ROS 2 folder."""
    if path.name.startswith("other"):
        return _write_other(path, messages, **options)
    if path.suffix == ".bag":
        store, serialize = ROS1, ROS1.serialize_ros1
        writer: Any = Writer1(path)
        if options:
            writer.set_compression(*options["compression"])
    else:
        store, serialize = ROS2, ROS2.serialize_cdr
        folder = path if not path.suffix else path.with_name(f"{path.name}-folder")
        kind = StoragePlugin.SQLITE3 if path.suffix == ".db3" else StoragePlugin.MCAP
        writer = Writer2(folder, version=9, storage_plugin=kind)
        if options:
            writer.set_compression(*options["compression"])
    with writer:
        connections: dict[str, Any] = {}
        for topic, logged, kind, fields in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], logged, serialize(_made(store, kind, fields), kind))
    if path.suffix in (".db3", ".mcap"):
        next(folder.glob(f"*{path.suffix}")).rename(path)
        shutil.rmtree(folder)
    return path


def _write_other(path: pathlib.Path, messages: Iterable[Message], **options: Any) -> pathlib.Path:
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        schemas: dict[str, Any] = {}
        for topic, logged, kind, fields in messages:
            if kind not in schemas:
                definition = ROS2.generate_msgdef(kind, ros_version=2)[0]
                schemas[kind] = writer.register_msgdef(kind, definition)
            writer.write_message(topic, schemas[kind], _plain(fields), logged)
        writer.finish()
    return path


def _plain(fields: Any) -> Any:
    if isinstance(fields, dict):
        return {name: _plain(value) for name, value in fields.items()}
    if isinstance(fields, np.ndarray):
        return fields.tobytes() if fields.dtype == np.uint8 else fields.tolist()
    return fields
