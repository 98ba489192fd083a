"""Measure what bfloat16 gains and loses compared with float32, and why there is no int8.

    python scripts/bench/bench_modes.py
        [--presets s14 b14] [--batch 8] [--run demo/run] [--city demo/city]

It writes four tables. One matrix product, of the size of the widest in `b14`: its speed by type and
by the library that XLA uses. Descriptors of a batch, with images spread over the devices: the
speedup over float32, and the cosine of each to the same descriptor in float32; parameters are the
random ones of the parity checks. And for a trained model, by default the demo's, if it exists:
cosines of descriptors and Recall@K in both types; and the cosine of each part's gradient, on
batches of its training images. `timing.py` explains how contenders are timed.
"""

import argparse
import dataclasses
import functools
import itertools
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from libraries import LIBRARIES
from tables import Study, Table, bars, count, flags, leave, read_some
from timing import machine, measured, race, ratio, times

# After timing, which says how many devices there are.
import jax  # isort: skip
import jax.numpy as jnp  # isort: skip

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.io import read_config
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, describe
from crisalad_jax.retrieval.describe import describe_files, prepare_image
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.step import init_train_state, loss_and_gradient, step_config
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.pytree import named_leaves
from parity.cases.case import build, convert, random

TYPES = {"float32": "float32", "bfloat16": "float32", "int8": "int32"}
"""The type of the factors, and the type of their sums."""
DEFAULT = "jaxlib's choice"
CHOICES = {DEFAULT: {}, **LIBRARIES}
ROWS, WIDTH, HIDDEN = 2056, 768, 3072
"""Tokens of eight images through `b14`'s first feed-forward layer."""


def product(dtype: str, library: str) -> Callable[[], Any]:
    generator = np.random.default_rng(0)
    a, b = (
        jnp.asarray(generator.integers(-100, 100, shape), dtype)
        for shape in ((ROWS, WIDTH), (WIDTH, HIDDEN))
    )
    multiply = functools.partial(jnp.matmul, preferred_element_type=TYPES[dtype])
    compiled = jax.jit(multiply, compiler_options=CHOICES[library])
    return lambda: jax.block_until_ready(compiled(a, b))


def products(arguments: argparse.Namespace) -> Study:
    libraries = tuple(CHOICES) if jax.default_backend() == "cpu" else (DEFAULT,)
    calls = {
        f"{dtype}, {library}": product(dtype, library) for dtype in TYPES for library in libraries
    }
    timed = race(calls, arguments.rounds, 5)
    values, rows = [], []
    for (dtype, sums), library in itertools.product(TYPES.items(), libraries):
        faster = ratio(timed[f"float32, {DEFAULT}"], timed[f"{dtype}, {library}"])
        values.append({"type": dtype, "contender": library, "faster": faster})
        rows.append((dtype, sums, library, times(faster)))
    size = f"{ROWS} x {WIDTH} by {WIDTH} x {HIDDEN}"
    caption = f"One product, {size}, {measured(arguments.rounds)}."
    header = ("type", "sums", "library", f"speedup over float32, {DEFAULT}")
    figure = bars(values, lambda value: value["type"], "faster", "times float32")
    return Study(Table(header, rows, caption, 3), values, figure)


