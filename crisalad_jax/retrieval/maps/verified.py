"""Verify a map's answers to a query by local features: reorder them, and locate the camera."""

from collections.abc import Sequence

import numpy as np

from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import AXES
from crisalad_jax.retrieval.maps.calibration import VERIFIED, Calibration, read_calibration
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.verification.results import MapPose, Verification
from crisalad_jax.retrieval.verification.verify import Verifier, order_by_inliers
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float32, Float64, Int64


def verify_answers(
    verifier: Verifier,
    image: np.ndarray,
    found: Sequence[MapImage],
    similarities: Float32[np.ndarray, " n"],
    axes: tuple[str, str] | None,
) -> tuple[Int64[np.ndarray, " n"], list[Verification], MapPose | None]:
    """Verify the answers to a query, reorder them, and locate the query's camera.

    Args:
        verifier: the verifier, which matches local features.
        image: pixels of the query, of any type that `Verifier.check` takes.
        found: the answers, best first.
        similarities: similarities of the answers to the query.
        axes: axes of the answers' positions (`positions.AXES`); None if there are none.

    Returns:
        Indices into `found` in the order of `order_by_inliers`; the verifications in that order;
        and the pose of the query's camera on the map, or None if no two answers determine it.

    Raises:
        InputError: no answer's image can be read, or intrinsics or depth images are unsuitable.
    """
    names = [(each.root, each.name) for each in found]
    checks = verifier.check(image, names)
    inliers = [check.inliers for check in checks]
    order = order_by_inliers(similarities, inliers)
    checks, names, found = ([each[i] for i in order] for each in (checks, names, found))
    known = [each.position for each in found if each.position is not None]
    zone = None
    if axes == AXES[1] and known:
        latitude, longitude = known[0]
        zone = Zone(int((longitude + 180) // 6) % 60 + 1, latitude < 0)
    positions = [each.position and _metres(each.position, zone) for each in found]
    located = verifier.locate(checks, names, positions, image.shape[:2])
    if located is None:
        return order, checks, None
    pose, number, translation = located
    checks[number] = checks[number]._replace(translation=translation)
    if zone is not None:
        latitude, longitude = np.concatenate(zone.to_degrees(*np.array([pose.position]).T))
        pose = pose._replace(position=(float(latitude), float(longitude)))
    return order, checks, pose


def _metres(position: tuple[float, float], zone: Zone | None) -> Float64[np.ndarray, " 2"]:
    """Convert a position to metres; with a zone of None it is in metres already."""
    given = np.array([position])
    return given[0] if zone is None else np.concatenate(zone.to_metres(*given.T))


def calibration_of(places: Map, verifier: Verifier | None) -> Calibration | None:
    """Return a map's calibration for verified answers or, without one, that for similarities.

    A calibration made with another matcher than the verifier's is ignored, with a warning.

    Raises:
        InputError: the calibration file is damaged, or belongs to another model than the map's.
    """
    found = verifier and read_calibration(places.folder, places.metadata.model, VERIFIED)
    if verifier and found and found.verifier != verifier.name:
        warn(
            f"{places.folder / VERIFIED}: found inliers of {found.verifier}, and answers verified "
            f"by {verifier.name}: it is not used; `crisalad calibrate --verify` measures it again"
        )
        found = None
    return found or places.calibration
