"""`crisalad calibrate`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.cli.common import find_given, give_json, open_set, prepare_json, say, show
from crisalad_jax.cli.tables import points_table
from crisalad_jax.config.io import to_plain
from crisalad_jax.evaluation.calibrate import calibrate, operating_point_of
from crisalad_jax.evaluation.operating_point import caveats, check_precision
from crisalad_jax.retrieval.maps.calibration import CALIBRATION
from crisalad_jax.retrieval.maps.map import Map

EXAMPLE = "crisalad calibrate --map corridor.map --data corridor-set --precision 0.99"


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Measure from which similarity on a map's answers are right, and let the map remember it.

    Every image is described alone, at the map's size, by the map's model. `crisalad query` then
    answers "unknown" to images below that similarity.
    """

    map: pathlib.Path
    """Folder that `crisalad index` wrote; an earlier calibration in it is replaced."""
    data: pathlib.Path
    """Evaluation set in any layout of docs/datasets.md: its database should be the map's places, or
    about as many like them, and its queries what the map will be asked, unknown places among
    them."""
    precision: float = 0.99
    """Share of the answers that must be right."""
    weights: pathlib.Path | None = None
    """The model that made the map, as a file or a published name; by default where it was then."""
    split: str | None = None
    """train, val or test, where the set has several."""
    layout: str | None = None
    """Layout of the set, by its name in `crisalad evaluate --help`; by default what DATA looks
    like."""
    images: pathlib.Path | None = None
    """Folder of the images that a .mat file or .npy lists name; by default beside them."""
    queries: str | None = None
    """Folder of the queries, where @UTM sets have several; by default queries."""
    ignore_zones: bool = False
    """Compare @UTM numbers of all zones as if of one plane, as the public tools do."""
    radius: float | None = None
    """Largest distance of a positive in metres; by default 25, or what a .mat file says."""
    max_heading_difference: float | None = None
    """Largest difference of compass angles of a positive in degrees, for raw MSLS; by default
    any."""
    frames: int | None = None
    """How many frames a positive may be away, for two plain folders of the same moments."""
    batch_size: int = 16
    """Images described at once, each as if it were alone."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    json: pathlib.Path | None = None
    """File for the result as JSON; - prints it."""
    verify: bool = True
    """Check the map's descriptors against their checksums; --no-verify skips that, where files are
    huge."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Calibrate) -> None:
    """Calibrate the map, and print what it remembers."""
    prepare_json(arguments.json)
    check_precision(arguments.precision)
    with Map.open(arguments.map, verify=arguments.verify, calibrated=False) as places:
        params = places.load_params(find_given(arguments.weights, quiet=arguments.quiet))
        benchmark = open_set(arguments)
        calibration = calibrate(
            places,
            params,
            benchmark,
            arguments.precision,
            batch_size=arguments.batch_size,
            on_bad_image=arguments.on_bad_image,
            quiet=arguments.quiet,
        )
    point = operating_point_of(calibration)
    show(points_table({"single": point}))
    for words in caveats(point):
        say(words)
    say(
        f"{arguments.map / CALIBRATION}: answers below similarity {point.min_similarity:.9g} are "
        "unknown from now on"
    )
    give_json(arguments.json, to_plain(calibration))
