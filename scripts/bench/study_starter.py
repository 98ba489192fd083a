"""What the model in the package recalls, beside HOG and the same network untrained.

    python scripts/bench/study_starter.py --data SET... [--weights FILE] [--others NAME=FILE...]
        [--page docs/starter.md]

Every image is described alone. An interval is the bootstrap's, of 95 %. Others are models trained
in another way. With --page the table takes its place in the page.
"""

import argparse
import pathlib
from collections.abc import Iterator, Mapping

import jax
from tables import put

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
    """Recalls of a model, and the interval of the first."""
    (result,) = evaluate(
        Model(params, config), data, groupings=["single"], reading=Reading(quiet=True)
    )
    return result.recalls, result.intervals[1]


def rows(models: Models, sets: list[Benchmark]) -> Iterator[str]:
    """The lines of the table."""
    for data in sets:
        for name, model in models.items():
            found, interval = by_model(*model, data)
            first, *others = (f"{100 * found[k]:.1f}" for k in KS)
            low, high = (f"{100 * each:.1f}" for each in (interval.low, interval.high))
            cells = (data.name, str(len(data.queries)), name, f"{first} ({low} to {high})", *others)
            yield f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=pathlib.Path, nargs="+", required=True)
    parser.add_argument("--weights", type=pathlib.Path, default=starter.FILE)
    parser.add_argument("--others", nargs="*", default=[], help="NAME=FILE of weights")
    parser.add_argument("--page", type=pathlib.Path)
    given = parser.parse_args()
    own, config = load_weights(given.weights)
    untrained = init_crisalad(jax.random.key(0), config)
    models: Models = {"HOG": load("hog"), "untrained": (untrained, config)}
    for name, _, file in (each.partition("=") for each in given.others):
        models[name] = load_weights(file)
    models["**starter**"] = own, config
    sets = [open_benchmark(path) for path in given.data]
    heads = ["set", "queries", "descriptor", *(f"R@{k}" for k in KS)]
    lines = [f"| {' | '.join(heads)} |", "| --- | ---: | --- | ---: | ---: | ---: |"]
    for line in rows(models, sets):
        lines.append(line)
        print(line, flush=True)
    if given.page is not None:
        put(given.page, "recalls", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
