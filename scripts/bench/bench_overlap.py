"""Measure whether a training step waits for its images, compared with the loader alone.

    python scripts/bench/bench_overlap.py [--out docs/training]
        [--presets tiny s14] [--batch 48] [--steps 12] [--rounds 3]

It runs `fit` (the paper's recipe, from random weights) on rendered photographs of 400 x 300, made
as in `bench_loader.py`, with RandAugment. `waited_for_images` in `metrics.jsonl` is the share of a
step's time between the end of the previous step and the arrival of its images on the devices. Each
run is followed by its loader alone on the same files: the share that a step would wait if nothing
were read ahead, on the same cores. The first steps are left out, because they include compilation
and use batches that were read before any step.
"""

import argparse
import dataclasses
import pathlib
import statistics
import tempfile
import time
from typing import Any

from bench_loader import IMAGES_PER_PLACE, SIZES, write_tree
from tables import Study, Table, count, flags, leave, read

from crisalad_jax.data.places import Places, read_places
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.training.batches import PlaceBatches
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils import compiler

LEFT_OUT = 4


def steps_of(config: TrainConfig, places: Places, out: pathlib.Path) -> tuple[list[float], ...]:
    """Return the seconds of each step, and the share of each that was spent waiting."""
    fit(config, places, out)
    lines = read_metrics(out / "metrics.jsonl")[LEFT_OUT:]
    images = config.places_per_batch * config.images_per_place
    seconds = [images / line["images_per_second"] for line in lines]
    return seconds, [line["waited_for_images"] for line in lines]


def loader_alone(config: TrainConfig, places: Places) -> list[float]:
    """Return the seconds of each batch."""
    seconds, started = [], time.perf_counter()
    for _ in PlaceBatches(config, places).batches(0):
        seconds.append(time.perf_counter() - started)
        started = time.perf_counter()
    return seconds[LEFT_OUT:]


def compare(preset: str, arguments: argparse.Namespace, root: pathlib.Path) -> dict[str, Any]:
    config = dataclasses.replace(
        recipe(preset, "crisalad"),
        places_per_batch=arguments.batch // IMAGES_PER_PLACE,
        images_per_place=IMAGES_PER_PLACE,
        epochs=1,
    )
    places = read_places(root)
    values: dict[str, Any] = {"preset": preset, "step": [], "waited": [], "loader": []}
    for number in range(arguments.rounds):
        step, waited = steps_of(config, places, root / f"{preset}-{number}")
        values["step"] += step
        values["waited"] += waited
        values["loader"] += loader_alone(config, places)
    return values


def main() -> None:
    parser = flags(__doc__ or "", "docs/training")
    parser.add_argument("--presets", choices=PRESETS, nargs="+", default=["tiny", "s14"])
    parser.add_argument("--batch", type=count, default=48)
    parser.add_argument("--steps", type=count, default=12)
    parser.add_argument("--rounds", type=count, default=3)
    arguments = read(parser, "bench_overlap")
    if arguments.batch % IMAGES_PER_PLACE or arguments.steps <= LEFT_OUT:
        parser.error(
            f"found {arguments.steps} steps of {arguments.batch} images, expected more than "
            f"{LEFT_OUT} steps, of a multiple of {IMAGES_PER_PLACE}"
        )
    compiler.configure()
    with tempfile.TemporaryDirectory(prefix="overlap-") as temporary:
        root = pathlib.Path(temporary)
        write_tree(root, arguments.steps * arguments.batch, SIZES[0])
        values = [compare(preset, arguments, root) for preset in arguments.presets]
    rows = []
    for value in values:
        step, loader = statistics.median(value["step"]), statistics.median(value["loader"])
        waited = statistics.median(value["waited"])
        rows.append((value["preset"], f"{100 * loader / step:.1f} %", f"{100 * waited:.1f} %"))
    caption = (
        f"Training steps of {arguments.batch} images with RandAugment from JPEGs of 400 x 300, "
        f"medians of {arguments.rounds} runs of {arguments.steps} steps: the loader's time alone "
        "and the time that a step waits for it, both as shares of the step's time."
    )
    header = ("model", "loader alone", "waiting in training")
    leave("bench_overlap", Study(Table(header, rows, caption), values), arguments)


if __name__ == "__main__":
    main()
