"""Measure recall of the packaged model, of HOG, and of the same network with random weights.

    python scripts/bench/study_starter.py --data SET... [--weights FILE] [--others NAME=FILE...]

Images are described independently. Intervals are 95 % bootstrap intervals.
"""

import pathlib
import sys
from collections.abc import Iterator, Mapping

import jax
from tables import Study, Table, flags, leave, read

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import load
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.metrics import Interval
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad

KS = (1, 5, 10)
Models = dict[str, tuple[Crisalad, ModelConfig]]


def by_model(
    params: Crisalad, config: ModelConfig, data: Benchmark
) -> tuple[Mapping[int, float], Interval]:
    """Return the recalls of a model, and the interval of the first."""
    (result,) = evaluate(
        Model(params, config), data, groupings=["single"], reading=Reading(quiet=True)
    )
    return result.recalls, result.intervals[1]


def rows(models: Models, sets: list[Benchmark]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each set and model."""
    for data in sets:
        for name, model in models.items():
            found, interval = by_model(*model, data)
            first, *others = (f"{100 * found[k]:.1f}" for k in KS)
            low, high = (f"{100 * each:.1f}" for each in (interval.low, interval.high))
            yield data.name, name, str(len(data.queries)), f"{first} ({low} to {high})", *others


def main() -> None:
    parser = flags((__doc__ or "").splitlines()[0], "docs/starter")
    parser.add_argument("--data", type=pathlib.Path, nargs="+", required=True)
    parser.add_argument("--weights", type=pathlib.Path, default=starter.FILE)
    parser.add_argument("--others", nargs="*", default=[], help="NAME=FILE of weights")
    given = read(parser, "recalls")
    own, config = load_weights(given.weights)
    untrained = init_crisalad(jax.random.key(0), config)
    models: Models = {"HOG": load("hog"), "untrained": (untrained, config)}
    for name, _, file in (each.partition("=") for each in given.others):
        models[name] = load_weights(file)
    models["**starter**"] = own, config
    sets = [open_benchmark(path) for path in given.data]
    heads = "set", "descriptor", "queries", *(f"R@{k}" for k in KS)
    found = []
    for each in rows(models, sets):
        found.append(each)
        print(*each, sep="  ", file=sys.stderr, flush=True)
    leave("recalls", Study(Table(heads, found, "Recall in percent.", 2), found), given)


if __name__ == "__main__":
    main()
