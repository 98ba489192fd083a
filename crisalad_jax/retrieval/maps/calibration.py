"""A map's calibration: the minimum similarity, or number of inliers, for an answer to count."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.config.checks import require
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.retrieval.segments import write_record
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json

CALIBRATION = "calibration.json"
"""Name of the file of a calibration by similarity, in the map's folder."""
VERIFIED = "calibration-verified.json"
"""Name of the file for verified answers, which count by their number of inliers."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The contents of a calibration file: an operating point, and what it was measured on."""

    min_similarity: float
    """A query is of an unknown place if no image of the map has at least this cosine similarity."""
    precision: float
    """Requested precision, as a fraction: the share of answers that should be correct."""
    answered: int
    """Number of queries that were answered, `right` of them correctly."""
    right: int
    queries: int
    """Total number of queries in the set."""
    unknown: int
    """Number of queries without a positive, `unknown_answered` of which were answered."""
    unknown_answered: int
    database: int
    """Number of images that the queries were compared with."""
    benchmark: str
    """Name of the evaluation set."""
    rule: str
    """What counted as a correct answer, in words."""
    model: str
    """The `model_hash` of the model that made the map and the compared descriptors."""
    created: str = ""
    min_inliers: int = 0
    """For verified answers: a query whose best answer has fewer inliers is of an unknown place;
    similarity is then not limited."""
    verifier: str = ""
    """The matcher that found the inliers; empty if answers were not verified."""
    format: Literal[1] = 1
    """Version of the file."""

    def __post_init__(self) -> None:
        """Check the similarity."""
        check_min_similarity(self.min_similarity)


def read_calibration(
    folder: pathlib.Path, model: str, name: str = CALIBRATION
) -> Calibration | None:
    """Read the calibration of the map in `folder`; None if it was never calibrated.

    Args:
        folder: the map's folder.
        model: the map's `model_hash`.
        name: name of the file, `CALIBRATION` or `VERIFIED`.

    Raises:
        InputError: the file is damaged, of another format, or for another model than the map's.
    """
    path = folder / name
    if not path.exists():
        return None
    try:
        value = read_json(path, "a map's calibration", sealed=False)
        calibration = from_plain(Calibration, value, source=str(path))
        if calibration.model != model:
            raise InputError(
                f"{path}: found a calibration of model {calibration.model[:12]}, expected "
                f"{model[:12]}, which made the map; `crisalad calibrate` replaces it"
            )
    except InputError as error:
        raise InputError(
            f"{error}; the file may be removed: the map then answers every query, as with "
            "--min-similarity -1"
        ) from error
    return calibration


def write_calibration(folder: pathlib.Path, calibration: Calibration) -> None:
    """Replace the stored calibration of the map in `folder`.

    Raises:
        InputError: the folder cannot be written to.
    """
    name = VERIFIED if calibration.verifier else CALIBRATION
    write_record(folder / name, to_plain(calibration), indent=2)


def check_min_similarity(value: float, name: str = "min_similarity") -> None:
    """Raise InputError unless a cosine similarity is from -1 to 1; the message calls it `name`."""
    require(-1 <= value <= 1, f"{name}: found similarity {value}, expected one from -1 to 1")
