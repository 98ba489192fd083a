"""Time `crisalad query` from start to answer with each runtime, compared with a custom script.

    python scripts/bench/bench_query.py [--out docs/performance]
        [--preset tiny b14] [--runtime jax onnxruntime openvino] [--rounds 5]

Each contender is a separate process that finds where one photograph was taken, in a map of 64
images. An earlier run has filled the caches (compiled programs, exported models). The script is
what a user would write for speed: numpy, OpenCV and ONNX Runtime, with the exported model and the
map's descriptors in a .npy file.
"""

import pathlib
import resource
import sys
import tempfile
from collections.abc import Callable

import cv2
import jax
import numpy as np
from engines import packages
from tables import Study, Table, bars, count, flags, leave, read
from timing import Timed, measured, ratio, run_program, times

from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import Model, init_crisalad

SCRIPT = """
import sys
import cv2, numpy as np, onnxruntime
program, rows, image = sys.argv[1:]
session = onnxruntime.InferenceSession(program, providers=["CPUExecutionProvider"])
_, height, width, _ = session.get_inputs()[0].shape
pixels = cv2.resize(cv2.imread(image)[..., ::-1], (width, height), interpolation=cv2.INTER_AREA)
(descriptor,) = session.run(None, {"images": pixels[None]})[0]
similarities = np.load(rows, mmap_mode="r") @ descriptor
print(np.argsort(-similarities)[:5], np.sort(-similarities)[:5])
"""
BY_HAND = "a script with ONNX Runtime"
IMAGES = 64


def write_photographs(folder: pathlib.Path) -> None:
    """Write pictures of blurred noise, as large as a camera's."""
    folder.mkdir()
    generator = np.random.default_rng(0)
    for number in range(IMAGES):
        pixels = generator.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        large = cv2.resize(pixels, (640, 480), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number:03d}.jpg"), large)


def spent(command: list[str], cache: pathlib.Path) -> tuple[float, float]:
    """Run a program, and return its wall-clock and processor seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds, _ = run_program(command, {"XDG_CACHE_HOME": str(cache)})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def programs(
    folder: pathlib.Path, preset: str, runtimes: list[str]
) -> dict[str, Callable[[], tuple[float, float]]]:
    """Make calls that query once, by name, with caches already filled."""
    config = PRESETS[preset]
    photographs, weights, places = (folder / name for name in ("images", "w.safetensors", "map"))
    write_photographs(photographs)
    params = init_crisalad(jax.random.key(0), config)
    save_weights(weights, Model(params, config))
    write_export(folder / "export", Model(params, config), ExportConfig(format="onnx"))
    crisalad, cache = [sys.executable, "-m", "crisalad_jax"], folder / "cache"
    model = ["--weights", str(weights)]
    shown = ["--images", str(photographs), "--out", str(places), "--quiet"]
    spent([*crisalad, "index", *model, *shown], cache)
    rows = folder / "rows.npy"
    np.save(rows, np.load(next((places / "segments").glob("*.npy"))))
    image = str(photographs / "007.jpg")

    def asking(runtime: str) -> Callable[[], tuple[float, float]]:
        asked = [image, "--map", str(places), *model, "--runtime", runtime, "--quiet"]
        return lambda: spent([*crisalad, "query", *asked], cache)

    by_hand = [sys.executable, "-c", SCRIPT, str(folder / "export/describe.onnx"), str(rows), image]
    calls = {BY_HAND: lambda: spent(by_hand, cache)}
    calls |= {f"crisalad query, {runtime}": asking(runtime) for runtime in runtimes}
    for call in calls.values():
        call()
    return calls


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--preset", nargs="+", default=["tiny", "b14"], choices=PRESETS)
    engines = ["jax", "onnxruntime", "openvino"]
    parser.add_argument("--runtime", nargs="+", default=engines, choices=engines)
    parser.add_argument("--rounds", type=count, default=5)
    arguments = read(parser, "bench_query")
    values, rows = [], []
    for preset in arguments.preset:
        with tempfile.TemporaryDirectory(prefix="bench-query-") as folder:
            calls = programs(pathlib.Path(folder), preset, arguments.runtime)
            clock, processor = ({name: Timed([]) for name in calls} for _ in range(2))
            for _ in range(arguments.rounds):
                for name, call in calls.items():
                    seconds, busy = call()
                    clock[name].rounds.append(1e3 * seconds)
                    processor[name].rounds.append(1e3 * busy)
        for name, one in clock.items():
            slower = ratio(one, clock[BY_HAND])
            more = ratio(processor[name], processor[BY_HAND])
            both = {"ms": one.rounds, "processor_ms": processor[name].rounds}
            values.append({"model": preset, "contender": name, **both, "slower": slower})
            rows.append((preset, name, times(slower), times(more)))
    header = (
        "model",
        "program",
        "time relative to the script",
        "processor time relative to the script",
    )
    caption = (
        "From the start of a process to the answers for one photograph, with caches filled: "
        f"{measured(arguments.rounds, *packages())}."
    )
    figure = bars(values, lambda value: str(value["model"]), "slower", "time over the script's")
    leave("bench_query", Study(Table(header, rows, caption, 2), values, figure), arguments)


if __name__ == "__main__":
    main()
