"""The demo: render a synthetic city, train on it and evaluate; it needs no data set."""

import dataclasses
import functools
import pathlib
import time
from typing import NamedTuple

import jax

from crisalad_jax.checkpoints.load import load
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.report import (
    RecallRow,
    recall_curves,
    recall_table,
    save,
    save_chart,
    show_retrievals,
    training_curves,
)
from crisalad_jax.experiments.tables import write_text
from crisalad_jax.nn.model import Model, init_crisalad
from crisalad_jax.synthetic import SyntheticCityConfig, write_synthetic_city
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_no_links
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.temporaries import holds_other_files, remove_temporaries

GROUPINGS = ("single", "shuffled", "sequential")
"""Groupings that the demo evaluates; not `window`: rendered places have no order in time."""


@dataclasses.dataclass(frozen=True)
class DemoConfig:
    """Settings of the demo; by default it takes about two minutes on two cores."""

    seed: int = 0
    train_places: int = 240
    test_places: int = 150
    epochs: int = 18


class DemoSummary(NamedTuple):
    """Results and files of the demo, and the seconds that it took, in total and for training."""

    rows: list[RecallRow]
    pictures: list[pathlib.Path]
    seconds: float
    training_seconds: float


def run_demo(config: DemoConfig, out: pathlib.Path, *, quiet: bool = False) -> DemoSummary:
    """Render a city, evaluate before and after training; write tables and pictures into `out`.

    If the training run in `out/run` was interrupted, it resumes.

    Raises:
        InputError: `out` holds other files, or a demo of another configuration; or another process
            is writing there.
    """
    with lock(out):
        check_no_links(out)
        if not (out / "city").exists() and holds_other_files(out):
            raise InputError(
                f"{out}: found files but no demo, expected a demo or a new or empty folder"
            )
        remove_temporaries(out)
        return _run(config, out, quiet)


def _run(config: DemoConfig, out: pathlib.Path, quiet: bool) -> DemoSummary:
    started = time.monotonic()
    city = SyntheticCityConfig(
        train_places=config.train_places, test_places=config.test_places, seed=config.seed
    )
    write_synthetic_city(out / "city", city, quiet=quiet)
    benchmark = open_benchmark(out / "city" / "test")
    measure = functools.partial(
        evaluate,
        benchmark=benchmark,
        groupings=GROUPINGS,
        seed=config.seed,
        seeds=1,
        reading=Reading(quiet=quiet),
    )

    settings = demo_recipe(config)
    params = init_crisalad(jax.random.key(config.seed), settings.model)
    untrained = measure(Model(params, settings.model))
    training_started = time.monotonic()
    fit(settings, read_places(out / "city" / "train"), out / "run", quiet=quiet)
    training_seconds = time.monotonic() - training_started
    results = {
        "HOG, no learning": measure(load("hog")),
        "untrained": untrained,
        "trained": measure(load_weights(out / "run" / "last.safetensors")),
    }

    rows = [
        RecallRow(benchmark.name, model, result.grouping, result.recalls)
        for model, of_model in results.items()
        for result in of_model
    ]
    curves = {f"{r.model}, {r.grouping}": r.recalls for r in rows if r.grouping != "shuffled"}
    title = "Queries and what the trained model finds, every image described independently"
    figures = {
        "recall.png": recall_curves(curves, "Recall@K on places never seen in training", wide=True),
        "training.png": training_curves(read_metrics(out / "run" / "metrics.jsonl")),
        "gallery.png": show_retrievals(results["trained"][0], benchmark, rows=6, title=title),
    }
    for name, figure in figures.items():
        (save if name == "gallery.png" else save_chart)(figure, out / name)
    write_text(out / "recalls.md", recall_table(rows).markdown())
    pictures = [out / name for name in figures]
    return DemoSummary(rows, pictures, time.monotonic() - started, training_seconds)


def demo_recipe(config: DemoConfig) -> TrainConfig:
    """Return the `tiny` recipe: four images per place, mildly augmented as their light varies."""
    return dataclasses.replace(
        recipe("tiny"),
        augmentation=LightAugmentConfig(),
        places_per_batch=24,
        images_per_place=4,
        min_images=4,
        epochs=config.epochs,
        seed=config.seed,
    )
