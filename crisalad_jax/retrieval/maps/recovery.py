"""A map's descriptors without a record, left by a killed addition or by the loss of a record."""

import pathlib

from crisalad_jax.retrieval.maps.approximate import indexed_images
from crisalad_jax.retrieval.maps.calibration import CALIBRATION, VERIFIED
from crisalad_jax.retrieval.maps.metadata import SEGMENTS
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn


def remove_unrecorded(folder: pathlib.Path, images: int) -> None:
    """Remove the files of descriptors that have no record, with a warning.

    A kill leaves at most one addition without a record. A map gets its calibration, and its
    approximate search, only once it has images: if they exist without images, a record was lost.

    Args:
        folder: the map's folder, whose lock is held.
        images: number of images in its records, including removed ones.

    Raises:
        InputError: more is left than a kill leaves, so a record was lost.
    """
    files = sorted((folder / SEGMENTS).glob("[0-9]*.npy"))
    recorded = {path.name.partition(".")[0] for path in (folder / SEGMENTS).glob("[0-9]*.json")}
    unrecorded = [path for path in files if path.stem not in recorded]
    lost = [path for path, count in indexed_images(folder) if count > images]
    if not images:
        lost += [path for name in (CALIBRATION, VERIFIED) if (path := folder / name).exists()]
    if len(unrecorded) > 1:
        lost += unrecorded
    if lost:
        raise InputError(
            f"{lost[0]}: found it in a map with records of only {images} images, expected the "
            "records of all its images: restore them, or make a new map"
        )
    for path in unrecorded:
        path.unlink()
        warn(f"{path}: removed descriptors without a record, left by a kill or a lost record")
