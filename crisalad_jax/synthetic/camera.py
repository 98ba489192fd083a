"""The pinhole camera: from metres in the street to outlines on the screen."""

import numpy as np
from jaxtyping import Float

from crisalad_jax.synthetic.mesh import Scene
from crisalad_jax.synthetic.view import View

NEAR = 0.4
"""Metres from the camera to the plane behind which nothing is seen."""


class Camera:
    """A pinhole camera in a place."""

    def __init__(self, heading: float, view: View, size: tuple[int, int]) -> None:
        """Place the camera by the default view's heading in degrees, and its size in pixels."""
        height, width = size
        self.tan_half_width = np.tan(np.deg2rad(view.field) / 2)
        self.focal = width / 2 / self.tan_half_width
        self.pitch = np.deg2rad(view.pitch)
        self.centre = np.array((width / 2, height / 2))
        self.yaw = np.deg2rad(heading + view.heading)
        self.position = np.array((view.lateral, view.height, view.forward))
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        turn = np.array(((cos, 0, -sin), (0, 1, 0), (sin, 0, cos)))
        sin, cos = np.sin(self.pitch), np.cos(self.pitch)
        tilt = np.array(((1, 0, 0), (0, cos, -sin), (0, sin, cos)))
        self.rotation = tilt @ turn

    def see(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert world metres to camera metres: right, up, ahead."""
        return (points - self.position) @ self.rotation.T

    def project(self, seen: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Project camera metres in front of the near plane to pixels."""
        return self.centre + self.focal * seen[:, :2] * (1, -1) / seen[:, 2:]


def project_outlines(
    scene: Scene, seen: Float[np.ndarray, "point 3"], camera: Camera
) -> list[np.ndarray | None]:
    """Project every polygon to quarters of a pixel; None if it is out of sight."""
    ends = np.cumsum(scene.polygon_sizes)
    starts = ends - scene.polygon_sizes
    x, y, depth = seen.T
    sideways, upright = camera.centre / camera.focal
    # A polygon is out of sight if all corners lie beyond one plane of the camera's pyramid.
    inside = np.stack(
        (
            depth - NEAR,
            sideways * depth - x,
            sideways * depth + x,
            upright * depth - y,
            upright * depth + y,
        ),
        -1,
    )
    usable = (np.maximum.reduceat(inside, starts) >= 0).all(1)
    whole = np.minimum.reduceat(depth, starts) >= NEAR
    corners = _fixed_point(camera.project(np.c_[seen[:, :2], depth.clip(NEAR)]))
    outlines: list[np.ndarray | None] = [None] * len(starts)
    for i in np.flatnonzero(usable).tolist():
        run = slice(starts[i], ends[i])
        if whole[i]:
            outlines[i] = corners[run]
        else:
            clipped = clip_near(seen[run])
            outlines[i] = _fixed_point(camera.project(clipped)) if len(clipped) > 2 else None
    return outlines


def clip_near(polygon: Float[np.ndarray, "corner 3"]) -> Float[np.ndarray, "kept 3"]:
    """Cut a polygon in camera metres at the near plane (Sutherland-Hodgman)."""
    corners = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            corners.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            corners.append(a + (b - a) * ((NEAR - a[2]) / (b[2] - a[2])))
    return np.array(corners).reshape(-1, 3)


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    """Round pixels to quarters, as OpenCV's `shift=2` takes them, clipped against overflow."""
    return np.clip(np.round(pixels * 4), -120000, 120000).astype(np.int32)
