"""Results of verification: the inliers of a query and an answer, and the pose of the camera."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.shapes import Float64


@brief
class Verification(NamedTuple):
    """The matched local features of a query and one answer, and the pose that they imply.

    Cameras use OpenCV's axes: x to the right, y down, z ahead.
    """

    inliers: int
    """Number of matches that one epipolar geometry explains."""
    matches: int
    """Number of matches of local features."""
    confidence: float
    """inliers / (8 + 0.3 matches), at most 1: at 1, Brown and Lowe (IJCV 2007, section 3.2) accept
    two images as views of one scene."""
    query_points: Float64[np.ndarray, "inlier 2"]
    """Pixels (x, y) of the inliers in the query's file."""
    database_points: Float64[np.ndarray, "inlier 2"]
    """Pixels (x, y) of the same inliers in the answer's file."""
    rotation: Float64[np.ndarray, "3 3"] | None = None
    """Rotates vectors from the query camera's axes to the answer camera's; None without intrinsics,
    at a confidence below 1, or if no pose is found."""
    direction: Float64[np.ndarray, " 3"] | None = None
    """Unit vector from the answer's camera to the query's, in the answer camera's axes. None if
    `rotation` is None, or if both cameras were at the same place."""
    translation: Float64[np.ndarray, " 3"] | None = None
    """Metres from the answer's camera to the query's, in the answer camera's axes; None if there is
    neither depth nor a second answer at a known distance from this one."""

    def fields(self) -> dict[str, Any]:
        """Return the fields except points, for JSON; the rotation is a quaternion (x, y, z, w)."""
        fields: dict[str, Any] = {"inliers": self.inliers, "matches": self.matches}
        fields["confidence"] = round(self.confidence, 4)
        if self.rotation is not None:
            vector = cv2.Rodrigues(self.rotation)[0][:, 0]
            angle = float(np.linalg.norm(vector))
            # sin(angle / 2) / angle, which has a limit at 0.
            axis = np.sinc(angle / (2 * np.pi)) / 2 * vector
            fields["rotation_degrees"] = round(float(np.rad2deg(angle)), 2)
            fields["quaternion"] = np.round([*axis, np.cos(angle / 2)], 6).tolist()
        for name, value in (("direction", self.direction), ("translation", self.translation)):
            if value is not None:
                fields[name] = np.round(value, 4).tolist()
        return fields


@brief
class MapPose(NamedTuple):
    """The pose of a query's camera on the map, from two answers with positions."""

    position: tuple[float, float]
    """Position along the map's axes: metres, or latitude and longitude."""
    heading: float
    """View direction in degrees clockwise from north, or in a map of x and y from the y axis."""
