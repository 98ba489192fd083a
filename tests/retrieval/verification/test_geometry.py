"""Two-view geometry against points projected by hand."""

import cv2
import numpy as np
import pytest

from crisalad_jax.retrieval.verification.geometry import (
    Pose,
    common_points,
    epipolar_inliers,
    pose_from_points,
    pose_on_map,
    relative_pose,
    rotation_only,
    triangulated,
)
from tests.retrieval.verification.scene import (
    CAMERA,
    QUERY,
    SIZE,
    VIEWS,
    PointMatcher,
    degrees_between,
    relative,
)

DISTANCE = 1.5 / 400
"""1.5 pixels, as directions: five deviations of the noise."""
ROTATION, DIRECTION, METRES = 0.3, 2.0, 0.05
"""Of 130 points with a noise of 0.3 pixels of 400, which is 0.04 degrees, the pose has some 0.05
degrees; a translation of 2 m seen by points 10 m away is ten times as uncertain."""


@pytest.fixture
def pixels():
    return PointMatcher().match(QUERY, 0)


@pytest.fixture
def rays(pixels):
    return [CAMERA.directions(points, SIZE, "a view") for points in pixels]


def test_inliers_are_the_matches_that_are_right(pixels):
    mask = epipolar_inliers(*pixels, 1.5)
    right = np.arange(len(mask)) % 3 != 0
    assert mask[right].mean() > 0.95
    # By chance a wrong match is near its epipolar line: 3 of some 500 pixels.
    assert mask[~right].mean() < 0.1
    assert (epipolar_inliers(*pixels, 1.5) == mask).all()


@pytest.mark.parametrize("count", [0, 1, 7])
def test_too_few_points_show_nothing(rays, count):
    few = [each[:count] for each in rays]
    assert not epipolar_inliers(*few, 1.0).any()
    assert relative_pose(*few, DISTANCE) is None
    assert pose_from_points(np.ones((count, 3)), few[0], DISTANCE) is None
    assert rotation_only(*few, DISTANCE) is None


def test_points_in_one_place_show_nothing(pixels):
    """OpenCV finds no model, and asserts that it does."""
    same = np.tile(pixels[0][:1], (20, 1))
    assert not epipolar_inliers(same, same, 1.0).any()
    assert relative_pose(same, same, DISTANCE) is None


def test_a_relative_pose_is_that_of_the_cameras(rays):
    pose = relative_pose(*rays, DISTANCE)
    rotation, translation = relative(QUERY, 0)
    assert degrees_between(pose.rotation, rotation) < ROTATION
    assert degrees_between(pose.translation, translation) < DIRECTION
    assert np.linalg.norm(pose.translation) == pytest.approx(1)


def test_cameras_in_one_place_have_a_rotation_only(rays):
    """Turned by 20 degrees, with the noise of the scene; those that moved have none."""
    turn, _ = cv2.Rodrigues(np.deg2rad([3.0, 20, -5]))
    seen = VIEWS[0].see() @ turn.T
    noise = np.random.default_rng(0).normal(0, 0.3 / 400, (len(seen), 2))
    turned = seen[:, :2] / seen[:, 2:] + noise
    first = VIEWS[0].see()
    found = rotation_only(first[:, :2] / first[:, 2:], turned, DISTANCE)
    assert degrees_between(found, turn) < ROTATION
    assert np.linalg.det(found) == pytest.approx(1)
    assert rotation_only(*rays, DISTANCE) is None


def test_a_pose_from_points_is_in_metres(rays):
    pose = pose_from_points(VIEWS[0].see(), rays[0], DISTANCE)
    rotation, translation = relative(0, QUERY)
    assert degrees_between(pose.rotation, rotation) < ROTATION
    assert np.linalg.norm(pose.translation - translation) < METRES
    there, back = pose.inverse, Pose(rotation, translation).inverse
    assert np.linalg.norm(there.translation - back.translation) < METRES


def test_triangulated_points_are_where_they_are():
    ours, theirs = (VIEWS[number].see() for number in (1, 0))
    first, second = (each[:, :2] / each[:, 2:] for each in (ours, theirs))
    pose = Pose(*relative(1, 0))
    found = triangulated(first, second, pose)
    np.testing.assert_allclose(found, theirs, atol=1e-6)  # float64's rounding, some 1e-10
    # Rays that meet behind the cameras.
    assert np.isnan(triangulated(-first, second, pose)).any()


def test_common_points_are_those_of_both_lists():
    first = np.array([[1.0, 2], [3, 4], [5, 6.5]])
    ours, theirs = common_points(first, np.array([[5, 6.5], [9, 9], [1, 2]]))
    assert (ours.tolist(), theirs.tolist()) == ([2, 0], [0, 2])
    assert [len(each) for each in common_points(first, np.zeros((0, 2)))] == [0, 0]


@pytest.mark.parametrize(
    ("there", "position", "heading"),
    [
        # The answer looks at the other, which is north of it, or east, south-west.
        ((10, 25), (11, 22), 30),
        ((15, 20), (12, 19), 120),
        ((7, 17), (10 - 3 / 2**0.5, 20 - 1 / 2**0.5), 255),
    ],
)
def test_a_pose_on_the_map_by_hand(there, position, heading):
    """The camera is 1 m to the right of the answer's and 2 m ahead, turned right by 30 degrees."""
    turn, _ = cv2.Rodrigues(np.array([0, np.deg2rad(30), 0]))
    found = pose_on_map(Pose(turn, np.array([1.0, 0.2, 2])), np.array([0.0, 0, 5]), (10, 20), there)
    assert found.position == pytest.approx(position)
    assert found.heading == pytest.approx(heading)
