"""Descriptors of a map that no record counts: what a kill left of an addition, or a lost record."""

import pathlib

import numpy as np

from crisalad_jax.retrieval.maps.approximate import indexed_images
from crisalad_jax.retrieval.maps.calibration import CALIBRATION
from crisalad_jax.retrieval.maps.metadata import SEGMENTS, has_images
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_HINT = "put it back, or make a new map in another folder"


def check_no_record_lost(folder: pathlib.Path) -> None:
    """Check that a map did not lose the record of images before it is written to.

    A kill leaves at most one addition without a record. A map gets its calibration, and its
    approximate search, only once it has images.

    Raises:
        InputError: a record was lost.
    """
    if not has_images(folder):
        calibration = folder / CALIBRATION
        told = [calibration] if calibration.exists() else []
        told += [path for path, _ in indexed_images(folder)]
        if told:
            raise InputError(
                f"{told[0]}: found it in a map without a record of images, expected the record "
                f"that was there when it was made: {_HINT}"
            )
    if len(found := _unrecorded(folder)) > 1:
        raise InputError(
            f"{found[0]}: found {len(found)} such files of descriptors without a record, expected "
            f"at most the one that a kill leaves: records were lost: {_HINT}"
        )


def remove_unrecorded(folder: pathlib.Path, images: int) -> None:
    """Remove the descriptors in files that no record counts, and tell of it.

    Args:
        folder: the map's, whose lock is held.
        images: number of images that its records count.

    Raises:
        InputError: an approximate search is of more images, so that a record was lost.
    """
    for path, count in indexed_images(folder):
        if count > images:
            raise InputError(
                f"{path}: found a search of {count} images in a map of {images}, expected at most "
                f"those: the record of the others was lost: {_HINT}"
            )
    for path in _unrecorded(folder):
        which = _numbers(path)
        path.unlink()
        warn(
            f"{path}: {which} without a record are removed; a kill leaves such, but so does the "
            "loss of a record"
        )


def _unrecorded(folder: pathlib.Path) -> list[pathlib.Path]:
    files = sorted((folder / SEGMENTS).glob("[0-9]*.npy"))
    return [path for path in files if not path.with_suffix(".json").exists()]


def _numbers(path: pathlib.Path) -> str:
    try:
        count = len(np.load(path, mmap_mode="r", allow_pickle=False))
    except (OSError, ValueError, TypeError, EOFError):
        return "damaged descriptors"
    first = int(path.stem)
    return f"descriptors {first} to {first + count - 1}"
