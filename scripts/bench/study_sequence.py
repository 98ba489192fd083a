"""Measure the gain of a filter over consecutive frames compared with single frames.

    python scripts/bench/study_sequence.py --data SET ... --weights W.safetensors ... --out OUT

Each SET is one that `crisalad evaluate` reads, with database and queries in the order of the
camera's path. `--frames N` and `--layout folders` are for two plain folders of the same moments.
`--street` adds a rendered street: 16 places of 8 frames, 2 m apart, once at noon in summer and once
at dusk in autumn. Every model describes images independently; HOG needs no weights.
"""

import argparse
import pathlib
from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float
from tables import Study, Table, flags, leave, read

from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.metrics import recalls
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.synthetic import View, render

FILTERS = {
    "filter, no adapt": BayesFilter(adapt=False),
    "filter": BayesFilter(),
    "reach 1": BayesFilter(reach=1),
    "reach 4": BayesFilter(reach=4),
    "sharpness 1": BayesFilter(sharpness=1),
    "sharpness 4": BayesFilter(sharpness=4),
}
"""The filter with its defaults, and with one setting changed."""

Sides = tuple[Float[np.ndarray, "database d"], Float[np.ndarray, "query d"]]


def write_street(root: pathlib.Path) -> pathlib.Path:
    """Render two passes through streets, as two folders of frames of the same moments."""
    passes = {
        "database": (View(season="summer", noise=2.0, seed=7), 0.0),
        "queries": (
            View(season="autumn", time="dusk", weather="overcast", noise=2.0, seed=7),
            0.8,
        ),
    }
    for side, (view, lateral) in passes.items():
        (root / side).mkdir(parents=True, exist_ok=True)
        draw = np.random.default_rng(len(side))
        for number in range(16 * 8):
            place, frame = divmod(number, 8)
            moved = View(
                **vars(view)
                | {
                    "lateral": lateral + float(draw.normal(0, 0.3)),
                    "forward": 2.0 * frame - 7,
                    "heading": float(draw.normal(0, 2)),
                    "occluders": int(draw.integers(2**31)),
                }
            )
            picture = render(10_000 + place, moved)
            cv2.imwrite(str(root / side / f"{number:04d}.png"), picture[..., ::-1])
    return root


def descriptors(benchmark: Benchmark, weights: list[pathlib.Path]) -> Iterator[tuple[str, Sides]]:
    """Yield each model's name and descriptors of the database and of the queries."""
    for file in (pathlib.Path("hog"), *weights):
        params, config = load(file)
        found: list[Sides] = []
        evaluate(
            Model(params, config),
            benchmark,
            groupings=["single"],
            observe=lambda _, database, queries, to=found: to.append((database, queries)),
        )
        hog = file == pathlib.Path("hog")
        yield "HOG, no learning" if hog else f"{file.parent.name}/{file.name}", found[0]


SURE = 0.4
"""Share of frames that counts as the surest: those most similar to an image of the map."""


def measure(benchmark: Benchmark, sides: Sides) -> dict[str, float]:
    """Compute Recall@1 in percent of single frames and of each filter, and of the surest frames."""
    database, queries = sides
    similarities, common = queries @ database.T, database @ database.mean(axis=0)
    best = {"single frames": similarities.argmax(axis=1)}
    best |= {name: each.follow(similarities, common).places for name, each in FILTERS.items()}
    best["reversed"] = FILTERS["filter"].follow(similarities[::-1], common).places[::-1]
    truth = benchmark.ground_truth()
    found = {name: 100 * recalls(one[:, None], truth, (1,))[1] for name, one in best.items()}
    surest = np.argsort(-similarities.max(axis=1), kind="stable")[: round(SURE * len(queries))]
    for name in ("single frames", "filter"):
        right = recalls(best[name][surest, None], [truth[i] for i in surest], (1,))[1]
        found[f"{name}, surest"] = 100 * right
    return found


def study(benchmarks: list[Benchmark], weights: list[pathlib.Path]) -> Study:
    """Measure all models on all sets."""
    rows, values = [], []
    columns = ["single frames", "filter", "gain", "reversed"]
    columns += ["single frames, surest", "filter, surest"]
    columns += [name for name in FILTERS if name != "filter"]
    for benchmark in benchmarks:
        for model, sides in descriptors(benchmark, weights):
            found = measure(benchmark, sides)
            values.append({"set": benchmark.name, "model": model, "R@1": found})
            gain = f"{found['filter'] - found['single frames']:+.1f}"
            cells = {name: f"{each:.1f}" for name, each in found.items()}
            name = f"{benchmark.root.name}, {len(benchmark.queries)} frames"
            rows.append((name, model, *(gain if c == "gain" else cells[c] for c in columns)))
    caption = (
        "Recall@1 in percent: single frames, the filter with its defaults, and the gain; "
        "reversed: the filter, from the last frame to the first; "
        f"surest: the {100 * SURE:.0f} % of frames that are most similar to an image of the map; "
        "then the filter with one setting changed."
    )
    return Study(Table(("set", "model", *columns), rows, caption, 2), values)


def main() -> None:
    parser = flags("Measure and tabulate; see the module docstring.", "docs/maps")
    parser.add_argument("--data", type=pathlib.Path, nargs="*", default=[], help="sets of frames")
    parser.add_argument("--layout", help="layout of all sets in --data, as in crisalad evaluate")
    parser.add_argument("--frames", type=int, help="largest distance of a positive in frames")
    parser.add_argument("--street", type=pathlib.Path, help="folder for a rendered street")
    parser.add_argument("--weights", type=pathlib.Path, nargs="*", default=[], help="models")
    arguments: argparse.Namespace = read(parser, "sequence")
    benchmarks = [
        open_benchmark(each, layout=arguments.layout, frames=arguments.frames)
        for each in arguments.data
    ]
    if arguments.street is not None:
        street = write_street(arguments.street)
        benchmarks.append(open_benchmark(street, layout="folders", frames=1))
    leave("sequence", study(benchmarks, arguments.weights), arguments)


if __name__ == "__main__":
    main()
