"""The ROS 2 node of the examples, with stand-ins for rclpy, on the messages of a bag."""

import importlib.util
import math
import pathlib
import sys
from types import ModuleType

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.build import index
from tests.conftest import MODEL, read_options
from tests.data.bags import BEGIN, compressed, image, write_bag
from tests.ros_stand_ins import STORE, Ros, install, message_class, of_rclpy, to_bytes

FOLDER = pathlib.Path(__file__).parents[1] / "examples" / "ros2"
STEP = 33_000_001
"""Nanoseconds between two images: about 30 a second, of which none is whole milliseconds."""


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location("ros2_example", FOLDER / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def messages_of(bag: pathlib.Path) -> list:
    """All messages of a bag in order, as rclpy would give them, read by rosbags itself."""
    with Reader(bag) as reader:
        read = [STORE.deserialize_cdr(data, c.msgtype) for c, _, data in reader.messages()]
    return [of_rclpy(message) for message in read]


@pytest.fixture(scope="module")
def database(shared) -> list[pathlib.Path]:
    """Five images of different places."""
    return list_images(shared / "town" / "images" / "test" / "database")[:5]


@pytest.fixture(scope="module")
def maps(shared, params, database, tmp_path_factory) -> dict[str, pathlib.Path]:
    """Maps of the same images with positions in metres, in degrees, and without."""
    out = tmp_path_factory.mktemp("maps")
    made = {}
    for name in ("east,north", "lat,lon", "none"):
        (out / name).mkdir()
        rows = [f"name,{name}"]
        for number, path in enumerate(database):
            (out / name / f"{number}.jpg").write_bytes(path.read_bytes())
            rows.append(f"{number}.jpg,{40 + number}.25,{20 + number}.5")
        table = out / name / "positions.csv"
        table.write_text("\n".join(rows))
        positions = None if name == "none" else table
        more = {"weights": shared / "weights.safetensors", "positions": positions}
        made[name] = out / f"{name}.map"
        index(Model(params, MODEL), out / name, made[name], **more, **read_options({}))
    return made


@pytest.fixture
def bag(database, tmp_path) -> pathlib.Path:
    """A bag of the five images as raw messages, of several encodings, in that order."""
    pixels = [read_image(path) for path in database]
    messages = [
        image(BEGIN + STEP * n, each[..., ::-1] if n % 2 else each, "bgr8" if n % 2 else "rgb8")
        for n, each in enumerate(pixels)
    ]
    return write_bag(tmp_path / "walk", messages)


def handled(ros: Ros) -> int:
    """How many images were answered or dropped, as the node says."""
    return sum(1 + int(values(place)["dropped"]) for place in ros.published["~/place"])


def run(
    monkeypatch, folder: pathlib.Path, messages: list, *, wait: float | None = None, **parameters
) -> tuple[Ros, int]:
    """Run the node until it has handled all messages; what it did, and its exit code."""
    ros = Ros({"map": str(folder)} | parameters, messages, wait, handled)
    install(monkeypatch, ros)
    return ros, load("place_recognition_node.py").main()


def stamp(message) -> int:
    return 10**9 * message.header.stamp.sec + message.header.stamp.nanosec


def values(place) -> dict[str, str]:
    (status,) = place.status
    return {each.key: each.value for each in status.values}


def test_a_bag_is_answered_image_by_image(maps, bag, monkeypatch):
    ros, code = run(monkeypatch, maps["east,north"], messages_of(bag), min_similarity=0.9)
    assert code == 0
    places, poses = ros.published["~/place"], ros.published["~/pose"]
    assert [stamp(each) for each in places] == [BEGIN + STEP * number for number in range(5)]
    for number, (place, pose) in enumerate(zip(places, poses, strict=True)):
        (status,) = place.status
        assert (status.message, status.level) == (f"{number}.jpg", b"\0")
        said = values(place)
        assert (said["known"], said["dropped"]) == ("True", "0")
        assert (said["east"], said["north"]) == (f"{40 + number}.25", f"{20 + number}.5")
        assert float(said["similarity"]) > 0.99
        assert float(said["latency_ms"]) > 0
        assert said["place 2"] != status.message
        assert stamp(pose) == stamp(place)
        at = pose.pose.pose.position
        assert (at.x, at.y, at.z) == (40.25 + number, 20.5 + number, 0)
        assert np.diag(np.reshape(pose.pose.covariance, (6, 6))).tolist() == [25] * 2 + [1e6] * 4
        assert pose.header.frame_id == "map"
    assert "5 places, waiting for images of /camera/image_raw" in ros.said
    assert ros.said[-2].startswith("5 answers, latency median ")
    assert "dropped" not in ros.said[-2]
    assert ros.said[-1] == "destroyed"
    assert not ros.is_up


def test_images_faster_than_answers_are_answered_or_counted(maps, bag, monkeypatch):
    """A thousand a second: no image is lost silently, and the log has the total."""
    ros, _ = run(monkeypatch, maps["east,north"], 20 * messages_of(bag), wait=0.001)
    answered = len(ros.published["~/place"])
    assert handled(ros) == 100
    assert 1 < answered < 100
    assert ros.said[-2].startswith(f"{answered} answers, latency median ")
    assert ros.said[-2].endswith(f"; {100 - answered} frames dropped")


def test_degrees_are_a_fix_and_no_positions_are_a_name(maps, bag, monkeypatch):
    ros, _ = run(monkeypatch, maps["lat,lon"], messages_of(bag)[:1], min_similarity=-1.0)
    (fix,) = ros.published["~/fix"]
    assert (fix.latitude, fix.longitude) == (40.25, 20.5)
    assert math.isnan(fix.altitude)
    assert fix.position_covariance == [25.0, 0, 0, 0, 25.0, 0, 0, 0, 1e6]
    assert fix.position_covariance_type == 1  # approximated
    assert list(ros.published) == ["~/place", "~/fix"]
    ros, _ = run(monkeypatch, maps["none"], messages_of(bag)[:1], verify=2)
    (place,) = ros.published["~/place"]
    assert int(values(place)["inliers"]) >= 0
    assert place.status[0].message == "0.jpg"
    assert list(ros.published) == ["~/place"]


def test_unknown_places_are_a_warning_without_a_position(maps, bag, monkeypatch):
    black = image(BEGIN, np.zeros((50, 70, 3), np.uint8))
    unknown = write_bag(bag.with_name("unknown"), [black])
    messages = messages_of(unknown) + messages_of(bag)[:1]
    ros, _ = run(monkeypatch, maps["east,north"], messages, min_similarity=0.9)
    first, second = (each.status[0] for each in ros.published["~/place"])
    assert (first.message, first.level) == ("unknown place", b"\1")
    assert (second.message, second.level) == ("0.jpg", b"\0")
    assert values(ros.published["~/place"][0])["known"] == "False"
    (pose,) = ros.published["~/pose"]
    assert stamp(pose) == stamp(ros.published["~/place"][1])


def test_compressed_images_by_the_name_of_the_topic(maps, database, tmp_path, monkeypatch):
    data = [compressed(BEGIN, path.read_bytes()) for path in database[3:4]]
    messages = messages_of(write_bag(tmp_path / "walk", data))
    topic = "/camera/image_raw/compressed"
    ros, _ = run(monkeypatch, maps["none"], messages, image_topic=topic, sequence="bayes")
    ((kind, subscribed, _, _),) = ros.subscribed
    assert (kind.__name__, subscribed) == ("CompressedImage", topic)
    assert ros.published["~/place"][0].status[0].message == "3.jpg"
    ros, _ = run(monkeypatch, maps["none"], [])
    assert ros.subscribed[0][0].__name__ == "Image"


def test_what_is_wrong_is_one_line(maps, bag, monkeypatch, capfd):
    strange = messages_of(bag)[0]
    strange.encoding = "nv21"
    for folder, messages, parameters, words in (
        (bag.with_name("none"), [], {}, "none: found no map"),
        (maps["none"], [], {"k": 0}, "k: found 0, expected at least 1"),
        (maps["none"], [strange], {}, "found an image of encoding 'nv21', expected one of rgb8,"),
    ):
        _, code = run(monkeypatch, folder, messages, **parameters)
        error = capfd.readouterr().err
        assert code == 1
        assert error.startswith("place_recognition: ")
        assert words in error
        assert error.count("\n") == 1


def test_the_launch_file_has_every_parameter(monkeypatch):
    """And its defaults are the node's, read as YAML."""
    yaml = pytest.importorskip("yaml")
    modules = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": lambda name, default_value: (name, default_value),
            "ExecuteProcess": lambda cmd, output: cmd,
        },
        "launch.substitutions": {"LaunchConfiguration": lambda name: f"<{name}>"},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    install(monkeypatch, Ros({}, [], None, handled))
    parameters = load("place_recognition_node.py").PARAMETERS
    *declared, command = load("place_recognition.launch.py").generate_launch_description()
    defaults = dict(declared)
    assert defaults.pop("python") == "python3"
    assert defaults.pop("map") is None
    assert {name: repr(yaml.safe_load(text)) for name, text in defaults.items()} == {
        name: repr(value) for name, value in parameters.items() if name != "map"
    }
    assert command[:3] == ["<python>", str(FOLDER / "place_recognition_node.py"), "--ros-args"]
    given = command[3:]
    assert given[::2] == ["-p"] * len(parameters)
    assert given[1::2] == [[f"{name}:=", f"<{name}>"] for name in parameters]


def test_the_stand_ins_check_what_rclpy_checks():
    fix = message_class("sensor_msgs/msg/NavSatFix")
    for field, value in (("latitude", 1), ("position_covariance", [0.0] * 8), ("status", 3)):
        with pytest.raises(AssertionError):
            fix(**{field: value})
    with pytest.raises(AttributeError):
        fix(longtitude=1.0)
    read = STORE.deserialize_cdr(to_bytes(fix(latitude=1.5)), "sensor_msgs/msg/NavSatFix")
    assert read.latitude == 1.5


def test_the_readme_has_every_parameter_and_topic(monkeypatch):
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    install(monkeypatch, Ros({}, [], None, handled))
    for name in load("place_recognition_node.py").PARAMETERS:
        assert f"| `{name}` |" in text
    for topic in ("~/place", "~/pose", "~/fix"):
        assert f"| `{topic}` |" in text
