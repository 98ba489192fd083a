"""Time a new process to its first descriptor in a file, compared with torch.

    python scripts/bench/bench_start.py
        [--preset b14 tiny] [--rounds 3]

It runs `crisalad extract` on one photograph, with an empty compile cache (cold) and with the cache
of the previous run (warm); and a program that does the same with the reference of the parity
checks: it imports torch, builds the model, reads weights, describes the image and writes the
descriptor, eager and with torch.compile, also cold and warm. All take turns. The reference reads
its sizes from this package; importing the package, and jax with it, is not counted for torch.
"""

import itertools
import pathlib
import sys
import tempfile
from collections.abc import Callable

import cv2
import jax
import numpy as np
import torch
from tables import Study, Table, bars, count, flags, leave, read
from timing import Timed, measured, ratio, run_program, times

from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import Model, init_crisalad
from parity.cases.case import build, random

THEIRS = """
import sys, time
import cv2, numpy as np, torch
device = "cuda" if torch.cuda.is_available() else "cpu"
started = time.perf_counter()
from crisalad_jax.nn.config import PRESETS
from parity.reference.model import Crisalad
from usual import as_users_write_it
ours = time.perf_counter() - started
weights, image, out, preset, compiled = sys.argv[1:]
config = PRESETS[preset]
with torch.device("meta"):
    model = as_users_write_it(Crisalad(config).eval())
model.load_state_dict(torch.load(weights, mmap=True), assign=True)
model = model.to(device)
pixels = cv2.resize(cv2.imread(image)[..., ::-1], config.image_size[::-1]) / 255.0
pixels = (pixels - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
batch = torch.from_numpy(pixels.astype(np.float32).transpose(2, 0, 1)[None]).to(device)
with torch.inference_mode():
    np.save(out, (torch.compile(model) if compiled == "True" else model)(batch).cpu().numpy())
print(ours)
"""
NAMES = ("torch eager", "torch.compile, cold", "torch.compile, warm", "ours, cold", "ours, warm")


def programs(folder: pathlib.Path, preset: str) -> dict[str, Callable[[], float]]:
    """Make calls that run each of `NAMES` and return its seconds; cold ones get fresh caches."""
    config = PRESETS[preset]
    image, ours, theirs = (folder / name for name in ("images/a.jpg", "w.safetensors", "w.pth"))
    image.parent.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    cv2.imwrite(str(image), cv2.resize(pixels, (640, 480), interpolation=cv2.INTER_CUBIC))
    save_weights(ours, Model(init_crisalad(jax.random.key(0), config), config))
    torch.save(build(config, "float32", random(preset, 0)).state_dict(), theirs)
    numbers = itertools.count()

    def run(command: list[str], cache: pathlib.Path) -> tuple[float, str]:
        own, here = str(cache), str(pathlib.Path(__file__).parent)
        own_caches = {"XDG_CACHE_HOME": own, "TORCHINDUCTOR_CACHE_DIR": own}
        return run_program(command, own_caches | {"PYTHONPATH": here})

    def extract(warm: bool) -> float:
        number = next(numbers)
        options = ["--weights", str(ours), "--images", str(image.parent), "--batch-size", "1"]
        out = ["--out", str(folder / f"{number}.npy"), "--quiet"]
        cache = folder / ("warm-ours" if warm else f"cache-{number}")
        return run([sys.executable, "-m", "crisalad_jax", "extract", *options, *out], cache)[0]

    def torch_program(compiled: bool, warm: bool) -> float:
        number = next(numbers)
        options = [str(theirs), str(image), str(folder / f"{number}.npy"), preset, str(compiled)]
        cache = folder / ("warm-theirs" if warm else f"cache-{number}")
        seconds, printed = run([sys.executable, "-c", THEIRS, *options], cache)
        return seconds - float(printed)

    calls = (
        lambda: torch_program(compiled=False, warm=False),
        lambda: torch_program(compiled=True, warm=False),
        lambda: torch_program(compiled=True, warm=True),
        lambda: extract(warm=False),
        lambda: extract(warm=True),
    )
    torch_program(compiled=True, warm=True)
    extract(warm=True)
    return dict(zip(NAMES, calls, strict=True))


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--preset", nargs="+", default=["b14", "tiny"], choices=PRESETS)
    parser.add_argument("--rounds", type=count, default=3)
    arguments = read(parser, "bench_start")
    values, rows = [], []
    for preset in arguments.preset:
        timed = {name: Timed([]) for name in NAMES}
        with tempfile.TemporaryDirectory(prefix="bench-start-") as folder:
            calls = programs(pathlib.Path(folder), preset)
            for _ in range(arguments.rounds):
                for name, call in calls.items():
                    timed[name].rounds.append(1e3 * call())
        for name, one in timed.items():
            slower = ratio(one, timed["torch eager"])
            values.append({"model": preset, "contender": name, "ms": one.rounds, "slower": slower})
            rows.append((preset, name, times(slower)))
    caption = (
        f"From the start of the process to a descriptor in a file, {measured(arguments.rounds)}."
    )
    table = Table(("model", "program", "time relative to torch eager"), rows, caption, 2)
    figure = bars(values, lambda value: str(value["model"]), "slower", "time over torch eager's")
    leave("bench_start", Study(table, values, figure), arguments)


if __name__ == "__main__":
    main()
