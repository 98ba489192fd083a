"""Measure how time and memory grow with batch, image and clusters, compared with torch.

    python scripts/bench/bench_scale.py [--out docs/performance]
        [--preset s14] [--rounds 3]

One of the three grows at a time; the others stay at 4 images of 224 x 224 with 64 clusters
(clusters grow at 322 x 322, which has enough patches for 256). Time and operations are per image,
relative to the smallest value of what grows. Ours runs on one device with all cores, like torch.
Nothing here should grow faster than the operations.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from bench_describe import TOLERANCES, by_torch, by_us, check, sides
from matplotlib.figure import Figure
from tables import COLOURS, GREY, Study, Table, count, flags, leave, panels, read
from timing import Timed, machine, megabytes, race, ratio, times

from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.costs import part_costs

IMAGES, SIZE, WIDE = 4, 224, 322
BATCHES, SIZES, CLUSTERS = (1, 4, 16, 64), (224, 322, 420, 518), (16, 64, 128, 256)


class Point(NamedTuple):
    grows: str
    value: int
    batch: int
    config: ModelConfig


def points(preset: str) -> Iterator[Point]:
    config = PRESETS[preset]
    head = config.aggregator
    assert isinstance(head, SaladConfig)  # the flag accepts only such presets

    def at(size: int, clusters: int = head.clusters) -> ModelConfig:
        aggregator = dataclasses.replace(head, clusters=clusters)
        return dataclasses.replace(config, image_size=(size, size), aggregator=aggregator)

    yield from (Point("images in a batch", n, n, at(SIZE)) for n in BATCHES)
    yield from (Point("pixels a side", n, IMAGES, at(n)) for n in SIZES)
    yield from (Point("clusters", n, IMAGES, at(WIDE, n)) for n in CLUSTERS)


def measure(points: Sequence[Point], rounds: int) -> Iterator[dict[str, Any]]:
    """Time ours and torch's at all points in turn, so that other load slows all of them equally."""
    found = []
    for point in points:
        both = sides(point.config, point.grows, point.batch, "float32")
        found.append((by_us(both, False), by_torch(both, False)))
        check(found[-1], TOLERANCES["float32"])
    calls = {(i, one.name): one.call for i, pair in enumerate(found) for one in pair}
    timed = race(calls, rounds, 1)
    for number, (point, (ours, theirs)) in enumerate(zip(points, found, strict=True)):
        mine, others = (timed[number, one.name] for one in (ours, theirs))
        macs = sum(cost.macs for cost in part_costs(point.config, images=point.batch))
        yield {
            "grows": point.grows,
            "value": point.value,
            "operations": 2 * macs,
            "ours": [ms / point.batch for ms in mine.rounds],
            "theirs": [ms / point.batch for ms in others.rounds],
            "faster": ratio(others, mine),
            "memory": ours.memory(),
            "their memory": theirs.memory(),
        }


def grown(values: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add how much each value has grown relative to the first of its kind."""
    first = {value["grows"]: value for value in reversed(values)}
    found = []
    for value in values:
        least = first[value["grows"]]
        of = {"operations": value["operations"] / least["operations"]}
        for name in ("ours", "theirs"):
            of[name] = Timed(value[name]).median / Timed(least[name]).median
        found.append({**value, "grown": of})
    return found


def table(values: list[dict[str, Any]], caption: str) -> Table:
    header = (
        *("what grows", "to", "operations per image", "our time per image", "torch's"),
        *("our speedup over torch", "our memory, MB", "torch's, MB"),
    )
    rows = []
    for value in values:
        of = value["grown"]
        sizes = megabytes(value["memory"]), megabytes(value["their memory"])
        growth = (f"{of[name]:.2f}" for name in ("operations", "ours", "theirs"))
        rows.append((value["grows"], f"{value['value']}", *growth, times(value["faster"]), *sizes))
    return Table(header, rows, caption)


def draw(values: list[dict[str, Any]]) -> Figure:
    kinds = list(dict.fromkeys(value["grows"] for value in values))
    figure, axes = panels(len(kinds), tuple(kinds), width=3.2, height=2.9, sharey=False)
    lines = {"operations": (GREY, "--"), "ours": (COLOURS[0], "-"), "theirs": (COLOURS[1], "-")}
    names = {"operations": "operations", "ours": "time, ours", "theirs": "time, torch"}
    for one, kind in zip(axes, kinds, strict=True):
        chosen = [value for value in values if value["grows"] == kind]
        sizes = [value["value"] for value in chosen]
        for name, (colour, dashes) in lines.items():
            heights = [value["grown"][name] for value in chosen]
            one.plot(sizes, heights, dashes, color=colour, marker=".", label=names[name])
        one.set_xscale("log")
        one.set_xticks(sizes, [str(size) for size in sizes])
        one.minorticks_off()
        one.set_ylim(0, 1.15 * max(max(value["grown"].values()) for value in chosen))
    axes[0].set_ylabel("of one image, over the least", fontsize=9)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    return figure


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    with_salad = [n for n, each in PRESETS.items() if isinstance(each.aggregator, SaladConfig)]
    parser.add_argument("--preset", choices=with_salad, default="s14")
    parser.add_argument("--rounds", type=count, default=3)
    arguments = read(parser, "bench_scale")
    together = itertools.groupby(points(arguments.preset), lambda point: point.grows)
    values = [each for _, some in together for each in measure([*some], arguments.rounds)]
    values = grown(values)
    caption = (
        f"`{arguments.preset}` in float32, time and operations per image relative to the smallest "
        f"size, on one device: {machine()}; medians and ranges of {arguments.rounds} rounds."
    )
    leave("bench_scale", Study(table(values, caption), values, draw(values)), arguments)


if __name__ == "__main__":
    main()
