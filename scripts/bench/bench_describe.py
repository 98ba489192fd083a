"""Measure images described per second, compared with every engine that a user might pick instead.

    python scripts/bench/bench_describe.py [--out docs/performance]
        [--presets b14 megaloc ...] [--sizes 224x224 ...] [--batches 1 8 16]
        [--dtypes float32 bfloat16] [--keep]

The other engines are torch, eager and with torch.compile, ONNX Runtime and OpenVINO
(`engines.py`). The torch model is the reference of the parity checks as users would write it
(`usual.py`), with the same random weights. It needs torch (the `dev` extra) and the `bench` extra.
On a GPU, torch is the only other engine, if both torch and jax find a GPU. Before anything is
timed, descriptors are checked to be equal up to rounding. `timing.py` explains how contenders are
timed.

All engines get normalised images. "over devices" is how the command line runs it: one device per
core, with the images spread over them. A single image runs on one device.

Memory is the peak that a call needs beyond parameters and images: for jax, the compiled program's
temporary buffers and output; for torch, the peak of its allocations; the other engines do not
report it. The share of the machine is the model's operations per second (two for each
multiply-accumulate of `crisalad info`) divided by those of the fastest matrix product that any of
the engines reaches.

All races together take more than an hour. With `--keep`, races that an earlier run left in the
folder, on the same machine and with the same versions, stay in the tables, so that the work can be
split over several runs.
"""

import argparse
import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from engines import OPENVINO, ORT, packages, peers, product_rate
from tables import Study, Table, bars, count, files_of, flags, leave, read
from timing import Timed, machine, megabytes, race, ratio, times, torch_memory, wait
from usual import as_users_write_it, narrowed

# After timing, which says how many devices there are.
import jax  # isort: skip
import torch  # isort: skip

from crisalad_jax.nn.aggregators.gem import CosPlaceConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.costs import part_costs
from crisalad_jax.nn.model import Crisalad, describe
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.errors import InputError
from parity.cases.case import build, convert, random
from parity.reference.model import Crisalad as TorchCrisalad

TOLERANCES = {"float32": 1e-5, "bfloat16": 2e-2}
"""Bounds on the errors of unit descriptors; parity measures 1e-6 and 5e-3 at this size."""
ENGINES_TOLERANCES = {**TOLERANCES, "float32": 1e-4}
"""Wider bounds for engines that choose their own arithmetic: OpenVINO is off by 1.5e-5 for `s14` in
batches of 16, where all others agree to 1e-7."""
MODELS: Mapping[str, ModelConfig] = {
    **PRESETS,
    "cosplace-resnet50": ModelConfig(
        image_size=(480, 640),
        backbone=ResNetConfig(),
        aggregator=CosPlaceConfig(dim=2048),
        cross_image="none",
    ),
    "resnet50": ModelConfig(
        image_size=(224, 224),
        backbone=ResNetConfig(),
        aggregator=CosPlaceConfig(dim=2048),
        cross_image="none",
    ),
    "vgg16": ModelConfig(
        image_size=(224, 224),
        backbone=VggConfig(),
        aggregator=CosPlaceConfig(dim=512),
        cross_image="none",
    ),
    "megaloc": ModelConfig(
        image_size=(322, 322),
        backbone=ViTConfig(adapter="none"),
        aggregator=SaladConfig(cluster_dim=256),
        cross_image="none",
        projection=ProjectionConfig(dim=8448),
    ),
}
"""The sizes of CriSALAD, two published models as in their files, and one of the two smaller."""
TORCHES = ("torch eager", "torch.compile")
OURS = ("ours", "ours, over devices")
CONTENDERS = (*TORCHES, ORT, OPENVINO, *OURS)
"""Contenders in the order of the table columns."""
DRAWN = 8
"""Batch size of the races that the plot shows."""


