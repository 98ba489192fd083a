"""Measure recall by Sinkhorn variant in short trainings of `tiny`, with several seeds.

    python scripts/bench/study_transport.py --runs RUNS [--data DIR] [--out docs/sinkhorn]

All variants train on the synthetic city. With --data, some also train on photographs in
DIR/sped_train (GSV-Cities layout), and are tested on DIR/sped_val (@UTM layout). Runs in RUNS are
resumed. It writes recall.md, recall.json and recall.png into --out. A run takes one to two minutes
on two cores.
"""

import dataclasses
import pathlib
import statistics
from typing import Any

from tables import COLOURS, INK, Study, Table, count, flags, leave, panels, read

from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.demo import DemoConfig, demo_recipe
from crisalad_jax.nn.model import Model
from crisalad_jax.sinkhorn import PartialDustbin, SinkhornConfig
from crisalad_jax.synthetic import SyntheticCityConfig, write_synthetic_city
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.progress import progress_bar

VARIANTS: dict[str, dict[str, Any]] = {
    "published, k = 3": {},
    "k = 10": {"iterations": 10},
    "converged, implicit": {"tolerance": 1e-3, "iterations": 200, "gradient": "implicit"},
    "no dustbin": {"dustbin": "none"},
    "dustbin a token": {"dustbin": "token"},
    "dustbin's mass learnt": {"dustbin": "mass"},
    "dustbin row and column": {"dustbin": "row and column"},
    "column tau 0.9, k = 20": {"column_tau": 0.9, "iterations": 20},
    "softmax": {"step": "softmax"},
    "dual softmax": {"step": "dual-softmax"},
    "partial, a quarter": {"dustbin": "partial", "step": "partial", "iterations": 10},
    "partial, share learnt": {
        "dustbin": PartialDustbin(learn=True),
        "step": "partial",
        "iterations": 10,
    },
    "capacities": {"step": "capacities", "iterations": 10},
    "quadratic": {"step": "quadratic", "iterations": 10},
    "top 4": {"step": "top-k"},
    "Gaussian start, k = 3": {"start": "gaussian"},
    "network start, k = 3": {"start": "network"},
}
ON_PHOTOGRAPHS = ("published, k = 3", "no dustbin", "dustbin a token", "softmax")
KS = (1, 5)
WATCHED = {
    "marginal_error": "mass error",
    "dustbin_share": "dustbin",
    "patches_per_cluster": "patches",
}
"""Statistics of the transport in the last step: the largest relative error of a cluster's mass, the
dustbin's share of all mass, the effective number of patches in a cluster."""
DIGITS = {"R@1": 1, "R@5": 1, "marginal_error": 3, "dustbin_share": 2, "patches_per_cluster": 1}

Runs = list[dict[str, float]]
"""The results of each seed's run."""


def with_transport(config: TrainConfig, fields: dict[str, Any]) -> TrainConfig:
    """Change SALAD's fields for the problem, and the solver's for all others."""
    problem = {name: fields[name] for name in fields if hasattr(config.model.aggregator, name)}
    solver = SinkhornConfig(**{name: fields[name] for name in fields if name not in problem})
    salad = dataclasses.replace(config.model.aggregator, sinkhorn=solver, **problem)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, aggregator=salad))


def run(
    config: TrainConfig, places: Places, benchmark: Benchmark, folder: pathlib.Path
) -> dict[str, float]:
    """Return recalls of a trained model on single images, and its transport's statistics."""
    params = fit(config, places, folder, validation=benchmark, quiet=True).params
    (result,) = evaluate(
        Model(params, config.model), benchmark, groupings=("single",), reading=Reading(quiet=True)
    )
    last = [line for line in read_metrics(folder / "metrics.jsonl") if "R@5" in line][-1]
    return {f"R@{k}": 100 * result.recalls[k] for k in KS} | {name: last[name] for name in WATCHED}


def spread(values: list[float], digits: int) -> str:
    """Format mean and sample standard deviation."""
    mean = f"{statistics.mean(values):.{digits}f}"
    return f"{mean} ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else mean


def study_of(results: dict[str, dict[str, Runs]]) -> Study:
    """Tabulate variants by benchmark, and plot each run as a dot and the mean as a bar."""
    rows, seeds = [], 0
    figure, axes = panels(len(results), tuple(results), width=5.5, height=4.2, sharey=False)
    for axis, (benchmark, variants) in zip(axes, results.items(), strict=True):
        for height, (variant, runs) in enumerate(variants.items()):
            seeds = max(seeds, len(runs))
            cells = (spread([one[name] for one in runs], DIGITS[name]) for name in DIGITS)
            rows.append((benchmark, variant, *cells))
            values = [one["R@1"] for one in runs]
            axis.plot(values, [height] * len(values), "o", color=COLOURS[0], alpha=0.6)
            axis.vlines(statistics.mean(values), height - 0.3, height + 0.3, color=INK)
        axis.set_yticks(range(len(variants)), list(variants))
        axis.invert_yaxis()
        axis.grid(axis="x", alpha=0.3)
        axis.set_xlabel("Recall@1, %", fontsize=9)
    caption = (
        f"`tiny` trained from scratch with each transport, {seeds} seeds, mean and sample standard "
        "deviation: recall of images described independently, the largest relative error of a "
        "cluster's mass, the share of all mass in the dustbin, and the effective number of patches "
        "in a cluster."
    )
    header = ("trained and tested on", "variant", "R@1", "R@5", *WATCHED.values())
    return Study(Table(header, rows, caption, 2), results, figure)


def main() -> None:
    parser = flags("Train and tabulate; see the module docstring.", "docs/sinkhorn")
    parser.add_argument("--runs", type=pathlib.Path, required=True, help="folder for the trainings")
    parser.add_argument(
        "--data",
        type=pathlib.Path,
        help="folder with sped_train and sped_val, also to train and test on",
    )
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--epochs", type=count, default=12)
    arguments = read(parser, "recall")
    demo = DemoConfig(epochs=arguments.epochs)
    city = SyntheticCityConfig(train_places=demo.train_places, test_places=demo.test_places)
    root = arguments.runs / "city"
    write_synthetic_city(root, city)
    chosen = [label for label in VARIANTS if label in arguments.variants]
    sets = {"synthetic city": (demo_recipe(demo), root / "train", root / "test", chosen)}
    if arguments.data is not None:
        start = dataclasses.replace(recipe("tiny"), epochs=arguments.epochs)
        some = [label for label in chosen if label in ON_PHOTOGRAPHS]
        sets["sped"] = (start, arguments.data / "sped_train", arguments.data / "sped_val", some)
    results: dict[str, dict[str, Runs]] = {}
    total = sum(len(labels) for *_, labels in sets.values()) * len(arguments.seeds)
    with progress_bar("trainings", total, "runs", quiet=False) as bar:
        for number, (name, (start, train, test, labels)) in enumerate(sets.items()):
            places = read_places(train, min_images=start.min_images)
            benchmark = open_benchmark(test)
            start = dataclasses.replace(start, validate_every=start.epochs)
            found = results.setdefault(name, {})
            for seed in arguments.seeds:
                for label in labels:
                    config = with_transport(start, VARIANTS[label])
                    config = dataclasses.replace(config, seed=seed)
                    variant = list(VARIANTS).index(label)
                    folder = arguments.runs / "runs" / f"{number}_{variant}_{seed}"
                    found.setdefault(label, []).append(run(config, places, benchmark, folder))
                    bar.advance(1, note=f"{name}, {label}, seed {seed}")
    leave("recall", study_of(results), arguments)


if __name__ == "__main__":
    main()
