"""Train `tiny` from scratch on small real photographs, and tabulate the effect of two parts.

    python scripts/bench/study_photographs.py --data DIR --out OUT

DIR holds `sped_train` (GSV-Cities layout), `sped_val` (@UTM layout) and `corridor` (VPR-Bench
layout). The parts are the encoder and the adapter. Runs in OUT are resumed. The tables are written
to OUT/photographs.md.
"""

import argparse
import dataclasses
import json
import pathlib
import time
from collections.abc import Mapping

import jax

from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.report import RecallRow, recall_table
from crisalad_jax.experiments.tables import Cell, Table, write_text
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.files import write_json

TESTS = ("sped_val", "corridor")


def variants() -> dict[str, TrainConfig]:
    """Return the whole model, and two with one field changed."""
    whole = recipe("tiny")
    model = whole.model
    no_encoder = dataclasses.replace(model, cross_image="none")
    backbone = dataclasses.replace(model.backbone, adapter="none")
    no_adapter = dataclasses.replace(model, backbone=backbone)
    return {
        "whole": whole,
        "cross_image none": dataclasses.replace(whole, model=no_encoder),
        "adapter none": dataclasses.replace(whole, model=no_adapter),
    }


def train(
    name: str, config: TrainConfig, data: pathlib.Path, out: pathlib.Path
) -> tuple[Crisalad, float]:
    """Train a model, and return it with its training time; a finished run is only read."""
    folder = out / f"{name.replace(' ', '_')}_seed{config.seed}"
    timing = out / f"{folder.name}.json"
    started = time.monotonic()
    places = read_places(data / "sped_train", min_images=config.min_images)
    params = fit(config, places, folder).params
    if not timing.exists():
        write_json(timing, {"seconds": round(time.monotonic() - started, 1)})
    return params, json.loads(timing.read_text())["seconds"]


def hog_recalls(benchmark: Benchmark) -> Mapping[int, float]:
    return evaluate(load("hog"), benchmark, reading=Reading(quiet=True))[0].recalls


def main() -> None:
    parser = argparse.ArgumentParser(description="Train and tabulate; see the module docstring.")
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1], help="seeds of the whole model"
    )
    parser.add_argument(
        "--ablation-seeds",
        type=int,
        nargs="*",
        default=[0],
        help="seeds of models with one field changed",
    )
    arguments = parser.parse_args()
    benchmarks = [open_benchmark(arguments.data / name) for name in TESTS]
    rows = [RecallRow(b.name, "HOG, no learning", "any", hog_recalls(b)) for b in benchmarks]

    def measure(model_name: str, params: Crisalad, config: TrainConfig) -> None:
        for benchmark in benchmarks:
            results = evaluate(
                Model(params, config.model),
                benchmark,
                groupings=("single", "shuffled", "sequential"),
                seed=config.seed,
                seeds=1,
                reading=Reading(quiet=True),
            )
            for result in results:
                rows.append(RecallRow(benchmark.name, model_name, result.grouping, result.recalls))

    timings = []
    for name, start in variants().items():
        for seed in arguments.seeds if name == "whole" else arguments.ablation_seeds:
            config = dataclasses.replace(start, seed=seed)
            if name == "whole":
                untrained = init_crisalad(jax.random.key(seed), config.model)
                measure(f"untrained, seed {seed}", untrained, config)
            params, seconds = train(name, config, arguments.data, arguments.out)
            timings.append([Cell(name), Cell(str(seed)), Cell(f"{seconds / 60:.1f}")])
            measure(f"{name}, seed {seed}", params, config)
    order = {benchmark.name: i for i, benchmark in enumerate(benchmarks)}
    rows.sort(key=lambda row: order[row.benchmark])
    times = Table(["model", "seed", "training, minutes"], timings).markdown()
    text = f"{recall_table(rows).markdown()}\n{times}"
    write_text(arguments.out / "photographs.md", text)
    print(recall_table(rows).markdown())


if __name__ == "__main__":
    main()
