"""A ROS 2 node that publishes where on a map its camera is.

    python3 place_recognition_node.py --ros-args -p map:=m.map -p image_topic:=/camera/image_raw

It answers the newest image, and counts those that it skips while it is busy. For each answer it
publishes, with the stamp of the image:

- `~/place` (diagnostic_msgs/DiagnosticArray): the best place's name, whether the place is known,
  similarity, position, latency, and the number of skipped images; level OK or, for an unknown
  place, WARN;
- if the place is known, `~/pose` (geometry_msgs/PoseWithCovarianceStamped) in a map whose
  positions are in metres, or `~/fix` (sensor_msgs/NavSatFix) in a map with positions in degrees.
  A map without positions has neither.
"""

import math
import sys
import threading

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from sensor_msgs.msg import CompressedImage, Image, NavSatFix

import crisalad_jax as cj

PARAMETERS = {
    "map": "",  # folder that `crisalad index` wrote
    "image_topic": "/camera/image_raw",  # CompressedImage if it ends with /compressed
    "min_similarity": math.nan,  # lowest similarity of a known place; NaN: as calibrated
    "verify": 0,  # number of best places to verify by local features; needs their images
    "k": 3,  # places in each message, best first
    "fps": 0.0,  # maximum answers per second; 0: no limit
    "sequence": "",  # bayes: a filter over the camera's images so far
    "frame_id": "map",  # frame of the map's positions, for ~/pose and ~/fix
    "position_stddev": 5.0,  # metres between a place's position and the camera's
}
UNKNOWN = 1e6
"""Variance of unknown values: height, and the orientation of a pose."""
LOG_PERIOD = 10.0
"""Seconds between two log lines about latency."""


class PlaceRecognition(Node):
    """Puts images into a queue of one, which a thread answers."""

    def __init__(self) -> None:
        """Open the map, load and compile its model, and subscribe."""
        super().__init__("place_recognition")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        self.ended = Future()
        """Done when the thread has ended, with its exception."""
        self._places = cj.Map.open(self._value("map"))
        self._latest = cj.LatestFrame(fps=self._value("fps") or None)
        self._latencies: list[float] = []
        self._place = self.create_publisher(DiagnosticArray, "~/place", 1)
        self._position = None
        if self._places.axes == ("lat", "lon"):
            self._position = self.create_publisher(NavSatFix, "~/fix", 1)
        elif self._places.axes is not None:
            self._position = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 1)
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()
        self._ready.wait()  # a model compiles in seconds
        topic = self._value("image_topic")
        kind = CompressedImage if topic.endswith("/compressed") else Image
        # All images arrive here, so that skipped ones are counted and not lost in ROS's queue.
        self.create_subscription(kind, topic, self._take, qos_profile_sensor_data)
        self.create_timer(LOG_PERIOD, self.log)
        self.get_logger().info(f"{len(self._places)} places, waiting for images of {topic}")

    def _value(self, name: str):
        return self.get_parameter(name).value

    def _take(self, message) -> None:
        """Put an image into the queue, under its stamp in nanoseconds."""
        stamp = message.header.stamp
        nanoseconds = 10**9 * stamp.sec + stamp.nanosec
        self._latest.put(cj.decode_message(message), nanoseconds / 10**9, str(nanoseconds))

    def _answer(self) -> None:
        """Answer images until the queue is closed."""
        least = self._value("min_similarity")
        try:
            answers = cj.query_live(
                self._places,
                self._latest,
                k=self._value("k"),
                min_similarity=None if math.isnan(least) else least,
                verify=cj.Verify(answers=self._value("verify")) if self._value("verify") else None,
                sequence=cj.BayesFilter() if self._value("sequence") == "bayes" else None,
                ready=self._ready.set,
            )
            for answer in answers:
                self._latencies.append(answer.latency_ms)
                self._publish(answer)
            self.ended.set_result(None)
        except Exception as error:  # for `main`, because an error in a thread ends nothing
            self.ended.set_exception(error)
        self._ready.set()

    def _publish(self, answer) -> None:
        best, known = answer.ranked[0], answer.known
        seconds, nanoseconds = divmod(int(answer.answers.names[0]), 10**9)
        position = answer.answers.position(best.image)
        values = {
            "known": known,
            "similarity": round(best.similarity, 4),
            **(position or {}),
            "latency_ms": round(answer.latency_ms, 1),
            "dropped": answer.frame.dropped,
        }
        if answer.answers.checks:
            values["inliers"] = answer.answers.checks[0][0].inliers
        for other in answer.ranked[1:]:
            values[f"place {other.rank}"] = other.image.name
            values[f"similarity {other.rank}"] = round(other.similarity, 4)
        message = DiagnosticArray()
        message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
        message.header.frame_id = self._value("frame_id")
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK if known else DiagnosticStatus.WARN,
            name=self.get_name(),
            message=best.image.name if known else "unknown place",
            hardware_id=self._value("image_topic"),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message.status = [status]
        if known and position is not None:
            self._publish_position(message.header, *position.values())
        self._place.publish(message)

    def _publish_position(self, header, first: float, second: float) -> None:
        variance = self._value("position_stddev") ** 2
        if self._places.axes == ("lat", "lon"):
            fix = NavSatFix(header=header, latitude=first, longitude=second, altitude=math.nan)
            fix.position_covariance = [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, UNKNOWN]
            fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_APPROXIMATED
            self._position.publish(fix)
            return
        pose = PoseWithCovarianceStamped(header=header)
        pose.pose.pose.position.x, pose.pose.pose.position.y = first, second
        pose.pose.pose.orientation.w = 1.0
        covariance = [0.0] * 36
        covariance[::7] = [variance, variance, UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN]
        pose.pose.covariance = covariance
        self._position.publish(pose)

    def log(self) -> None:
        """Log the latency so far, and the number of skipped images."""
        self.get_logger().info(cj.latency_words(self._latencies, self._latest.dropped))

    def destroy_node(self) -> None:
        """End the thread, and close the map."""
        self._latest.close()
        self._thread.join()
        self._places.close()
        super().destroy_node()


def main() -> int:
    """Run the node until Ctrl-C, or an error."""
    rclpy.init()
    node = None
    try:
        node = PlaceRecognition()
        rclpy.spin_until_future_complete(node, node.ended)
        node.ended.result()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except cj.InputError as error:
        print(f"place_recognition: {error}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.log()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
