"""Break down the time of our programs with a trace of `jax.profiler`.

    python scripts/bench/bench_profile.py
        [--presets tiny s14 b14] [--batch 8]

It traces the description of a batch and a training step, on the devices that the command line
uses. Every operation in the trace is assigned to one of `KINDS` by its entry in the compiled
program. Shares are of the time of all devices; parameters are the random ones of the parity checks.
"""

import gzip
import json
import pathlib
import re
import tempfile
import time
from collections.abc import Iterable, Mapping
from typing import Any

from bench_describe import Contender, by_us, sides, title
from bench_train import our_step
from matplotlib.figure import Figure
from tables import COLOURS, Study, Table, count, flags, leave, panels, read
from timing import machine

# After timing, which says how many devices there are.
import jax  # isort: skip

from crisalad_jax.nn.config import PRESETS
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.trainable import shards_batch

KINDS: dict[str, tuple[str, str]] = {
    # By the name of an operation, and the JAX operation it was compiled from.
    "between devices": (r"all-|collective|reduce-scatter", ""),
    "attention's products": (
        r"dot|gemm|cublas|cudnn|onednn|ynn|custom-call",
        r"(h\.\.\.|\.\.\.h)[ij]",
    ),
    "other products": (r"dot|gemm|cublas|cudnn|onednn|ynn|convolution|custom-call", ""),
    "constants written": (r"(wrapped_)?broadcast(_fusion)?(\.|$)", ""),
    "copies": (
        r"(wrapped_)?((copy|transpose|bitcast|concatenate|pad|[a-z-]*slice)_?)+(fusion)?(\.|$)",
        "",
    ),
    "numbers one by one, sums": ("", ""),
}
"""Pairs of regular expressions; an operation is of the first kind whose expressions both match."""
NOTHING = "nothing"
SECONDS = 1
WITHIN = re.compile(r"(while|call|cond|conditional)(\.|$)")
"""Operations that only contain others."""
INSTRUCTION = re.compile(
    r"^\s*(?:ROOT )?%?([\w.\-]+) = .*?(?:op_name=\"([^\"]*)\"|$)", re.MULTILINE
)


def kind(name: str, made_of: str) -> str:
    return next(
        kind
        for kind, (named, made) in KINDS.items()
        if re.match(named, name) and re.search(made, made_of)
    )


def milliseconds(events: Iterable[Mapping[str, Any]], program: str) -> dict[str, float]:
    """Sum a trace's milliseconds by kind, for the operations of `program` (XLA's compiled text)."""
    made_of = dict(INSTRUCTION.findall(program))
    found: dict[str, float] = dict.fromkeys(KINDS, 0.0)
    for event in events:
        name = event.get("name", "")
        if event.get("ph") == "X" and name in made_of and not WITHIN.match(name):
            found[kind(name, made_of[name])] += event["dur"] / 1e3
    return found


def traced(contender: Contender) -> dict[str, float]:
    """Measure shares of the time of all devices by kind, and the share in which they are idle."""
    contender.call()
    with tempfile.TemporaryDirectory(prefix="bench-profile-") as folder:
        with jax.profiler.trace(folder):
            wall, started = 0.0, time.perf_counter()
            while wall < 1e3 * SECONDS:
                contender.call()
                wall = 1e3 * (time.perf_counter() - started)
        (path,) = pathlib.Path(folder).glob("**/*.trace.json.gz")
        events = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    found = milliseconds(events, contender.program())
    if not any(found.values()):
        raise RuntimeError(f"{contender.name}: found no operation of its program in the trace")
    total = contender.devices * wall
    shares = {kind: spent / total for kind, spent in found.items()}
    # A device may do two things at once, so the kinds may sum to more than all of the time.
    return shares | {NOTHING: max(0.0, 1 - sum(shares.values()))}


def stacked(values: list[dict[str, Any]]) -> Figure:
    figure, (axes,) = panels(1, ("Where the time goes",), width=9)
    names = [f"{value['model']}, {value['program']}" for value in values]
    begin = [0.0] * len(values)
    for kind, colour in zip((*KINDS, NOTHING), COLOURS, strict=True):
        widths = [100 * value["shares"][kind] for value in values]
        axes.barh(names, widths, left=begin, color=colour, label=kind)
        begin = [a + b for a, b in zip(begin, widths, strict=True)]
    axes.invert_yaxis()
    axes.grid(visible=False)
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of the time of all devices", fontsize=9)
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False, fontsize=8)
    return figure


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--presets", nargs="+", default=["tiny", "s14", "b14"], choices=PRESETS)
    parser.add_argument("--batch", type=count, default=8)
    arguments = read(parser, "bench_profile")
    values, rows = [], []
    for preset in arguments.presets:
        config = recipe(preset)
        both = sides(config.model, preset, arguments.batch, "float32")
        spread = len(jax.local_devices()) > 1
        programs = {
            "descriptors": by_us(both, spread),
            "training step": our_step(both, config, spread and shards_batch(config.trainable)),
        }
        for name, contender in programs.items():
            shares = traced(contender)
            model = title(preset, config.model)
            values.append({"model": model, "program": name, "shares": shares})
            rows.append((model, name, *(f"{100 * share:.0f} %" for share in shares.values())))
    caption = f"Shares of the time of all devices, {arguments.batch} images, float32, {machine()}."
    table = Table(("model", "program", *KINDS, NOTHING), rows, caption, 2)
    leave("bench_profile", Study(table, values, stacked(values)), arguments)


if __name__ == "__main__":
    main()