class Contender(NamedTuple):
    name: str
    call: Callable[[], Any]
    memory: Callable[[], int | None]
    """Bytes; None if an engine does not report them."""
    program: Callable[[], str] = str
    """The program's text as XLA compiled it; empty for torch."""
    devices: int = 1
    ready: float = 0.0
    """Seconds it took to prepare, counted as part of the first call."""


class Sides(NamedTuple):
    """The same model and images for both libraries; the torch model is as users write it."""

    theirs: TorchCrisalad
    ours: Crisalad
    config: ModelConfig
    images: np.ndarray
    """(image, height, width, 3), normalised."""
    theirs_images: torch.Tensor
    """The same, (image, 3, height, width), on the device where torch computes."""


def sides(config: ModelConfig, name: str, batch: int, dtype: str) -> Sides:
    model = build(config, dtype, random(name, 0))
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            # Small random deviations would multiply to infinity.
            layer.running_var = torch.ones_like(layer.weight)
    ours = convert(model)[0]
    images = np.random.default_rng(0).normal(size=(batch, *config.image_size, 3)).astype(np.float32)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    theirs = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous().to(device)
    return Sides(as_users_write_it(model).to(device), ours, model.config, images, theirs)


def by_torch(both: Sides, compiled: bool) -> Contender:
    model = torch.compile(both.theirs, dynamic=False) if compiled else both.theirs

    def call() -> np.ndarray:
        with torch.inference_mode():
            found = model(both.theirs_images)
        wait()
        return found

    return Contender(TORCHES[compiled], call, lambda: torch_memory(call))


def by_us(both: Sides, spread: bool) -> Contender:
    devices = devices_for(len(both.images) if spread else 1)
    params, images = devices.replicate(both.ours), devices.shard_batch(both.images)
    count = devices.mesh.size

    def call() -> jax.Array:
        return jax.block_until_ready(describe(params, images, both.config))

    def compiled() -> Any:
        return describe.lower(params, images, both.config).compile()  # pyright: ignore

    def memory() -> int:
        analysis = compiled().memory_analysis()
        return count * (analysis.temp_size_in_bytes + analysis.output_size_in_bytes)

    return Contender(OURS[spread], call, memory, lambda: compiled().as_text(), count)


def by_engines(both: Sides, dtype: str) -> list[Contender]:
    found = peers(both.theirs, both.theirs_images, dtype)
    return [
        Contender(name, peer.run, lambda: None, ready=peer.seconds) for name, peer in found.items()
    ]


