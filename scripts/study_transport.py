"""Recall by Sinkhorn variant: short trainings of `tiny` on the synthetic city, several seeds.

    python scripts/study_transport.py --out OUT [--data DIR]

With --data, also on DIR/sped_train (GSV-Cities layout), tested on DIR/sped_val (@UTM layout). Runs
that OUT already holds are gone on with. Writes OUT/recall.md, OUT/recall.json and OUT/recall.png.
"""

import argparse
import dataclasses
import pathlib
import statistics
from typing import Any

import matplotlib.figure

from crisalad_jax.config import SinkhornConfig, TrainConfig, recipe
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.synthetic import SyntheticCityConfig, write_synthetic_city
from crisalad_jax.demo import DemoConfig, demo_recipe
from crisalad_jax.evaluation import evaluate
from crisalad_jax.files import atomic_path, write_json
from crisalad_jax.fit import fit, read_metrics
from crisalad_jax.progress import progress_bar

VARIANTS: dict[str, dict[str, Any]] = {
    "published, k = 3": {},
    "k = 10": {"iterations": 10},
    "converged, implicit": {"tolerance": 1e-3, "iterations": 200, "gradient": "implicit"},
    "no dustbin": {"dustbin": "none"},
    "dustbin a token": {"dustbin": "token"},
    "dustbin's mass learnt": {"dustbin": "mass"},
    "dustbin row and column": {"dustbin": "row and column"},
    "column tau 0.9, k = 20": {"column_tau": 0.9, "iterations": 20},
    "softmax": {"method": "softmax"},
    "dual softmax": {"method": "dual-softmax"},
}
KS = (1, 5)
WATCHED = ("column_error", "dustbin_share", "patches_per_cluster")


def with_transport(config: TrainConfig, fields: dict[str, Any]) -> TrainConfig:
    salad = dataclasses.replace(config.model.salad, sinkhorn=SinkhornConfig(**fields))
    return dataclasses.replace(config, model=dataclasses.replace(config.model, salad=salad))


def run(
    config: TrainConfig, places: Places, benchmark: Benchmark, folder: pathlib.Path
) -> dict[str, float]:
    """Recalls of the trained model, every image described alone, and its transport's statistics."""
    params = fit(config, places, folder, validation=benchmark, quiet=True).params
    (result,) = evaluate(params, config.model, benchmark, groupings=("single",), quiet=True)
    last = [line for line in read_metrics(folder / "metrics.jsonl") if "R@5" in line][-1]
    return {f"R@{k}": 100 * result.recalls[k] for k in KS} | {name: last[name] for name in WATCHED}


def spread(values: list[float], digits: int) -> str:
    """Mean and sample standard deviation."""
    mean = f"{statistics.mean(values):.{digits}f}"
    return f"{mean} ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else mean


def markdown(results: dict[str, dict[str, list[dict[str, float]]]]) -> str:
    """One table a benchmark, a row a variant."""
    text = ""
    for benchmark, variants in results.items():
        seeds = max(len(runs) for runs in variants.values())
        text += (
            f"{benchmark}, {seeds} seeds, mean and sample deviation:\n\n"
            "| variant | R@1 | R@5 | mass error | share in the dustbin | patches a cluster |\n"
            "| --- | ---: | ---: | ---: | ---: | ---: |\n"
        )
        for variant, runs in variants.items():
            cells = [
                spread([one[name] for one in runs], digits)
                for name, digits in (("R@1", 1), ("R@5", 1), *zip(WATCHED, (3, 2, 1), strict=True))
            ]
            text += f"| {variant} | {' | '.join(cells)} |\n"
        text += "\n"
    return text.rstrip() + "\n"


def draw(path: pathlib.Path, results: dict[str, dict[str, list[dict[str, float]]]]) -> None:
    """Every run a dot, the mean a bar."""
    figure = matplotlib.figure.Figure(figsize=(5 * len(results) + 3, 4.5), layout="constrained")
    panels = figure.subplots(1, len(results), squeeze=False, sharey=True)[0]
    for panel, (benchmark, variants) in zip(panels, results.items(), strict=True):
        for row, runs in enumerate(variants.values()):
            values = [one["R@1"] for one in runs]
            panel.plot(values, [row] * len(values), "o", color="tab:blue", alpha=0.6)
            panel.plot([statistics.mean(values)] * 2, [row - 0.3, row + 0.3], color="black")
        panel.set_yticks(range(len(variants)), list(variants))
        panel.invert_yaxis()
        panel.grid(axis="x", alpha=0.3)
        panel.set_xlabel("Recall@1, %")
        panel.set_title(benchmark)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description="Train and tabulate; see the top.")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--data", type=pathlib.Path, help="also train and test on its sped_*")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--epochs", type=int, default=12, help="in the city; 3 times that on sped")
    arguments = parser.parse_args()
    demo = DemoConfig(epochs=arguments.epochs)
    city = SyntheticCityConfig(train_places=demo.train_places, test_places=demo.test_places)
    write_synthetic_city(arguments.out / "city", city)
    root = arguments.out / "city"
    sets = {"the synthetic city": (demo_recipe(demo), root / "train", root / "test")}
    if arguments.data is not None:
        slow = dataclasses.replace(recipe("tiny"), epochs=3 * arguments.epochs)
        sets["sped_val"] = (slow, arguments.data / "sped_train", arguments.data / "sped_val")
    results: dict[str, dict[str, list[dict[str, float]]]] = {}
    total = len(sets) * len(VARIANTS) * len(arguments.seeds)
    with progress_bar("trainings", total, "runs", quiet=False) as bar:
        for number, (name, (start, train, test)) in enumerate(sets.items()):
            places, benchmark = (
                read_places(train, min_images=start.min_images),
                open_benchmark(test),
            )
            start = dataclasses.replace(start, validate_every=start.epochs)
            found = results.setdefault(name, {})
            for seed in arguments.seeds:
                for variant, (label, fields) in enumerate(VARIANTS.items()):
                    config = dataclasses.replace(with_transport(start, fields), seed=seed)
                    folder = arguments.out / "runs" / f"{number}_{variant}_{seed}"
                    found.setdefault(label, []).append(run(config, places, benchmark, folder))
                    bar.advance(1, note=f"{name}, {label}, seed {seed}")
    with atomic_path(arguments.out / "recall.md") as temporary:
        temporary.write_text(markdown(results), encoding="utf-8")
    write_json(arguments.out / "recall.json", results)
    draw(arguments.out / "recall.png", results)
    print(markdown(results))


if __name__ == "__main__":
    main()
