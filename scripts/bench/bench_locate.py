"""Measure the latency of `Map.locate` with JAX and the engines of `--runtime auto`, by core count.

    python scripts/bench/bench_locate.py [--out docs/performance]
        [--preset tiny s14 b14]
        [--runtime jax onnxruntime openvino] [--cores 1 2 4] [--rounds 5]

Each run is a separate process on the first N cores. It queries a map of 64 images with one camera
frame, over and over, as a robot does; the first answers of all engines must agree. Core counts that
this machine does not have are skipped. Ratios are relative to the fastest engine on the same number
of cores, and to the same engine on the fewest cores.
"""

import json
import pathlib
import sys
import tempfile
from typing import Any

import jax
from bench_query import write_photographs
from engines import packages
from tables import Study, Table, count, flags, leave, read
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
import json, statistics, time
from crisalad_jax import Map, read_image
here = Map.open(places)
here.load_model(weights, engine=engine)
pixels = read_image(image)
def timed(seconds, least):
    end, found = time.perf_counter() + seconds, []
    while time.perf_counter() < end or len(found) < least:
        started = time.perf_counter()
        answers = here.locate(pixels)
        found.append(time.perf_counter() - started)
    return 1e3 * statistics.median(found), answers[0].image.name
timed(1, 3)
print(json.dumps(timed(2, 5)))
"""
ENGINES = ("jax", "onnxruntime", "openvino")


def measure(
    preset: str, engines: list[str], cores: list[int], rounds: int
) -> dict[tuple[int, str], Timed]:
    """Make a map with random weights, and query it with each engine in turn.

    Raises:
        RuntimeError: the engines answer differently.
    """
    with tempfile.TemporaryDirectory(prefix="bench-locate-") as name:
        folder = pathlib.Path(name)
        photographs, weights, places = (folder / x for x in ("images", "w.safetensors", "map"))
        write_photographs(photographs)
        config = PRESETS[preset]
        model = Model(init_crisalad(jax.random.key(0), config), config)
        save_weights(weights, model)
        index(model, photographs, places, weights=weights, reading=Reading(quiet=True))
        timed = {(n, engine): Timed([]) for n in cores for engine in engines}
        image, cache = photographs / "007.jpg", {"XDG_CACHE_HOME": str(folder / "cache")}
        for _ in range(rounds):
            for (n, engine), one in timed.items():
                asked = [str(places), str(weights), engine, str(image), str(n)]
                _, printed = run_program([sys.executable, "-c", SCRIPT, *asked], cache)
                milliseconds, found = json.loads(printed)
                if found != image.name:
                    raise RuntimeError(f"{preset}, {engine}: found {found}, expected {image.name}")
                one.rounds.append(milliseconds)
    return timed


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--preset", nargs="+", default=["tiny", "s14", "b14"], choices=PRESETS)
    parser.add_argument("--runtime", nargs="+", default=list(ENGINES), choices=ENGINES)
    parser.add_argument("--cores", nargs="+", type=count, default=[1, 2, 4])
    parser.add_argument("--rounds", type=count, default=5)
    arguments = read(parser, "bench_locate")
    cores = [n for n in sorted(set(arguments.cores)) if n <= usable_cores()]
    if not cores:
        parser.error(f"found {usable_cores()} cores, expected at least the smallest of --cores")
    values: list[dict[str, Any]] = []
    rows = []
    for preset in arguments.preset:
        timed = measure(preset, arguments.runtime, cores, arguments.rounds)
        for (n, engine), one in timed.items():
            best = min((timed[n, each] for each in arguments.runtime), key=lambda x: x.median)
            slower, more = ratio(one, best), ratio(timed[cores[0], engine], one)
            kept = {"model": preset, "cores": n, "contender": engine, "ms": one.rounds}
            values.append({**kept, "slower": slower, "over the fewest cores": more})
            rows.append((preset, f"{n}", engine, f"{one.median:.1f}", times(slower), times(more)))
    header = (
        *("model", "cores", "engine", "ms", "time relative to the fastest"),
        f"speedup over {cores[0]} core{'s' * (cores[0] > 1)}",
    )
    words = measured(arguments.rounds, *packages())
    caption = f"`Map.locate` of one image of 640 x 480, the model loaded: {words}."
    leave("bench_locate", Study(Table(header, rows, caption, 3), values), arguments)


if __name__ == "__main__":
    main()