def cosines(narrow: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Return the cosines of unit vectors."""
    return np.sum(narrow.astype(np.float64) * wide, axis=-1)


def in_type(config: ModelConfig, dtype: str) -> ModelConfig:
    return dataclasses.replace(config, compute_dtype=dtype)


def described(params: Crisalad, config: ModelConfig, images: np.ndarray) -> Callable[[], Any]:
    devices = devices_for(len(images))
    everywhere, spread = devices.replicate(params), devices.shard_batch(images)
    return lambda: jax.block_until_ready(describe(everywhere, spread, config))


def speed(arguments: argparse.Namespace) -> Study:
    values, rows = [], []
    for preset in arguments.presets:
        model = build(PRESETS[preset], "float32", random(preset, 0))
        params, config = convert(model)[0], model.config
        shape = (arguments.batch, *config.image_size, 3)
        images = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
        calls = {
            dtype: described(params, in_type(config, dtype), images)
            for dtype in ("float32", "bfloat16")
        }
        wide, narrow = (np.asarray(call(), np.float32) for call in calls.values())
        timed = race(calls, arguments.rounds, arguments.calls)
        faster, alike = ratio(timed["float32"], timed["bfloat16"]), cosines(narrow, wide)
        values.append({"model": preset, "contender": "bfloat16", "faster": faster})
        values[-1]["cosine"] = alike.tolist()
        rows.append((preset, times(faster), f"{alike.mean():.5f}", f"{alike.min():.5f}"))
    caption = (
        f"Descriptors of {arguments.batch} images in bfloat16, {measured(arguments.rounds)}. "
        "Cosine: to the same descriptor in float32."
    )
    header = ("model", "speedup over float32", "mean cosine", "smallest cosine")
    figure = bars(values, lambda v: v["model"], "faster", "times float32's speed")
    return Study(Table(header, rows, caption, 1), values, figure)


def recall(arguments: argparse.Namespace) -> Study:
    params, config = load_weights(arguments.run / "last.safetensors")
    benchmark = open_benchmark(arguments.city / "test")
    values, rows, descriptors = [], [], {}
    for dtype in ("float32", "bfloat16"):
        typed = in_type(config, dtype)
        descriptors[dtype] = describe_files(Model(params, typed), benchmark.queries, Reading())
        alike = cosines(descriptors[dtype], descriptors["float32"])
        results = evaluate(
            Model(params, typed),
            benchmark,
            groupings=("single", "shuffled", "sequential"),
            seeds=1,
            reading=Reading(batch_size=16, quiet=True),
        )
        for result in results:
            values.append(
                {
                    "contender": dtype,
                    "grouping": result.grouping,
                    "recalls": result.recalls,
                    "R@1": (result.recalls[1],),
                    "cosine": [alike.mean(), alike.min()],
                }
            )
            found = (f"{100 * result.recalls[k]:.1f}" for k in (1, 5, 10))
            rows.append(
                (dtype, result.grouping, *found, f"{alike.mean():.5f}", f"{alike.min():.5f}")
            )
    caption = (
        f"Recall@K of a trained model on {benchmark.name}, {len(benchmark.queries)} queries; "
        f"cosines of the queries' descriptors (single) to those in float32. {machine()}."
    )
    header = ("type", "grouping", "R@1", "R@5", "R@10", "mean cosine", "smallest cosine")
    figure = bars(values, lambda v: v["grouping"], "R@1", "Recall@1")
    return Study(Table(header, rows, caption, 2), values, figure)


def directions(
    params: Crisalad, config: TrainConfig, batches: list[np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the gradient of each batch's loss as a unit vector, by part of the model."""
    many, images = config.places_per_batch, config.images_per_place
    labels, valid = np.repeat(np.arange(many), images), np.ones(many * images, bool)
    step = step_config(config, steps=1)
    state, frozen = init_train_state(params, config.trainable, step)
    gradient = jax.jit(functools.partial(loss_and_gradient, key=None, config=step))
    found: dict[str, list[np.ndarray]] = {}
    for pixels in batches:
        _, (whole, _) = gradient(state, frozen, pixels, labels, valid)
        parts: dict[str, list[np.ndarray]] = {}
        for name, leaf in named_leaves(whole).items():
            for part in ("all", "adapters" if "adapter" in name else name.split(".")[0]):
                parts.setdefault(part, []).append(np.ravel(leaf))
        for part, leaves in parts.items():
            one = np.concatenate(leaves).astype(np.float64)
            found.setdefault(part, []).append(one / np.linalg.norm(one))
    return {part: np.stack(rows) for part, rows in found.items()}


def gradients(arguments: argparse.Namespace) -> Study:
    params, model = load_weights(arguments.run / "last.safetensors")
    config = read_config(TrainConfig, arguments.run / "config.json")
    # Rounding may change which pairs are mined, and a run of one step has no warm-up.
    config = dataclasses.replace(
        config,
        loss=dataclasses.replace(config.loss, miner="none"),
        optimiser=dataclasses.replace(config.optimiser, warmup_steps=0),
    )
    many, images = config.places_per_batch, config.images_per_place
    places = read_places(arguments.city / "train", min_images=images)
    starts = places.place_start[:-1]
    batches = [
        np.stack(
            [
                prepare_image(read_image(places.path(start + i)), model)
                for start in starts[first : first + many]
                for i in range(images)
            ]
        )
        for first in range(0, len(starts) - many + 1, many)
    ][: arguments.batches]
    narrow = dataclasses.replace(config, model=in_type(model, "bfloat16"))
    exact = directions(params, config, batches)
    found = directions(params, narrow, batches)
    values, rows = [], []
    for part, whole in exact.items():
        alike = cosines(found[part], whole)
        values.append({"part": part, "cosine": alike.tolist()})
        rows.append((part, f"{np.median(alike):.5f}", f"{alike.min():.5f}"))
    height, width = model.image_size
    caption = (
        f"Cosines of gradients in bfloat16 to those in float32: {len(batches)} batches of {many} "
        f"places x {images} images of {height} x {width}, a trained model, all pairs in the loss, "
        f"{machine()}."
    )
    return Study(Table(("part of the gradient", "median", "smallest"), rows, caption), values)


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--presets", nargs="+", default=["s14", "b14"], choices=PRESETS)
    parser.add_argument("--batch", type=count, default=8)
    parser.add_argument("--rounds", type=count, default=5)
    parser.add_argument("--calls", type=count, default=2)
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("demo/run"))
    parser.add_argument("--city", type=pathlib.Path, default=pathlib.Path("demo/city"))
    parser.add_argument("--batches", type=count, default=5, help="batches of gradients")
    studies = {
        "bench_products": products,
        "bench_bfloat16": speed,
        "bench_recall": recall,
        "bench_gradients": gradients,
    }
    arguments = read_some(parser, studies)
    for name in arguments.studies:
        of_trained = name in ("bench_recall", "bench_gradients")
        if of_trained and not (arguments.run.is_dir() and arguments.city.is_dir()):
            print(
                f"{name}: found no {arguments.run} or {arguments.city}; scripts/demo.sh makes both"
            )
            continue
        leave(name, studies[name](arguments), arguments)


if __name__ == "__main__":
    main()
