"""Calibration of a map: the similarity threshold at which answers reach a given precision."""

import datetime
import math

from crisalad_jax.config.checks import takes
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.operating_point import (
    OperatingPoint,
    caveats,
    check_supported,
)
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.calibration import Calibration, write_calibration
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.reranking import Reranking
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import lock

_MEASURED = ("min_similarity", "answered", "right", "queries", "unknown", "unknown_answered")
"""Fields that an operating point and a calibration share."""


@takes(places=Map, benchmark=Benchmark)
def calibrate(
    places: Map,
    benchmark: Benchmark,
    precision: float = 0.99,
    *,
    model: Model | None = None,
    verify: Verify | None = None,
    reading: Reading = Reading(),
) -> Calibration:
    """Measure the similarity threshold at which answers reach a precision, and store it in the map.

    The benchmark is evaluated with the map's model, image size and PCA, each image independently as
    in `query`. The map's own images are not used, so the benchmark's database should show the map's
    places, or about as many similar ones, and its queries should be like those that the map will
    get. Include queries of unknown places: they count as wrong when answered.

    Args:
        places: the open map; the result is stored in its folder and replaces an earlier one.
        benchmark: the evaluation set, for instance from `open_benchmark`.
        precision: share of the answers that must be correct, above 0 and at most 1.
        model: the model that made the map; None loads it from its recorded path (`Map.load_model`).
        verify: how answers are verified. The threshold is then a number of inliers, which is stored
            separately. None measures the similarity threshold, without verification.
        reading: how images are read.

    Returns:
        The calibration that the map now stores.

    Raises:
        InputError: no threshold reaches the precision with at least three answers (the map is then
            unchanged); `model` is not the map's; or `evaluate` raises it.

    Example:
        >>> import jax, shutil
        >>> from crisalad_jax import (
        ...     PRESETS, Model, index, init_crisalad, open_benchmark, save_weights
        ... )
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> lines = ["query,database", *(f"{number}.png,{number}.png" for number in range(4))]
        >>> _ = (folder / "set" / "ground_truth.csv").write_text("\\n".join(lines))
        >>> benchmark = open_benchmark(folder / "set", layout="folders")
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> quiet = Reading(quiet=True)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
        >>> with Map.open(folder / "map") as places:
        ...     found = calibrate(places, benchmark, precision=0.4, reading=quiet)
        >>> found.right, found.answered
        (4, 4)
    """
    rerank = verify and Reranking("local", verify.answers, matcher=verify.matcher)
    *_, result = evaluate(
        places.describer(model),
        benchmark,
        groupings=["single"],
        pca=places.components,
        dtype="bits" if places.metadata.is_bits else "float32",
        precision=precision,
        rerank=rerank,
        reading=reading,
    )
    point = result.operating_point
    assert point is not None  # requested above
    if not point.reached:
        raise InputError(f"precision: {caveats(point)[0]}, on {benchmark.name}")
    check_supported(point, benchmark.name)
    measured = {name: getattr(point, name) for name in _MEASURED}
    if verify is not None:
        measured["min_inliers"] = math.ceil(measured.pop("min_similarity"))
        measured |= {"min_similarity": -1.0, "verifier": Verifier(verify).name}
    calibration = Calibration(
        precision=precision,
        **measured,
        database=len(benchmark.database),
        benchmark=benchmark.name,
        rule=benchmark.rule,
        model=places.metadata.model,
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )
    with lock(places.folder, wait=3600):  # an addition removes temporary files there
        write_calibration(places.folder, calibration)
    if verify is None:
        places.calibration = calibration
    return calibration


def operating_point_of(calibration: Calibration) -> OperatingPoint:
    """Convert a calibration to an operating point; with a verifier, its threshold is in inliers."""
    measured = {name: getattr(calibration, name) for name in _MEASURED}
    if calibration.verifier:
        measured["min_similarity"] = calibration.min_inliers
    return OperatingPoint(asked=calibration.precision, **measured)
