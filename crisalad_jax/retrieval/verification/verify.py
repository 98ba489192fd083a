"""Verify the answers to a query by local features, and locate its camera."""

import dataclasses
import functools
import itertools
import os
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.config.checks import check_count, require
from crisalad_jax.config.short_repr import with_field_docs
from crisalad_jax.data.frames import file_of
from crisalad_jax.data.images import read_image
from crisalad_jax.data.prepare import as_rgb
from crisalad_jax.retrieval.verification.camera import Intrinsics
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
from crisalad_jax.retrieval.verification.matchers import SIDE, open_matcher
from crisalad_jax.retrieval.verification.results import MapPose, Verification
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_bytes
from crisalad_jax.utils.shapes import Float, Float64, Int, Int64

_Points = Float64[np.ndarray, "n 2"]
_DISTANCE = 3.0
"""Maximum distance of an inlier from its epipolar line, in pixels; for images larger than `SIDE`,
in pixels of the reduced image."""
_POSE_DISTANCE = 1.5
"""The same for poses, which need more precise points."""
_INLIER, _MOST_INLIERS = 0.002, 50
"""Similarity that an inlier counts as, and the maximum number that count."""
_CACHED = 256
"""Number of images of the map whose features are cached, about 0.5 MB each."""
_BASELINE = 0.3
"""Minimum distance in metres between two answers that locate a camera."""


@with_field_docs
@dataclasses.dataclass(frozen=True)
class Verify:
    """How to verify answers by local features.

    Example:
        >>> Verify(answers=20).answers
        20
    """

    answers: int = 10
    """Number of best answers per query to verify and reorder (see `order_by_inliers`)."""
    matcher: str | os.PathLike[str] | None = None
    """ONNX file of a matcher (see `OnnxMatcher`); None is SIFT."""
    intrinsics: Intrinsics | None = None
    """Intrinsics of the queries' camera, for rotations and directions; None gives only inliers."""
    map_intrinsics: Intrinsics | None = None
    """Intrinsics of the camera of the map's images; None is `intrinsics`."""
    map_images: str | os.PathLike[str] | None = None
    """Folder of the map's images; None is the one from which they were indexed."""
    map_depth: str | os.PathLike[str] | None = None
    """Folder of depth images: 16-bit PNGs in millimetres, named after the map's images, 0 where
    unknown. Answers with depth have a translation in metres."""
    min_inliers: int | None = None
    """Minimum number of inliers of the best answer; with fewer, the place counts as unknown. None
    takes the number from the map's calibration, if any."""

    def __post_init__(self) -> None:
        """Check the numbers, and that the folders exist."""
        check_count("verify", self.answers)
        require(
            self.intrinsics is not None or (self.map_intrinsics, self.map_depth) == (None, None),
            "intrinsics: found none with map_intrinsics or map_depth, expected the query camera's",
        )
        for name in ("map_images", "map_depth"):
            folder = getattr(self, name)
            if folder is not None and not pathlib.Path(folder).is_dir():
                raise InputError(f"{name}: found no folder {folder}, expected one")
        least = self.min_inliers
        require(least is None or least >= 0, f"min_inliers: found {least}, expected at least 0")


class _View(NamedTuple):
    """An image that was prepared for matching."""

    prepared: Any
    size: tuple[int, int]
    name: str

    @property
    def factor(self) -> float:
        """Scale from the image to the size at which distances are in pixels; at most 1."""
        return min(1.0, SIDE / max(self.size))


