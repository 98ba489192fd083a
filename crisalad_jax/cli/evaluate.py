"""`crisalad evaluate`."""

import dataclasses
import pathlib
import re
from typing import Literal

import numpy as np
from jaxtyping import Float

from crisalad_jax.checkpoint import load_weights
from crisalad_jax.cli.common import console, grouping_words, model_of
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import evaluate, same_place_rule
from crisalad_jax.files import check_target, write_json
from crisalad_jax.groupings import DEFAULT_GROUPINGS, Grouping, check_grouping, parse_groupings
from crisalad_jax.pca import load_pca
from crisalad_jax.reranking import parse_reranking
from crisalad_jax.results import GroupingResult, grouping_table, to_json
from crisalad_jax.serial import to_plain
from crisalad_jax.similarity import similarity_map

_RECALLS = (
    "Percent of all queries; below it, 95 % by bootstrap over queries as if they were independent. "
    "AP: area under precision and recall of the first retrievals, by similarity. R at 100 % P: of "
    "the queries with a positive, the share retrieved rightly, above every wrong first retrieval."
)


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Print what a model recalls of an evaluation set under each grouping, and what these leak."""

    data: pathlib.Path
    """Evaluation set in any layout of docs/datasets.md: @UTM names, VPR-Bench, raw MSLS, two plain
    folders; a .mat file of NetVLAD; .npy lists of SALAD."""
    weights: pathlib.Path | None = None
    """A .safetensors file of this package; none evaluates an untrained model of --preset."""
    preset: str = "b14"
    """Model to start untrained where there are no weights."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    grouping: str = ",".join(DEFAULT_GROUPINGS)
    """Comma-separated: single, shuffled, sequential, window (an image with those just before it,
    --batch-size in all); QUERIES/DATABASE groups the two sides apart."""
    batch_size: int = 16
    """Images that a cross-image encoder sees together (the paper: 16)."""
    split: str | None = None
    """train, val or test, where the set has several."""
    layout: str | None = None
    """utm, vpr-bench, netvlad, salad, msls, msls-subtask or folders; by default what DATA looks
    like (msls-subtask, the 740 queries of raw MSLS, only by name)."""
    images: pathlib.Path | None = None
    """Folder of the images that a .mat file or .npy lists name; by default beside them."""
    queries: str | None = None
    """Folder of the queries, where @UTM sets have several: queries_night of SVOX; by default
    queries."""
    radius: float | None = None
    """Largest distance of a positive in metres; by default 25, or what a .mat file says."""
    max_heading_difference: float | None = None
    """Largest difference of compass angles of a positive in degrees, for raw MSLS; by default any
    (the paper: 40)."""
    frames: int | None = None
    """How many frames a positive may be away, for two plain folders of the same moments."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""
    rerank: str | None = None
    """NAME:TOPK puts the first TOPK retrievals in a new order by local features: patch-netvlad, of
    a model with NetVLAD, or transvpr (docs/methods.md). Adds a row to each of the table."""
    rerank_weights: pathlib.Path | None = None
    """Model that makes these features; by default the first stage's."""
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's; docs/performance.md shows what bfloat16
    gains and loses."""
    seed: int = 0
    """Draws the first shuffled order, and untrained weights."""
    seeds: int = 3
    """Shuffled orders: their mean and standard deviation are printed."""
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
    groupings = parse_groupings(arguments.grouping.split(","))
    if arguments.json is not None:
        check_target(arguments.json)
    if arguments.out is not None:
        check_target(arguments.out / "config.json")
    if arguments.report is not None:
        check_target(arguments.report / "index.html")
    check_grouping((), arguments.batch_size, arguments.seed, arguments.seeds)
    rerank = None if arguments.rerank is None else parse_reranking(arguments.rerank)
    if rerank is None and arguments.rerank_weights is not None:
        raise InputError(
            "rerank-weights: found without --rerank, expected both, as in --rerank transvpr:100"
        )
    params, config, model_name = model_of(
        arguments.weights,
        preset=arguments.preset,
        seed=arguments.seed,
        image_size=arguments.image_size,
        compute_dtype=arguments.compute_dtype,
    )
    if rerank is not None and arguments.rerank_weights is not None:
        own_params, own_config = load_weights(arguments.rerank_weights)
        rerank = dataclasses.replace(rerank, params=own_params, config=own_config)
    if rerank is not None:
        rerank.check(config)
    pca = None if arguments.pca is None else load_pca(arguments.pca)
    benchmark = open_benchmark(
        arguments.data,
        arguments.split,
        arguments.radius,
        images=arguments.images,
        max_heading_difference=arguments.max_heading_difference,
        frames=arguments.frames,
        queries=arguments.queries,
        layout=arguments.layout,
    )
    if rerank is not None:
        rerank.check(config, len(benchmark.database))
    console.print(
        f"{benchmark.name}: {len(benchmark.queries)} queries, {len(benchmark.database)} database "
        f"images; positive: {benchmark.rule}\n{model_name}",
        soft_wrap=True,
    )
    seen = _FirstSimilarities()
    results = evaluate(
        params,
        config,
        benchmark,
        groupings=list(map(str, groupings)),
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        seeds=arguments.seeds,
        pca=pca,
        observe=None if arguments.report is None else seen,
        rerank=rerank,
        quiet=arguments.quiet,
    )
    console.print(grouping_table(results))
    same_place = same_place_rule(benchmark)
    notes = [_RECALLS]
    if params.encoder is None:
        notes.append("No cross-image encoder: no descriptor depends on its batch.")
    else:
        notes += _notes(arguments, groupings, same_place)
    if rerank is not None:
        notes.append(
            f"+ {rerank.label}: the first {rerank.top} retrievals by its scores, which stand for "
            "similarities in AP and R at 100 % P."
        )
    for note in notes:
        console.print(note, soft_wrap=True)
    resolved = {
        "weights": None if arguments.weights is None else str(arguments.weights),
        "benchmark": benchmark.name,
        "rule": benchmark.rule,
        "same_place": same_place,
        "batch_size": arguments.batch_size,
        "seed": arguments.seed,
        "seeds": arguments.seeds,
        "pca": None if arguments.pca is None else str(arguments.pca),
        "rerank": arguments.rerank,
        "rerank_weights": None
        if arguments.rerank_weights is None
        else str(arguments.rerank_weights),
        "model": to_plain(config),
    }
    if arguments.json is not None:
        table = [
            {"benchmark": benchmark.name, "model": model_name} | to_json(result)
            for result in results
        ]
        write_json(arguments.json, resolved | {"results": table})
    if arguments.out is not None:
        _write_galleries(arguments.out, benchmark, model_name, results)
        write_json(arguments.out / "config.json", resolved)
    if arguments.report is not None:
        from crisalad_jax.report import write_report

        page = write_report(
            arguments.report,
            benchmark,
            results,
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


def _notes(arguments: Evaluate, groupings: list[Grouping], same_place: str) -> list[str]:
    """What the table's groupings are."""
    kinds = dict.fromkeys(kind for each in groupings for kind in (each.queries, each.database))
    notes = [
        "A descriptor of this model depends on the images in its batch of "
        f"{arguments.batch_size}: {grouping_words(kinds)}. Same place: of the others in sight, "
        f"those that show the image's own place, told by {same_place}."
    ]
    if "shuffled" in kinds and arguments.seeds > 1:
        notes.append(
            f"Shuffled: mean of {arguments.seeds} seeds ± their standard deviation; the interval "
            "is of the mean."
        )
    return notes


def _write_galleries(
    out: pathlib.Path, benchmark: Benchmark, model_name: str, results: list[GroupingResult]
) -> None:
    from crisalad_jax.report import prediction_gallery

    for result in results:
        prediction_gallery(
            out / f"gallery_{re.sub(r'[/:]', '-', result.label).replace(' + ', '_')}.png",
            benchmark.queries,
            benchmark.database,
            *result.neighbours,
            benchmark.ground_truth(),
            title=f"{benchmark.name}, {model_name}, {result.label}",
        )