def seconds(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def check(contenders: Sequence[Contender], tolerance: float) -> None:
    """Check that all descriptors are equal within `tolerance`.

    Raises:
        RuntimeError: they are not.
    """
    expected = None
    for one in contenders:
        found = one.call()
        found = np.asarray(found.float().cpu() if isinstance(found, torch.Tensor) else found)
        expected = found if expected is None else expected
        off = np.abs(found.astype(np.float64) - expected).max()
        if not off < tolerance:
            raise RuntimeError(f"{one.name}: differs from {contenders[0].name} by {off:.1e}")


class Case(NamedTuple):
    """One race."""

    title: str
    batch: int
    dtype: str
    contenders: Sequence[Contender]
    first: dict[str, float]
    """Seconds of each contender's first call, including compilation."""
    operations: float
    """Floating-point operations of a call."""


Value = dict[str, Any]
"""The stored results of one contender in a race; see `measure`."""


def measure(case: Case, rate: float, where: str, arguments: argparse.Namespace) -> list[Value]:
    """Run a race on the machine `where`, whose best rate is `rate` operations per second."""
    calls = {one.name: one.call for one in case.contenders}
    timed = race(calls, arguments.rounds, arguments.calls)
    return [
        {
            "model": case.title,
            "batch": case.batch,
            "dtype": case.dtype,
            "machine": where,
            "contender": one.name,
            "ms": timed[one.name].rounds,
            "share of the machine": 1e3 * case.operations / timed[one.name].median / rate,
            "first call": case.first[one.name],
            "memory": one.memory(),
        }
        for one in case.contenders
    ]


def races(values: Iterable[Value]) -> list[list[Value]]:
    """Group the values by race."""
    found: dict[tuple[Any, ...], list[Value]] = {}
    for value in values:
        found.setdefault((value["model"], value["batch"], value["dtype"]), []).append(value)
    return list(found.values())


def kept(old: Iterable[Value], new: Sequence[Value]) -> list[Value]:
    """Select the old values from the same machine whose races were not run again."""
    again = {(value["model"], value["batch"], value["dtype"]) for value in new}
    where = {value["machine"] for value in new}
    return [
        value
        for value in old
        if value.get("machine") in where
        and (value["model"], value["batch"], value["dtype"]) not in again
    ]


def per_second(value: Value) -> tuple[float, float, float]:
    """Return images per second: median over rounds, minimum and maximum."""
    found = [1e3 * value["batch"] / ms for ms in value["ms"]]
    return 1e3 * value["batch"] / Timed(value["ms"]).median, min(found), max(found)


def speed(value: Value) -> str:
    found = per_second(value)
    digits = 0 if found[0] >= 100 else 1
    return "{:.{d}f} ({:.{d}f} to {:.{d}f})".format(*found, d=digits)


def faster(values: Sequence[Value]) -> dict[str, tuple[float, float, float]]:
    """Return each contender's speedup over the fastest engine that is not ours, by name."""
    timed = {value["contender"]: Timed(value["ms"]) for value in values}
    best = min((name for name in timed if name not in OURS), key=lambda name: timed[name].median)
    return {name: ratio(timed[best], one) for name, one in timed.items()}


def speeds(values: Sequence[Value], caption: str) -> Table:
    columns = columns_of(values)
    rows = []
    for one in races(values):
        found = {value["contender"]: value for value in one}
        ours = min(set(OURS) & set(found), key=lambda name: Timed(found[name]["ms"]).median)
        cells = (speed(found[name]) if name in found else "" for name in columns)
        share = f"{100 * found[ours]['share of the machine']:.0f} %"
        rows.append((*labels(one), *cells, times(faster(one)[ours]), share))
    header = (
        *LABELS,
        *columns,
        "ours: speedup over the fastest other",
        "ours: share of the machine",
    )
    return Table(header, rows, caption, len(LABELS))


def costs(values: Sequence[Value], caption: str) -> Table:
    columns = columns_of(values)
    rows = []
    for one in races(values):
        found = {value["contender"]: value for value in one}
        cells = (cost(found[name]) if name in found else "" for name in columns)
        rows.append((*labels(one), *cells))
    return Table((*LABELS, *columns), rows, caption, len(LABELS))


def columns_of(values: Sequence[Value]) -> list[str]:
    there = {value["contender"] for value in values}
    return [name for name in CONTENDERS if name in there]


LABELS = ("model", "images", "type")


def labels(values: Sequence[Value]) -> tuple[str, ...]:
    one = values[0]
    return one["model"], f"{one['batch']}", one["dtype"]


def cost(value: Value) -> str:
    memory = "" if value["memory"] is None else f", {megabytes(value['memory'])} MB"
    return f"{value['first call']:.1f} s{memory}"


def compare(name: str, what: str, cases: Iterable[Case], arguments: argparse.Namespace) -> None:
    """Run the races one after another; write tables, numbers and plot.

    The files are written after every race, so that finished races survive an interruption.
    """
    where = machine(*packages())
    path = files_of(name, arguments.out)[1]
    old = json.loads(path.read_text()) if arguments.keep and path.exists() else []
    rates = {dtype: product_rate(dtype) for dtype in arguments.dtypes}
    new: list[Value] = []
    for case in cases:
        new += measure(case, rates[case.dtype], where, arguments)
        torch.compiler.reset()
        report(name, what, in_order([*kept(old, new), *new]), arguments)


def report(name: str, what: str, values: Sequence[Value], arguments: argparse.Namespace) -> None:
    rounds = min(len(value["ms"]) for value in values)
    where = values[0]["machine"]
    drawn = [
        {**value, "faster": faster(one)[value["contender"]]}
        for one in races(values)
        for value in one
        if value["batch"] == DRAWN
    ]
    figure = None
    if drawn:
        figure = bars(
            drawn,
            lambda value: f"{value['model']}, {value['dtype']}",
            "faster",
            f"{DRAWN} images: times the fastest other",
        )
    caption = f"{what}: images per second. {where}; medians and ranges of {rounds} rounds or more."
    study = Study(speeds(values, caption), values, figure)
    leave(name, study, arguments)
    caption = f"{what}: the first call, including compilation, and memory. {where}."
    names = ("model", "batch", "dtype", "contender", "first call", "memory")
    numbers = [{name: value[name] for name in names} for value in values]
    leave(f"{name}_costs", Study(costs(values, caption), numbers), arguments)


def in_order(values: Sequence[Value]) -> list[Value]:
    """Sort by model as in `MODELS`, size, type and batch, without reordering contenders."""
    models = list(MODELS)

    def place(value: Value) -> tuple[int, str, bool, int]:
        preset, _, size = value["model"].partition(" at ")
        return models.index(preset), size, value["dtype"] != "float32", value["batch"]

    return sorted(values, key=place)


def title(preset: str, config: ModelConfig) -> str:
    return f"{preset} at {config.image_size[0]} x {config.image_size[1]}"


def image_size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a size such as 322x322")
    return int(height), int(width)


def at_size(config: ModelConfig, size: tuple[int, int] | None) -> ModelConfig:
    return config if size is None else dataclasses.replace(config, image_size=size)


def read_race(
    description: str,
    name: str,
    presets: Sequence[str] = ("tiny", "s14", "b14"),
    batches: Sequence[int] = (8, 16),
    dtypes: Sequence[str] = ("float32",),
) -> argparse.Namespace:
    """Parse the flags of a race, and check that the presets support the sizes."""
    parser = flags(description, "docs/performance")
    parser.add_argument("--presets", nargs="+", default=presets, choices=MODELS)
    parser.add_argument(
        "--sizes", type=image_size, nargs="+", default=[None], help="such as 322x322"
    )
    parser.add_argument("--batches", type=count, nargs="+", default=batches)
    parser.add_argument("--dtypes", nargs="+", default=dtypes, choices=list(TOLERANCES))
    parser.add_argument("--keep", action="store_true", help="also show the races of an earlier run")
    parser.add_argument("--rounds", type=count, default=5)
    parser.add_argument("--calls", type=count, default=2)
    arguments = read(parser, name, f"{name}_costs")
    try:
        for preset, size in itertools.product(arguments.presets, arguments.sizes):
            at_size(MODELS[preset], size)
    except InputError as error:
        parser.error(str(error))
    return arguments


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    for preset, size, dtype, batch in itertools.product(
        arguments.presets, arguments.sizes, arguments.dtypes, arguments.batches
    ):
        config = at_size(MODELS[preset], size)
        both = sides(config, preset, batch, dtype)
        engines = by_engines(both, dtype)
        narrowed(both.theirs)
        contenders = [by_torch(both, False), by_torch(both, True), *engines, by_us(both, False)]
        if devices_for(batch).mesh.size > 1:
            contenders.append(by_us(both, True))
        first = {one.name: one.ready + seconds(one.call) for one in contenders}
        check([one for one in contenders if one not in engines], TOLERANCES[dtype])
        check([contenders[0], *engines], ENGINES_TOLERANCES[dtype])
        operations = 2 * batch * sum(cost.macs for cost in part_costs(config, images=batch))
        yield Case(title(preset, config), batch, dtype, contenders, first, operations)


def main() -> None:
    presets, types = ("tiny", "s14", "b14", "resnet50"), ("float32", "bfloat16")
    arguments = read_race(__doc__ or "", "bench_describe", presets, (1, 8, 16), types)
    compare("bench_describe", "Descriptors of a batch", cases(arguments), arguments)


if __name__ == "__main__":
    main()
