"""Measure what a model gains at a place by `crisalad adapt`, and what it loses elsewhere.

    python scripts/bench/study_adapt.py --data SET... [--watch SET...] [--weights FILE]
        [--seeds 3] [--frames 3] [--trainable head] [--learning-rate 1e-3] [--epochs 10]

The database of each set becomes a map, to which the model is adapted once for each seed. Its
queries, unseen in training, are evaluated before and after, and so are those of the other sets; and
both again with weights halfway between the two models. Intervals are 95 % paired bootstrap
intervals over queries and seeds. `--frames` is for sets without positions.
"""

import argparse
import dataclasses
import itertools
import pathlib
import tempfile

import jax
import numpy as np

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.positions import AXES, Positions
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.difference import paired_difference
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.adapt import adapt
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.training.recipes import recipe

QUIET = Reading(quiet=True)


def firsts(model: Model, data: Benchmark) -> np.ndarray:
    """Return whether each query's first answer is correct."""
    (result,) = evaluate(model, data, groupings=["single"], reading=QUIET)
    assert result.firsts is not None
    return result.firsts[0]


def adapted(model: Model, data: Benchmark, seed: int, given: argparse.Namespace) -> Model | None:
    """Adapt a model to the database of a set; return None if held-out frames gain nothing."""
    config = recipe("b14", "adapt", model=model.config)
    rate = given.learning_rate or config.optimiser.learning_rate
    config = dataclasses.replace(
        config,
        trainable=given.trainable or config.trainable,
        optimiser=dataclasses.replace(config.optimiser, learning_rate=rate),
        epochs=given.epochs,
        seed=seed,
    )
    with tempfile.TemporaryDirectory() as folder:
        out = pathlib.Path(folder)
        images = [str(path.resolve()) for path in data.database]
        (out / "images.txt").write_text("\n".join(images))
        at = data.database_positions
        frames = given.frames if at is None else None
        # Names of a list are relative to its folder, or to the root of the file system.
        positions = None
        if at is not None:
            names = [name.removeprefix("/") for name in images]
            positions = Positions(AXES[0], dict(zip(names, map(tuple, at.tolist()), strict=True)))
        how = {"weights": given.weights, "positions": positions, "reading": QUIET}
        index(model, out / "images.txt", out / "map", **how)
        found = adapt(config, out / "map", out / "run", place_frames=frames, reading=QUIET)
        before, after = (f"{100 * each:.1f}" for each in found.held_out)
        print(
            f"{data.name}, seed {seed}: {found.steps} steps, held out {before} -> {after}",
            flush=True,
        )
        return None if found.weights is None else load(found.weights)


def halfway(start: Model, end: Model) -> Model:
    """Average the weights of two models, as WiSE-FT does (Wortsman et al., CVPR 2022)."""
    return end._replace(params=jax.tree.map(lambda a, b: (a + b) / 2, start.params, end.params))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=pathlib.Path, nargs="+", required=True)
    parser.add_argument(
        "--watch", type=pathlib.Path, nargs="*", default=[], help="sets to evaluate only"
    )
    parser.add_argument("--weights", type=pathlib.Path, default=starter.FILE)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--trainable")
    parser.add_argument("--learning-rate", type=float)
    parser.add_argument("--epochs", type=int, default=10)
    given = parser.parse_args()
    model, sets = load(given.weights), [open_benchmark(each) for each in given.data]
    watched = [open_benchmark(each) for each in given.watch]
    before = {data.name: firsts(model, data) for data in (*sets, *watched)}
    print("| adapted to | evaluated on | weights | R@1 before | change of R@1 |")
    print("| --- | --- | --- | ---: | ---: |", flush=True)
    for data in sets:
        models = [adapted(model, data, seed, given) or model for seed in range(given.seeds)]
        rows = {"adapted": models, "halfway": [halfway(model, each) for each in models]}
        others = [each for each in (*sets, *watched) if each is not data]
        for on, (weights, found) in itertools.product((data, *others), rows.items()):
            hits = np.stack([firsts(each, on) for each in found])
            start = np.stack([before[on.name]] * len(found))
            change = paired_difference(hits, start)
            low, high = (f"{100 * each:+.1f}" for each in change.interval)
            was, now = f"{100 * start.mean():.1f}", f"{100 * change.mean:+.1f} ({low} to {high})"
            print(f"| {' | '.join((data.name, on.name, weights, was, now))} |", flush=True)


if __name__ == "__main__":
    main()
