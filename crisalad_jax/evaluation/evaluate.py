"""Evaluation of a model on a benchmark, under each protocol of grouping images."""

import contextlib
import functools
import pathlib
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import takes
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.loader import ImageCache, OnBadImage
from crisalad_jax.evaluation.leakage import SamePlace, by_truth, near, same_place_share
from crisalad_jax.evaluation.operating_point import check_precision
from crisalad_jax.evaluation.results import ANY, GroupingResult, Skipped, summarise
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.describe import FolderTokens, group, read_tokens
from crisalad_jax.retrieval.grouping import (
    DEFAULT_GROUPINGS,
    Grouping,
    batches_of,
    check_grouping,
    parse_groupings,
    useful_batch_size,
)
from crisalad_jax.retrieval.model import Model, check_groupings, check_params
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.retrieval.reranking import Reranker, Reranking
from crisalad_jax.retrieval.search import search, to_unit_vectors
from crisalad_jax.utils.errors import InputError

KS = (1, 5, 10, 20)

Observe = Callable[
    [str, Float[np.ndarray, "image descriptor"], Float[np.ndarray, "image descriptor"]], None
]
"""Takes the name of a grouping, the database's descriptors, and the queries' descriptors."""


@takes(config=ModelConfig, benchmark=Benchmark)
def evaluate(
    params: Model,
    config: ModelConfig,
    benchmark: Benchmark,
    *,
    groupings: Sequence[str] = DEFAULT_GROUPINGS,
    batch_size: int = 16,
    seed: int = 0,
    seeds: int = 3,
    pca: Pca | None = None,
    cache: ImageCache | None = None,
    observe: Observe | None = None,
    rerank: Reranking | None = None,
    on_bad_image: OnBadImage = "stop",
    precision: float | None = None,
    quiet: bool = False,
) -> list[GroupingResult]:
    r"""Measure Recall@1/5/10/20 and more under each grouping; images are read and tokenised once.

    Two images of one side show the same place if the benchmark's positions say so. A benchmark
    without positions uses its ground truth (`evaluation.leakage`).

    A model without a cross-image encoder has one grouping, `any`: no descriptor depends on a batch.
    Memory holds the tokens of all images, and the descriptors of one grouping and seed at a time.

    Args:
        params: of the model.
        config: of the model, static.
        benchmark: what to evaluate on.
        groupings: each as `Grouping.parse` reads it.
        batch_size: images that look at each other.
        seed: draws the first shuffle: the database's, and with the next seed the queries'.
        seeds: shuffles, each from the second seed after the one before.
        pca: shortens the descriptors, fitted to images of other places.
        cache: of decoded images.
        observe: is given the descriptors of each grouping, of its first seed, while they are there.
        rerank: a second stage; each grouping has a result without and then one with it.
        on_bad_image: "stop" at an unreadable image, or "skip" it: the results are then of the set
            without it (`GroupingResult.skipped`).
        precision: asks each result for its `operating_point`: the similarity from which first
            retrievals are right with this precision, and the recall that is left.
        quiet: no progress bars.

    Returns:
        A result for each grouping, and with `rerank` a second one.

    Raises:
        InputError: parameters of another configuration, no ground truth, an image cannot be read
            or none of a side, components that are not for this model or make no unit vectors, such
            a precision, or what `parse_groupings`, `check_grouping`, `Reranking.check` and
            `Reranker` raise.

    Example:
        >>> import jax, shutil
        >>> from crisalad_jax import PRESETS, init_crisalad, open_benchmark
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> lines = ["query,database", *(f"{number}.png,{number}.png" for number in range(4))]
        >>> _ = (folder / "set" / "ground_truth.csv").write_text("\n".join(lines))
        >>> benchmark = open_benchmark(folder / "set", layout="folders")
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> result, *_ = evaluate(params, config, benchmark, groupings=["single"], quiet=True)
        >>> result.recalls[1]
        1.0
    """
    parsed = parse_groupings(groupings)
    check_grouping((), batch_size, seed, seeds)
    if precision is not None:
        check_precision(precision)
    if pca is not None:
        pca.check(config.descriptor_dim, "model")
    if rerank is not None:
        rerank.check(config, len(benchmark.database))
    check_params(params, config)
    check_groupings(params, config, groupings)
    if rerank is not None and rerank.params is None and isinstance(params, Runtime):
        raise InputError(
            f"rerank: found with a model in {params.engine}, expected weights of its own beside it "
            "(--rerank-weights)"
        )
    unit = config.unit_length if pca is None else pca.config.renormalise
    benchmark.ground_truth()
    images = max(len(benchmark.database), len(benchmark.queries))
    batch_size = useful_batch_size(batch_size, images)

    def read(name: str, paths: Sequence[pathlib.Path]) -> FolderTokens:
        return read_tokens(
            params,
            config,
            paths,
            batch_size=batch_size,
            label=name,
            on_bad_image=on_bad_image,
            cache=cache,
            quiet=quiet,
        )

    tokens_there = read("database", benchmark.database)
    tokens_asked = read("queries", benchmark.queries)
    skipped = Skipped(*map(_unreadable, (tokens_asked, tokens_there)))
    benchmark = skipped.rest_of(benchmark)
    positives = benchmark.ground_truth()
    same_queries, same_database = _same_place(benchmark, positives)
    database = _Side("database", _readable(tokens_there), same_database, 0)
    queries = _Side("queries", _readable(tokens_asked), same_queries, 1)

    def describe(*side: Any, **options: Any) -> Float[np.ndarray, "image descriptor"]:
        full = group(params, config, *side, batch_size=batch_size, quiet=quiet, **options)
        return full if pca is None else pca.apply(full)

    stages: dict[str | None, Callable[[Neighbours], Neighbours]] = {None: lambda ranked: ranked}
    with contextlib.ExitStack() as stack:
        if rerank is not None:
            stages[rerank.label] = stack.enter_context(
                Reranker(
                    rerank if isinstance(params, Runtime) else rerank.over(params, config),
                    benchmark.database,
                    benchmark.queries,
                    batch_size=batch_size,
                    cache=cache,
                    quiet=quiet,
                )
            )
        k = min(max(*KS, rerank.top if rerank else 0), len(benchmark.database))
        results = []
        for grouping in parsed if config.cross_image.layers else [Grouping("single", "single")]:
            is_random = "shuffled" in (grouping.queries, grouping.database)
            drawn = [seed + 2 * number for number in range(seeds if is_random else 1)]
            name = str(grouping) if config.cross_image.layers else ANY
            sides = (database, grouping.database), (queries, grouping.queries)
            database_share, query_share = (
                _mean_share(side, kind, drawn, batch_size) for side, kind in sides
            )
            observer = observe and functools.partial(observe, name)
            rankings = _rank(describe, sides, drawn, k, observer, unit=unit)
            for label, stage in stages.items():
                ranked = {seed: _first(stage(each), max(KS)) for seed, each in rankings.items()}
                results.append(
                    summarise(
                        name,
                        ranked,
                        positives,
                        KS,
                        query_share=query_share,
                        database_share=database_share,
                        is_random=is_random,
                        rerank=label,
                        skipped=skipped,
                        precision=precision,
                    )
                )
    return results


