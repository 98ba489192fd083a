"""What a node needs of ROS 2, which PyPI does not have: message classes and a small rclpy.

Fields, constants and defaults of messages are those of the definitions that rosbags ships, and
values are checked as rclpy's generated classes check them: a number with a decimal point is no
integer, a byte is bytes, and there is no other field.
"""

import array
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
_PYTHON = {"string": str, "bool": bool, "byte": bytes, "float32": float, "float64": float}
_CLASSES: dict[str, type] = {}


def message_class(name: str) -> type:
    """The class of a message such as sensor_msgs/msg/Image."""
    if name not in _CLASSES:
        constants, fields = STORE.fielddefs[name]
        known = dict(fields)

        def begin(self: Any, **given: Any) -> None:
            for field, kind in known.items():
                object.__setattr__(self, field, _default(kind))
            for field, value in given.items():
                setattr(self, field, value)

        def assign(self: Any, field: str, value: Any) -> None:
            if field not in known:
                raise AttributeError(f"{name} has no field {field}")
            assert _fits(known[field], value), (name, field, value)
            object.__setattr__(self, field, value)

        values = {key: bytes([v]) if kind == "byte" else v for key, kind, v in constants}
        _CLASSES[name] = type(
            name.rpartition("/")[2],
            (),
            {"__init__": begin, "__setattr__": assign, "ros_type": name} | values,
        )
    return _CLASSES[name]


def _default(kind: Any) -> Any:
    node, of = kind
    if node == Nodetype.NAME:
        return message_class(of)()
    if node == Nodetype.BASE:
        plain = _PYTHON.get(of[0], int)
        return bytes(1) if plain is bytes else plain()
    return [_default(of[0]) for _ in range(of[1] if node == Nodetype.ARRAY else 0)]


def _fits(kind: Any, value: Any) -> bool:
    node, of = kind
    if node == Nodetype.NAME:
        return isinstance(value, message_class(of))
    if node == Nodetype.BASE:
        plain = _PYTHON.get(of[0], int)
        return type(value) is plain and (plain is not bytes or len(value) == 1)
    if of[0] == (Nodetype.BASE, ("uint8", 0)):
        return isinstance(value, array.array) and value.typecode == "B"
    is_whole = node == Nodetype.SEQUENCE or len(value) == of[1]
    return isinstance(value, list) and is_whole and all(_fits(of[0], each) for each in value)


def to_bytes(message: Any) -> bytes:
    """A message as rosbags serialises it, in CDR."""
    return bytes(STORE.serialize_cdr(_of_rosbags(message), message.ros_type))


def _of_rosbags(value: Any) -> Any:
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, list):
        is_plain = not value or isinstance(value[0], float)
        return np.array(value) if is_plain and value else [_of_rosbags(each) for each in value]
    if not hasattr(value, "ros_type"):
        return value
    fields = {name: _of_rosbags(each) for name, each in vars(value).items()}
    return STORE.types[value.ros_type](**fields)


def of_rclpy(message: Any) -> Any:
    """A message that rosbags read, as rclpy has it: bytes are an array of the standard library."""
    if isinstance(message, np.ndarray):
        return array.array("B", message.tobytes())
    if not hasattr(message, "__msgtype__"):
        return message
    fields = STORE.fielddefs[message.__msgtype__][1]
    values = {name: of_rclpy(getattr(message, name)) for name, _ in fields}
    return message_class(message.__msgtype__)(**values)


class Future:
    """`rclpy.task.Future`."""

    def __init__(self) -> None:
        self._done, self._result, self._exception = threading.Event(), None, None

    def done(self) -> bool:
        return self._done.is_set()

    def set_result(self, result: Any) -> None:
        self._result = result
        self._done.set()

    def set_exception(self, exception: BaseException) -> None:
        self._exception = exception
        self._done.set()

    def result(self) -> Any:
        if self._exception is not None:
            raise self._exception
        return self._result


class Ros:
    """All that a node did, and what it is to be given.

    Args:
        parameters: as of the command line.
        messages: what is published to the node's only subscription.
        wait: seconds between two messages; None waits until each was handled.
        handled: how many messages the node was through with.
    """

    def __init__(
        self,
        parameters: dict[str, Any],
        messages: Sequence[Any],
        wait: float | None,
        handled: Callable[["Ros"], int],
    ) -> None:
        self.parameters, self.messages, self.wait = parameters, messages, wait
        self.handled = handled
        self.node: Any = None
        self.published: dict[str, list[Any]] = {}
        self.subscribed: list[tuple[type, str, Callable, Any]] = []
        self.said: list[str] = []
        self.is_up = False

    def init(self) -> None:
        self.is_up = True

    def try_shutdown(self) -> None:
        self.is_up = False

    def spin_until_future_complete(self, node: Any, future: Future) -> None:
        """Call the subscription with each message, and at the end press Ctrl-C."""
        ((_, _, callback, _),) = self.subscribed
        for sent, message in enumerate(self.messages, 1):
            callback(message)
            is_last = sent == len(self.messages)
            if self.wait is not None:
                time.sleep(self.wait)
            while (self.wait is None or is_last) and self.handled(self) < sent:
                if future.done():
                    return
                time.sleep(0.001)
        if not future.done():
            raise KeyboardInterrupt


def install(monkeypatch: pytest.MonkeyPatch, ros: Ros) -> None:
    """Put modules of ROS in place, for as long as a test runs."""

    class Node:
        """`rclpy.node.Node`."""

        def __init__(self, name: str) -> None:
            assert ros.is_up
            self._name, self._declared = name, {}
            ros.node = self

        def get_name(self) -> str:
            return self._name

        def declare_parameter(self, name: str, value: Any) -> None:
            given = ros.parameters.get(name, value)
            assert type(given) is type(value), (name, given)  # as ROS checks a parameter's type
            self._declared[name] = given

        def get_parameter(self, name: str) -> Any:
            return SimpleNamespace(value=self._declared[name])

        def create_publisher(self, kind: type, topic: str, qos: Any) -> Any:
            sent = ros.published.setdefault(topic, [])

            def publish(message: Any) -> None:
                assert isinstance(message, kind)
                to_bytes(message)
                sent.append(message)

            return SimpleNamespace(publish=publish)

        def create_subscription(self, kind: type, topic: str, callback: Callable, qos: Any) -> None:
            ros.subscribed.append((kind, topic, callback, qos))

        def create_timer(self, seconds: float, callback: Callable) -> None:
            assert seconds > 0

        def get_logger(self) -> Any:
            return SimpleNamespace(info=ros.said.append)

        def destroy_node(self) -> None:
            ros.said.append("destroyed")

    def module(name: str, **values: Any) -> None:
        made = ModuleType(name)
        vars(made).update(values)
        monkeypatch.setitem(sys.modules, name, made)

    functions = ("init", "try_shutdown", "spin_until_future_complete")
    module("rclpy", **{name: getattr(ros, name) for name in functions})
    module("rclpy.node", Node=Node)
    module("rclpy.qos", qos_profile_sensor_data="best effort, depth 5")
    module("rclpy.task", Future=Future)
    module("rclpy.executors", ExternalShutdownException=type("Shutdown", (Exception,), {}))
    for package in ("sensor_msgs", "geometry_msgs", "diagnostic_msgs"):
        module(package)
        module(f"{package}.msg", **dict(_classes(package)))


def _classes(package: str) -> Iterator[tuple[str, type]]:
    for name in STORE.fielddefs:
        if name.startswith(f"{package}/msg/"):
            yield name.rpartition("/")[2], message_class(name)
