"""How long `Map.locate` takes on some cores, by JAX and by the engines that `--runtime auto` takes.

    python scripts/bench/bench_locate.py [--out docs/performance] [--page docs/performance.md]
        [--presets tiny s14 b14] [--cores 1 2 4] [--rounds 5]

A program of its own asks a map of 64 images where one camera's frame was taken, over and over, as a
robot does. It may use the first so many cores, and takes as many threads. Numbers of cores that
this machine does not have are left out. Ratios are to the fastest of the same row.
"""

import pathlib
import sys
import tempfile
from typing import Any

import jax
from bench_query import write_photographs
from engines import packages
from tables import Study, Table, bars, count, flags, leave, read
from timing import Timed, measured, ratio, run_program, times

from crisalad_jax import Reading, index
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import Model, init_crisalad
from crisalad_jax.utils.host import usable_cores

SCRIPT = """
import os, sys
places, weights, engine, image, cores = sys.argv[1:]
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:int(cores)])  # before threads are made
import statistics, time
from crisalad_jax import Map, read_image
here = Map.open(places)
here.load_model(weights, engine=engine)
pixels = read_image(image)
end, found = time.perf_counter() + 1, []
while time.perf_counter() < end or len(found) < 3:
    here.locate(pixels)
    found.append(0)
found, end = [], time.perf_counter() + 2
while time.perf_counter() < end or len(found) < 5:
    started = time.perf_counter()
    here.locate(pixels)
    found.append(time.perf_counter() - started)
print(1e3 * statistics.median(found))
"""
ENGINES = ("jax", "onnxruntime", "openvino")


def measure(preset: str, cores: list[int], rounds: int) -> list[dict[str, Any]]:
    """Make a map of random weights, and ask it by each engine in turn."""
    with tempfile.TemporaryDirectory(prefix="bench-locate-") as name:
        folder = pathlib.Path(name)
        photographs, weights, places = (folder / part for part in ("images", "w", "map"))
        weights = weights.with_suffix(".safetensors")
        write_photographs(photographs)
        config = PRESETS[preset]
        model = Model(init_crisalad(jax.random.key(0), config), config)
        save_weights(weights, model)
        index(model, photographs, places, weights=weights, reading=Reading(quiet=True))
        timed = {(n, engine): Timed([]) for n in cores for engine in ENGINES}
        image, cache = photographs / "007.jpg", {"XDG_CACHE_HOME": str(folder / "cache")}
        for _ in range(rounds):
            for (n, engine), one in timed.items():
                asked = [str(places), str(weights), engine, str(image), str(n)]
                _, printed = run_program([sys.executable, "-c", SCRIPT, *asked], cache)
                one.rounds.append(float(printed))
    found = []
    for n in cores:
        row = {engine: timed[n, engine] for engine in ENGINES}
        best = min(row.values(), key=lambda one: one.median)
        for engine, one in row.items():
            of_one = ratio(timed[cores[0], engine], one)
            kept = {"model": preset, "cores": n, "contender": engine, "ms": one.rounds}
            found.append({**kept, "slower": ratio(one, best), "of the first": of_one})
    return found


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--presets", nargs="+", default=["tiny", "s14", "b14"], choices=PRESETS)
    parser.add_argument("--cores", nargs="+", type=count, default=[1, 2, 4])
    parser.add_argument("--rounds", type=count, default=5)
    arguments = read(parser, "bench_locate")
    cores = [n for n in sorted(set(arguments.cores)) if n <= usable_cores()]
    values = [
        value for preset in arguments.presets for value in measure(preset, cores, arguments.rounds)
    ]
    rows = []
    for one in values:
        relative = (times(one[name]) for name in ("slower", "of the first"))
        rows.append((one["model"], f"{one['cores']}", one["contender"], *relative))
    header = ("model", "cores", "engine", "time over the fastest's", "speed over fewest cores'")
    words = measured(arguments.rounds, *packages())
    caption = f"`Map.locate` of one image, the model loaded: {words}."
    figure = bars(
        values,
        lambda value: f"{value['model']}, {value['cores']} cores",
        "slower",
        "time over the fastest's",
    )
    leave("bench_locate", Study(Table(header, rows, caption, 3), values, figure), arguments)


if __name__ == "__main__":
    main()
