"""`crisalad calibrate`."""

import pathlib
from typing import Any

from crisalad_jax.cli.common import echo, find_given, open_set, refuse_without, show_tables
from crisalad_jax.cli.flags import MapFlags, ReadFlags, SetFlags, TableFlags
from crisalad_jax.config.io import to_plain
from crisalad_jax.evaluation.calibrate import calibrate, operating_point_of
from crisalad_jax.evaluation.operating_point import caveats
from crisalad_jax.experiments.result_tables import points_table
from crisalad_jax.retrieval.maps.calibration import CALIBRATION, VERIFIED
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.verification.verify import Verify


class Calibrate(ReadFlags, SetFlags, MapFlags, TableFlags):
    """Measure the similarity above which a map's answers are correct, and store it in the map.

    Every image is described independently by the map's model, at the map's image size. The database
    of the set should show the map's places, or about as many similar ones, and its queries should
    be like those that the map will get, including unknown places. `crisalad query` then answers
    "unknown" to images below that similarity. An earlier calibration is replaced.
    """

    precision: float = 0.99
    """Share of the answers that must be correct."""
    verify: int | None = None
    """Number of answers to verify, to measure how many inliers (not what similarity) the best one
    needs (docs/verification.md); stored separately, for `crisalad query --verify`."""
    matcher: pathlib.Path | None = None
    """With --verify: ONNX file of the matcher; by default SIFT."""


def run(arguments: Calibrate) -> dict[str, Any]:
    """Calibrate the map, and print the calibration; return it as JSON values for --json."""
    refuse_without("--verify", arguments.verify, matcher=arguments.matcher)
    verify = None
    if arguments.verify is not None:
        verify = Verify(answers=arguments.verify, matcher=arguments.matcher)
    with Map.open(arguments.map, verify=arguments.checksums, calibrated=False) as places:
        places.load_model(find_given(arguments.weights, quiet=arguments.quiet))
        benchmark = open_set(arguments)
        calibration = calibrate(
            places, benchmark, arguments.precision, verify=verify, reading=arguments.reading
        )
    point = operating_point_of(calibration)
    name = "single" if verify is None else f"single + local:{verify.answers}"
    asked = "similarity" if verify is None else "inliers"
    show_tables(points_table({name: point}, asked), latex=arguments.latex)
    for words in caveats(point):
        echo(words)
    if verify is None:
        least = (
            f"{arguments.map / CALIBRATION}: answers below similarity {point.min_similarity:.9g}"
        )
    else:
        file = arguments.map / VERIFIED
        least = f"{file}: verified answers with fewer than {calibration.min_inliers} inliers"
    echo(f"{least} are unknown from now on")
    return to_plain(calibration)
