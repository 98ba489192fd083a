"""Measure how much of a cross-image model's recall comes from the order of the files.

    python scripts/bench/study_order.py --runs RUNS [--seeds 0 1 2]

Small networks with CriSALAD's encoder, with SAGE's, and without one are trained on rendered places,
as in `study_small.py`, whose runs are resumed. They are evaluated on 400 other places, stations of
streets, corridors and country in the order in which a drive passes them; queries and database are
in the same order, like the frames of Nordland. No two images of a side show the same place, so only
the order can leak. Batches have the sizes of SAGE's evaluation.
"""

import dataclasses
import itertools
import pathlib
import statistics
from typing import Any

from study_small import WORLD, Arm, named, open_asked, paired, small_vit, trained, with_encoder
from tables import Study, Table, flags, leave, read

from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.cross_image import SageCrossImageConfig
from crisalad_jax.synthetic import write_world
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.progress import progress_bar

SIZES = (2, 8, 16, 26)
KS = (1, 5)


def with_sage(config: TrainConfig) -> TrainConfig:
    """Use SAGE's encoder, with the size of `tiny`'s, in a configuration."""
    encoder = SageCrossImageConfig(heads=4, feedforward=128, dropout=0.0, width=96)
    model = dataclasses.replace(config.model, cross_image=encoder)
    return dataclasses.replace(config, model=model)


def arms() -> list[Arm]:
    without, world = small_vit(), WORLD
    return [
        Arm("none", without, world),
        Arm("CriSALAD's", with_encoder(without), world),
        Arm("SAGE's", with_sage(without), world),
    ]


def groupings() -> list[str]:
    pairs = itertools.product(SIZES, ("shuffled", "sequential"))
    return ["single", *(f"{kind}@{size}" for size, kind in pairs)]


def ask(arm: Arm, seed: int, runs: pathlib.Path) -> dict[str, dict[int, float]]:
    """Evaluate a trained arm, and return its recalls in percent by grouping and K."""
    asked = open_asked(runs / "worlds" / named(WORLD) / "test")
    model = trained(arm, seed, runs)
    names = groupings() if model.config.cross_image.attends else ["single"]
    results = evaluate(model, asked.data, groupings=names, reading=Reading(quiet=True))
    return {
        name: {k: 100 * each.recalls[k] for k in KS}
        for name, each in zip(names, results, strict=True)
    }


def study_of(results: dict[str, list[dict[str, dict[int, float]]]]) -> Study:
    """Tabulate encoders and groupings, with differences to shuffled batches of the same size."""
    rows = []
    for label, runs in results.items():
        for grouping in runs[0]:
            kind, _, size = grouping.partition("@")
            cells: list[Any] = [label, size or "1", kind, str(len(runs))]
            for k in KS:
                values = [run[grouping][k] for run in runs]
                cells.append(f"{statistics.mean(values):.1f}")
                for other, shown in (
                    ("single", kind != "single"),
                    (f"shuffled@{size}", kind == "sequential"),
                ):
                    cells.append(paired(values, [run[other][k] for run in runs]) if shown else "")
            rows.append(tuple(cells))
    header = ["encoder", "images", "order", "seeds"]
    for k in KS:
        header += [f"R@{k}", "over single", "over shuffled"]
    caption = (
        "Mean recall in percent on 400 rendered places, and the difference in points to single "
        "images and to shuffled batches of the same size, for runs with the same seeds, with the "
        "95 % interval by Student's t over seeds."
    )
    return Study(Table(tuple(header), rows, caption, 3), results)


def main() -> None:
    parser = flags("Train and tabulate; see the module docstring.", "docs/claims")
    parser.add_argument("--runs", type=pathlib.Path, required=True, help="folder for the trainings")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = read(parser, "order")
    write_world(arguments.runs / "worlds" / named(WORLD), WORLD)
    results: dict[str, list[dict[str, dict[int, float]]]] = {}
    total = len(arms()) * len(arguments.seeds)
    with progress_bar("trainings", total, "runs", quiet=False) as bar:
        for seed, arm in itertools.product(arguments.seeds, arms()):
            results.setdefault(arm.label, []).append(ask(arm, seed, arguments.runs))
            bar.advance(1, note=f"{arm.label}, seed {seed}")
    leave("order", study_of(results), arguments)


if __name__ == "__main__":
    main()