class Verifier:
    """Matches queries with images of a map, whose features it caches."""

    def __init__(self, verify: Verify) -> None:
        """Open the matcher.

        Raises:
            InputError: the matcher's file does not exist, or is a program of another kind.
        """
        self.verify = verify
        self._matcher = open_matcher(verify.matcher)
        self._camera: Any = verify.intrinsics  # both sides have one, or neither
        self._map_camera: Any = verify.map_intrinsics or verify.intrinsics
        self._read = functools.lru_cache(_CACHED)(
            lambda file, _: self._view(read_image(file, bit_depth="contrast-stretch"), str(file))
        )

    @property
    def name(self) -> str:
        """Name of the matcher; inliers of different matchers are not comparable."""
        return self._matcher.name

    def check(self, image: np.ndarray, names: Sequence[tuple[str, str]]) -> list[Verification]:
        """Verify the answers to a query.

        Args:
            image: pixels of the query: 8-bit RGB, or another type that `as_rgb` converts.
            names: (folder, name) of each answer's image.

        Returns:
            The verification of each answer; without matches if its image cannot be read.

        Raises:
            InputError: no answer's image can be read, the intrinsics are for another image size, or
                a depth image has another format.
        """
        query = self._view(as_rgb(image, "contrast-stretch"), "the query")
        checks, lost = [], []
        for root, name in names:
            try:
                view = self._seen(root, name)
            except InputError as error:
                lost.append(error)
                checks.append(Verification(0, 0, 0.0, np.zeros((0, 2)), np.zeros((0, 2))))
                continue
            checks.append(self._check(query, view, name))
        if len(lost) == len(names):
            raise InputError(
                f"{lost[0]}: none of the answers can be verified; --map-images (map_images=) says "
                "where else they are"
            )
        return checks

    def locate(
        self,
        checks: Sequence[Verification],
        names: Sequence[tuple[str, str]],
        positions: Sequence[Any],
        size: tuple[int, int],
    ) -> tuple[MapPose, int, Float64[np.ndarray, " 3"]] | None:
        """Compute where the query's camera was, from the first two answers that allow it, or None.

        With depth, these are two answers with a translation. Otherwise, matches between two answers
        at a known distance give the depth of points, and PnP gives the pose of the query's camera.

        Args:
            checks: verifications of the answers, from `check`.
            names: (folder, name) of each answer's image.
            positions: position of each answer, in metres east and north; None if unknown.
            size: height and width of the query in pixels.

        Returns:
            The pose in metres east and north, the index of the answer that it was computed from,
            and the vector from that answer's camera, as in `Verification.translation`.
        """
        pairs = enumerate(zip(checks, positions, strict=True))
        known = [n for n, (check, at) in pairs if check.rotation is not None and at is not None]
        for first, second in itertools.combinations(known, 2):
            here, there = positions[first], positions[second]
            metres = float(np.hypot(*(there - here)))
            if metres < _BASELINE:
                continue
            found = _by_depth(checks[first], checks[second]) or self._by_motion(
                checks[first], names[first], names[second], metres, size
            )
            if found is not None:
                pose, other = found
                placed = pose_on_map(pose, other, here.tolist(), there.tolist())
                return placed, first, pose.translation
        return None

    def _by_motion(
        self,
        check: Verification,
        first: tuple[str, str],
        second: tuple[str, str],
        metres: float,
        size: tuple[int, int],
    ) -> tuple[Pose, np.ndarray] | None:
        """Compute the query's pose in the first answer's axes, and the vector to the second."""
        here, there = self._seen(*first), self._seen(*second)
        *_, theirs, ours = self._inliers(there, here)
        rays = self._rays(self._map_camera, there, theirs)
        map_rays = self._rays(self._map_camera, here, ours)
        pose = relative_pose(rays, map_rays, self._distance(here))
        if pose is None:
            return None
        pose = pose._replace(translation=pose.translation * metres)
        rows, seen = common_points(ours, check.database_points)
        points = triangulated(rays[rows], map_rays[rows], pose)
        near = np.isfinite(points).all(axis=1)
        view = _View(None, size, "the query")
        directions = self._rays(self._camera, view, check.query_points[seen[near]])
        found = pose_from_points(points[near], directions, self._distance(here))
        return None if found is None else (found.inverse, pose.translation)

    def _seen(self, root: str, name: str) -> _View:
        """Prepare an image of the map; the result is cached until its file changes."""
        folders = [*([self.verify.map_images] if self.verify.map_images else ()), root]
        files = [pathlib.Path(folder, name) for folder in folders]
        file = next((each for each in files if file_of(each).is_file()), files[0])
        return self._read(file, file_of(file).exists() and file_of(file).stat().st_mtime_ns)

    def _view(self, image: np.ndarray, name: str) -> _View:
        return _View(self._matcher.prepare(image), image.shape[:2], name)

    def _check(self, query: _View, database: _View, name: str) -> Verification:
        checked = Verification(*self._inliers(query, database))
        if self._camera is None:
            return checked
        rays = self._rays(self._camera, query, checked.query_points)
        map_rays = self._rays(self._map_camera, database, checked.database_points)
        if checked.confidence < 1:
            return checked
        turned = rotation_only(rays, map_rays, self._distance(database))
        pose = relative_pose(rays, map_rays, self._distance(database))
        if turned is not None:
            checked = checked._replace(rotation=turned)
        elif pose is not None:
            checked = checked._replace(rotation=pose.rotation, direction=pose.translation)
        depths = self._depths(database, name, checked.database_points)
        known = depths > 0
        points = depths[:, None] * np.column_stack([map_rays, np.ones(len(depths))])
        found = pose_from_points(points[known], rays[known], self._distance(database))
        if found is None:
            return checked
        rotation, translation = found.inverse
        direction = translation / max(float(np.linalg.norm(translation)), 1e-9)
        return checked._replace(rotation=rotation, direction=direction, translation=translation)

    def _inliers(self, first: _View, second: _View) -> tuple[int, int, float, _Points, _Points]:
        """Match two images, and return the fields of a `Verification` that need no camera."""
        ours, theirs = self._matcher.match(first.prepared, second.prepared)
        mask = epipolar_inliers(ours * first.factor, theirs * second.factor, _DISTANCE)
        inliers, matches = int(mask.sum()), len(mask)
        return inliers, matches, min(1.0, inliers / (8 + 0.3 * matches)), ours[mask], theirs[mask]

    def _rays(self, camera: Intrinsics, view: _View, points: _Points) -> _Points:
        return camera.directions(points, view.size, view.name)

    def _distance(self, view: _View) -> float:
        """Return the maximum distance of an inlier in directions of the map's camera."""
        return _POSE_DISTANCE / (self._map_camera.focal(view.size[1]) * view.factor)

    def _depths(self, view: _View, name: str, points: _Points) -> Float64[np.ndarray, " n"]:
        """Return the depth in metres at pixels of an answer, 0 where it is unknown."""
        folder = self.verify.map_depth
        file = pathlib.Path(folder or "", name).with_suffix(".png")
        if folder is None or not file.is_file():
            return np.zeros(len(points))
        data = np.frombuffer(read_bytes(file, "depth"), np.uint8)
        depth = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        height, width = view.size
        shape, dtype = ((), None) if depth is None else (depth.shape, depth.dtype)
        factor = shape[1] / width if len(shape) == 2 else 0.0
        if depth is None or dtype != np.uint16 or abs(len(depth) - factor * height) >= 1:
            raise InputError(
                f"{file}: found {dtype} of shape {shape}, expected millimetres in 16 bits, grey, "
                f"of the aspect ratio of {view.name}, {width} x {height}"
            )
        columns, rows = np.rint((points + 0.5) * factor - 0.5).astype(int).T
        return depth[rows.clip(0, len(depth) - 1), columns.clip(0, depth.shape[1] - 1)] / 1000


def _by_depth(first: Verification, second: Verification) -> tuple[Pose, np.ndarray] | None:
    """Return the query's pose in the first answer's axes, and the vector to the second answer."""
    if first.translation is None or second.translation is None:
        return None
    assert first.rotation is not None
    assert second.rotation is not None
    pose, other = Pose(first.rotation, first.translation), Pose(second.rotation, second.translation)
    return pose, pose.rotation @ other.inverse.translation + pose.translation


def order_by_inliers(
    similarities: Float[np.ndarray, " n"], inliers: Int[np.ndarray, " n"] | Sequence[int]
) -> Int64[np.ndarray, " n"]:
    """Return the order of verified answers, as indices, best first.

    Each inlier adds 0.002 to the similarity, for at most 50 inliers: 0.1. Ranking only by inliers
    is worse than ranking only by similarity where few local features match, as between seasons
    (docs/verification.md has the figures).
    """
    scores = similarities + _INLIER * np.minimum(inliers, _MOST_INLIERS)
    return np.argsort(-scores, kind="stable")
