"""Images described a second, beside the same model in torch, in one run.

    python scripts/bench/bench_describe.py [--out docs/performance] [--page docs/performance.md]
        [--presets b14 megaloc ...] [--sizes 224x224 ...] [--batches 8 16] [--dtype bfloat16]

The other side is the reference of the parity checks, with the same random weights. Needs torch (the
`dev` extra). On a GPU if both jax and torch find one. Before anything is timed, descriptors are
checked to be equal to rounding. `timing.py` says how contenders are timed.

Both get images that are normalised. "over devices" is nearly how the command line runs it: the CPU
made into a device for each core, the images spread over them. There programs are kept in the
compile cache besides, for which large ones do without oneDNN's products.

Memory is what a call needs at once beyond parameters and images: of jax what the compiled program
sets aside and its output, of torch the peak of what it allocates. The share of the machine is the
model's operations (two a multiply-accumulate of `crisalad info`) a second over those of the better
library's product of two square matrices.
"""

import argparse
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from tables import Study, Table, bars, count, flags, leave, read
from timing import (
    measured,
    megabytes,
    product_rate,
    race,
    ratio,
    times,
    torch_memory,
    wait,
)

# After timing, which says how many devices there are.
import jax  # isort: skip
import torch  # isort: skip

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators.cosplace import CosPlaceConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.costs import part_costs
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import Crisalad, describe
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.errors import InputError
from parity.cases.case import build, convert, random
from parity.reference.model import Crisalad as TorchCrisalad

TOLERANCES = {"float32": 1e-5, "bfloat16": 2e-2}
"""Of descriptors, which are unit vectors: parity measures 1e-6 and 5e-3 at this size."""
MODELS: Mapping[str, ModelConfig] = {
    **PRESETS,
    "cosplace-resnet50": ModelConfig(
        image_size=(480, 640),
        backbone=ResNetConfig(),
        aggregator=CosPlaceConfig(dim=2048),
        cross_image=CrossImageConfig(layers=0),
    ),
    "megaloc": ModelConfig(
        image_size=(322, 322),
        backbone=ViTConfig(adapter=AdapterConfig(kind="none")),
        aggregator=SaladConfig(cluster_dim=256),
        cross_image=CrossImageConfig(layers=0),
        projection=ProjectionConfig(dim=8448),
    ),
}
"""The sizes of CriSALAD, and two published models as their files have them."""
TORCHES = ("torch eager", "torch.compile")
OURS = ("ours", "ours, over devices")


class Contender(NamedTuple):
    name: str
    call: Callable[[], Any]
    memory: Callable[[], int]
    program: Callable[[], str] = str
    """As XLA compiled it: of torch's, nothing."""
    devices: int = 1


class Sides(NamedTuple):
    """The same model and images for both libraries."""

    theirs: TorchCrisalad
    ours: Crisalad
    config: ModelConfig
    images: np.ndarray
    """(image, height, width, 3), normalised."""
    theirs_images: torch.Tensor
    """The same, (image, 3, height, width), where torch computes."""


def sides(config: ModelConfig, name: str, batch: int, dtype: str) -> Sides:
    model = build(config, dtype, random(name, 0))
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            # Drawn small, deviations would multiply to infinity.
            layer.running_var = torch.ones_like(layer.weight)
    ours = convert(model)[0]
    images = np.random.default_rng(0).normal(size=(batch, *config.image_size, 3)).astype(np.float32)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    theirs = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous().to(device)
    return Sides(model.to(device), ours, model.config, images, theirs)


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


def seconds(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def check(contenders: Sequence[Contender], tolerance: float) -> None:
    """The descriptors are equal.

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


HEADER = (
    *("model", "images", "contender", "times faster", "share of the machine"),
    *("first call, s", "MB"),
)


class Case(NamedTuple):
    """One race."""

    title: str
    batch: int
    contenders: Sequence[Contender]
    first: dict[str, float]
    """Seconds of each one's first call, compiling included."""
    operations: float
    """Of a call."""


def compare(name: str, what: str, cases: Iterable[Case], arguments: argparse.Namespace) -> None:
    """Run the races, one after the other as they are made, and leave table, numbers and picture."""
    rate = product_rate(arguments.dtype)
    values, rows = [], []
    for case in cases:
        calls = {one.name: one.call for one in case.contenders}
        timed = race(calls, arguments.rounds, arguments.calls)
        best = min(TORCHES, key=lambda name: timed[name].median)
        for one in case.contenders:
            faster = ratio(timed[best], timed[one.name])
            per_second = 1e3 / timed[one.name].median
            share, memory = case.operations * per_second / rate, one.memory()
            values.append(
                {
                    "model": case.title,
                    "batch": case.batch,
                    "contender": one.name,
                    "ms": timed[one.name].rounds,
                    "images per second": case.batch * per_second,
                    "faster than the better torch": faster,
                    "share of the machine": share,
                    "first call": case.first[one.name],
                    "memory": memory,
                }
            )
            speed = times(faster)
            if torch.cuda.is_available():
                speed += f", {case.batch * per_second:.0f} images/s"
            first = f"{case.first[one.name]:.1f}"
            cells = (speed, f"{100 * share:.0f} %", first, megabytes(memory))
            rows.append((case.title, f"{case.batch}", one.name, *cells))
        torch.compiler.reset()
    caption = (
        f"{what}, {arguments.dtype}, {measured(arguments.rounds)}. "
        "Times faster: than the better of torch eager and torch.compile."
    )
    figure = bars(
        values,
        lambda value: f"{value['model']}, {value['batch']} images",
        "faster than the better torch",
        "times the better torch's speed",
    )
    leave(name, Study(Table(HEADER, rows, caption, 3), values, figure), arguments)


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
) -> argparse.Namespace:
    """The flags of a race, whose presets can have the sizes."""
    parser = flags(description, "docs/performance")
    parser.add_argument("--presets", nargs="+", default=presets, choices=MODELS)
    parser.add_argument(
        "--sizes", type=image_size, nargs="+", default=[None], help="such as 322x322"
    )
    parser.add_argument("--batches", type=count, nargs="+", default=batches)
    parser.add_argument("--dtype", default="float32", choices=list(TOLERANCES))
    parser.add_argument("--rounds", type=count, default=5)
    parser.add_argument("--calls", type=count, default=2)
    arguments = read(parser, name)
    try:
        for preset, size in itertools.product(arguments.presets, arguments.sizes):
            at_size(MODELS[preset], size)
    except InputError as error:
        parser.error(str(error))
    return arguments


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    for preset, size, batch in itertools.product(
        arguments.presets, arguments.sizes, arguments.batches
    ):
        config = at_size(MODELS[preset], size)
        both = sides(config, preset, batch, arguments.dtype)
        contenders = [by_torch(both, False), by_torch(both, True), by_us(both, False)]
        if len(jax.local_devices()) > 1:
            contenders.append(by_us(both, True))
        first = {one.name: seconds(one.call) for one in contenders}
        check(contenders, TOLERANCES[arguments.dtype])
        operations = 2 * batch * sum(cost.macs for cost in part_costs(config, images=batch))
        yield Case(title(preset, config), batch, contenders, first, operations)


def main() -> None:
    arguments = read_race(__doc__ or "", "bench_describe")
    compare("bench_describe", "Descriptors of a batch", cases(arguments), arguments)


if __name__ == "__main__":
    main()
