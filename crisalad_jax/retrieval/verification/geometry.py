"""Two-view geometry of matched points: inliers, relative pose, pose from depth, pose on a map.

Directions of points are x / z and y / z in the axes of their camera, as `Intrinsics.directions`
returns them. A pose (rotation, translation) maps the first camera's coordinates to the second's.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.retrieval.verification.results import MapPose
from crisalad_jax.utils.shapes import Bool, Float64, Int64

Points = Float64[np.ndarray, "n 2"]
LEAST = 8
"""Minimum number of matches for an epipolar geometry, and of inliers for a pose."""
_SURE, _TRIALS = 0.9999, 10_000
"""Probability of an outlier-free sample at which RANSAC stops, and its sample limit."""


class Pose(NamedTuple):
    """A rotation R and a translation t, which map x to R x + t; t is in metres or of length 1."""

    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    @property
    def inverse(self) -> "Pose":
        """The pose from the second camera to the first."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)


def epipolar_inliers(first: Points, second: Points, distance: float) -> Bool[np.ndarray, " n"]:
    """Find the matches that one fundamental matrix explains, by MAGSAC++ with a fixed seed.

    Args:
        first: pixels (x, y) in one image.
        second: the matching pixels in the other image; fewer than 8 matches have no inliers.
        distance: maximum distance from an epipolar line, in pixels.
    """
    none = np.zeros(len(first), bool)
    if len(first) < LEAST:
        return none
    try:
        _, mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, distance, _SURE, _TRIALS)
    except cv2.error:  # OpenCV 5.0 asserts that it finds a model
        return none
    return none if mask is None else mask[:, 0].astype(bool)


def rotation_only(
    first: Points, second: Points, distance: float
) -> Float64[np.ndarray, "3 3"] | None:
    """Compute the rotation between two cameras at one place (Kabsch 1976); None if they are apart.

    Args:
        first: directions of points from the first camera.
        second: directions of the same points from the second.
        distance: maximum distance between unit rays after rotation, for at least 90 % of points.
    """
    if len(first) < LEAST:
        return None
    ours, theirs = (np.column_stack([each, np.ones(len(each))]) for each in (first, second))
    ours, theirs = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (ours, theirs))
    left, _, right = np.linalg.svd(theirs.T @ ours)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    near = np.linalg.norm(ours @ rotation.T - theirs, axis=1) < distance
    return rotation if near.mean() >= 0.9 else None


def relative_pose(first: Points, second: Points, distance: float) -> Pose | None:
    """Compute the pose between two cameras, with a unit translation; None with under 8 inliers.

    Args:
        first: directions of points from the first camera.
        second: directions of the same points from the second.
        distance: maximum distance of an inlier from an epipolar line, in the unit of directions.
    """
    if len(first) < LEAST:
        return None
    eye = np.eye(3)
    try:
        matrix, mask = cv2.findEssentialMat(
            first, second, eye, cv2.USAC_MAGSAC, _SURE, distance, _TRIALS
        )
        if matrix is None or matrix.shape != (3, 3):
            return None
        count, rotation, translation, _ = cv2.recoverPose(matrix, first, second, eye, mask=mask)
    except cv2.error:
        return None
    return Pose(rotation, translation[:, 0]) if count >= LEAST else None


def pose_from_points(
    points: Float64[np.ndarray, "n 3"], directions: Points, distance: float
) -> Pose | None:
    """Compute a camera's pose from 3D points (metres) and directions, by PnP; None if it fails."""
    if len(points) < LEAST:
        return None
    eye = np.eye(3)
    how: Any = {"confidence": _SURE, "iterationsCount": _TRIALS, "flags": cv2.USAC_MAGSAC}
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points, directions, eye, None, reprojectionError=distance, **how
        )
        if not found or inliers is None or len(inliers) < LEAST:
            return None
        chosen = np.asarray(inliers[:, 0], int)
        turn, shift = cv2.solvePnPRefineLM(
            points[chosen], directions[chosen], eye, None, turn, shift
        )
    except cv2.error:
        return None
    return Pose(cv2.Rodrigues(turn)[0], shift[:, 0])


def triangulated(first: Points, second: Points, pose: Pose) -> Float64[np.ndarray, "n 3"]:
    """Triangulate points in the second camera's axes from their directions from two cameras.

    Coordinates are in the unit of the pose's translation; points behind a camera are NaN.
    """
    to_first = np.column_stack(pose.inverse)
    found = cv2.triangulatePoints(np.eye(3, 4), to_first, second.T, first.T)
    points = (found[:3] / found[3]).T
    depths = points @ to_first[2, :3] + to_first[2, 3]
    return np.where(((points[:, 2] > 0) & (depths > 0))[:, None], points, np.nan)


def common_points(first: Points, second: Points) -> tuple[Int64[np.ndarray, " m"], ...]:
    """Return the rows, in each of two arrays of keypoints, of the keypoints that are in both."""
    rows = {tuple(point): row for row, point in enumerate(first.tolist())}
    points = map(tuple, second.tolist())
    pairs = [(rows[point], row) for row, point in enumerate(points) if point in rows]
    return tuple(np.array(pairs, int).reshape(-1, 2).T)


def pose_on_map(
    pose: Pose,
    other: Float64[np.ndarray, " 3"],
    here: Sequence[float],
    there: Sequence[float],
) -> MapPose:
    """Compute where a level camera is on a map, and its heading, from two answers' positions.

    Args:
        pose: pose from the camera to the first answer's camera, in metres.
        other: vector from the first answer's camera to the second's, in the first's axes.
        here: position of the first answer, in metres east and north.
        there: position of the second answer.
    """
    east, north = np.subtract(there, here)
    heading = np.arctan2(east, north) - np.arctan2(other[0], other[2])
    right, _, ahead = pose.translation
    sin, cos = np.sin(heading), np.cos(heading)
    position = here[0] + right * cos + ahead * sin, here[1] - right * sin + ahead * cos
    looks = heading + np.arctan2(pose.rotation[0, 2], pose.rotation[2, 2])
    return MapPose((float(position[0]), float(position[1])), float(np.rad2deg(looks) % 360))
