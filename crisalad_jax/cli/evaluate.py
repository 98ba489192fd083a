"""`crisalad evaluate`."""

import dataclasses
import pathlib
from typing import Literal

import numpy as np
from jaxtyping import Float

from crisalad_jax.cli.common import console, grouping_words, model_of
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.evaluation import GROUPINGS, check_grouping, evaluate
from crisalad_jax.files import check_target, write_json
from crisalad_jax.retrieval import similarity_map
from crisalad_jax.serial import to_plain


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Print Recall@1/5/10/20 of a model on an evaluation set, under each grouping of the images."""

    data: pathlib.Path
    """Evaluation set: a folder of @UTM names, or VPR-Bench's layout."""
    weights: pathlib.Path | None = None
    """A .safetensors file of this package; none evaluates an untrained model of --preset."""
    preset: str = "b14"
    """Model to start untrained where there are no weights."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    grouping: str = ",".join(GROUPINGS)
    """Comma-separated: single, shuffled, sequential."""
    batch_size: int = 16
    """Images that a cross-image encoder sees together (the paper: 16)."""
    split: str | None = None
    """train, val or test, where the set has several."""
    radius: float = 25.0
    """Largest distance of a positive in metres, for @UTM names."""
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's; docs/performance.md shows what bfloat16
    gains and loses."""
    seed: int = 0
    """Draws the shuffled order, and untrained weights."""
    out: pathlib.Path | None = None
    """Folder for a gallery of retrievals and the resolved configuration."""
    report: pathlib.Path | None = None
    """Folder for a page of all results, index.html, that needs no other file and no network; and
    its pictures."""
    json: pathlib.Path | None = None
    """File for the table as JSON."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Evaluate) -> None:
    """Evaluate, print the table, and write what is asked for."""
    from crisalad_jax.report import RecallRow, prediction_gallery, recall_table

    groupings = list(dict.fromkeys(arguments.grouping.split(",")))
    if arguments.json is not None:
        check_target(arguments.json)
    if arguments.out is not None:
        check_target(arguments.out / "config.json")
    if arguments.report is not None:
        check_target(arguments.report / "index.html")
    check_grouping(groupings, arguments.batch_size, arguments.seed)
    params, config, model_name = model_of(
        arguments.weights,
        preset=arguments.preset,
        seed=arguments.seed,
        image_size=arguments.image_size,
        compute_dtype=arguments.compute_dtype,
    )
    benchmark = open_benchmark(arguments.data, arguments.split, arguments.radius)
    console.print(
        f"{benchmark.name}: {len(benchmark.queries)} queries, {len(benchmark.database)} database "
        f"images; positive: {benchmark.rule}",
        soft_wrap=True,
    )
    seen = _FirstSimilarities()
    results = evaluate(
        params,
        config,
        benchmark,
        groupings=groupings,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        observe=None if arguments.report is None else seen,
        quiet=arguments.quiet,
    )
    rows = [RecallRow(benchmark.name, model_name, r.grouping, r.recalls) for r in results]
    console.print(recall_table(rows))
    if params.encoder is None:
        console.print("No cross-image encoder: no descriptor depends on its batch.")
    else:
        console.print(
            "A descriptor of this model depends on the images in its batch of "
            f"{arguments.batch_size}: {grouping_words(groupings)}.",
            soft_wrap=True,
        )
    resolved = {
        "weights": None if arguments.weights is None else str(arguments.weights),
        "benchmark": benchmark.name,
        "rule": benchmark.rule,
        "batch_size": arguments.batch_size,
        "seed": arguments.seed,
        "model": to_plain(config),
    }
    if arguments.json is not None:
        table = [
            row._asdict() | {"recalls": {f"R@{k}": v for k, v in row.recalls.items()}}
            for row in rows
        ]
        write_json(arguments.json, resolved | {"results": table})
    if arguments.out is not None:
        write_json(arguments.out / "config.json", resolved)
        for result in results:
            prediction_gallery(
                arguments.out / f"gallery_{result.grouping}.png",
                benchmark.queries,
                benchmark.database,
                *result.neighbours,
                benchmark.positives,
                title=f"{benchmark.name}, {model_name}, {result.grouping}",
            )
    if arguments.report is not None:
        from crisalad_jax.report import ReportGrouping, write_report

        page = write_report(
            arguments.report,
            benchmark,
            [ReportGrouping(*result, meaning=GROUPINGS.get(result.grouping)) for result in results],
            params=params,
            config=config,
            model_name=model_name,
            settings=resolved,
            similarities=seen.map,
        )
        console.print(f"report: {page}", soft_wrap=True)


class _FirstSimilarities:
    """Keeps a picture of the similarities under the first grouping, of which the report is."""

    map: Float[np.ndarray, "rows columns"] | None = None

    def __call__(
        self,
        grouping: str,
        database: Float[np.ndarray, "image descriptor"],
        queries: Float[np.ndarray, "image descriptor"],
    ) -> None:
        if self.map is None:
            self.map = similarity_map(database, queries)