def _unreadable(tokens: FolderTokens) -> tuple[int, ...]:
    return tuple(np.flatnonzero(~tokens.readable).tolist())


def _readable(tokens: FolderTokens) -> FolderTokens:
    """Return the tokens of the images that could be read."""
    if tokens.readable.all():
        return tokens
    return FolderTokens(*(leaf[tokens.readable] for leaf in tokens))


def _first(neighbours: Neighbours, count: int) -> Neighbours:
    """Return the best `count` neighbours of each query."""
    return Neighbours(*(part[:, :count] for part in neighbours))


class _Side(NamedTuple):
    """One side, database or queries: its tokens and its test of same-place images."""

    name: str
    tokens: FolderTokens
    same: SamePlace
    offset: int
    """Added to the seed of a shuffle, so that the two sides are never shuffled alike."""


def same_place_rule(benchmark: Benchmark) -> str:
    """Tell in words how `evaluate` decides that two images of a side show the same place."""
    if benchmark.query_positions is None or benchmark.database_positions is None:
        return "a common positive"
    return f"a distance of at most {benchmark.radius:g} m"


def _same_place(
    benchmark: Benchmark, positives: Sequence[Int64[np.ndarray, " _"]]
) -> tuple[SamePlace, SamePlace]:
    """Make both sides' tests of same-place images, by positions or else by ground truth."""
    if benchmark.query_positions is None or benchmark.database_positions is None:
        return by_truth(positives, len(benchmark.database))
    radius = benchmark.radius
    return near(benchmark.query_positions, radius), near(benchmark.database_positions, radius)


def _mean_share(side: _Side, kind: str, seeds: Sequence[int], batch_size: int) -> float | None:
    """Average the share of same-place images over seeds; see `GroupingResult`."""
    count = len(side.tokens.readable)
    shares = [
        same_place_share(batches_of(count, kind, batch_size, seed + side.offset), side.same)
        for seed in (seeds if kind == "shuffled" else seeds[:1])
    ]
    known = [share for share in shares if share is not None]
    return statistics.fmean(known) if known else None


def _rank(
    describe: Callable[..., Float[np.ndarray, "image descriptor"]],
    sides: Sequence[tuple[_Side, str]],
    seeds: Sequence[int],
    k: int,
    observe: Callable[..., None] | None,
    *,
    unit: bool,
) -> dict[int, Neighbours]:
    """Rank the k nearest neighbours for each seed; only shuffled sides are described anew.

    `observe` is given the descriptors of the first seed. Those that are not `unit` vectors are
    ranked by Euclidean distance.
    """

    def descriptors(side: _Side, kind: str, seed: int) -> Float[np.ndarray, "image descriptor"]:
        return describe(side.tokens, kind, seed=seed + side.offset, label=side.name)

    fixed = {
        side.name: descriptors(side, kind, seeds[0]) for side, kind in sides if kind != "shuffled"
    }

    def ranking(seed: int) -> Neighbours:
        database, queries = (
            fixed[side.name] if side.name in fixed else descriptors(side, kind, seed)
            for side, kind in sides
        )
        if observe is not None and seed == seeds[0]:
            observe(database, queries)
        if not unit:
            database, queries = to_unit_vectors(database, queries)
        return search(database, queries, k=k)

    return {seed: ranking(seed) for seed in seeds}
