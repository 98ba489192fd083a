"""Evaluation of a model on a benchmark, under each protocol of grouping images."""

import contextlib
import dataclasses
import functools
import statistics
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int64

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import check_count, check_seed, takes
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.leakage import (
    SamePlace,
    by_truth,
    masked,
    mirrored_share,
    near,
    same_place_share,
)
from crisalad_jax.evaluation.operating_point import check_precision
from crisalad_jax.evaluation.protocols import check_groupings, groupings_of
from crisalad_jax.evaluation.results import ANY, GroupingResult, Skipped, over_single, summarise
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.bits import check_packable, pack_bits, sign_vectors
from crisalad_jax.retrieval.chunks import Descriptors
from crisalad_jax.retrieval.describe import TokenSet
from crisalad_jax.retrieval.describer import Describer, describer_of
from crisalad_jax.retrieval.grouping import DEFAULT_GROUPINGS, MASKED, Batches, Grouping
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.pca import Pca, shortened
from crisalad_jax.retrieval.reranking import Reranking
from crisalad_jax.retrieval.search import search, to_unit_vectors
from crisalad_jax.utils.errors import InputError

KS = (1, 5, 10, 20)

Observe = Callable[[str, Descriptors, Descriptors], None]
"""A function of the name of a grouping, the database descriptors, and the query descriptors."""


@takes(benchmark=Benchmark)
def evaluate(
    model: Model | Runtime | Describer,
    benchmark: Benchmark,
    *,
    groupings: Sequence[str] = DEFAULT_GROUPINGS,
    seed: int = 0,
    seeds: int = 3,
    pca: Pca | None = None,
    dtype: Literal["float32", "bits"] = "float32",
    observe: Observe | None = None,
    rerank: Reranking | None = None,
    precision: float | None = None,
    reading: Reading = Reading(),
) -> list[GroupingResult]:
    r"""Measure Recall@1, 5, 10 and 20, precision and leakage of a model under each grouping.

    A grouping says which images attend to each other in a cross-image encoder. A model without this
    encoder has a single grouping, `any`. Leakage is how much the other images of a batch reveal
    about the place of an image. Whether two images show the same place is decided by the positions
    of the benchmark or, without positions, by its ground truth. Images are read and turned into
    tokens once; memory holds all tokens, and the descriptors of one grouping and seed at a time.

    Args:
        model: a model from `load`, a `Runtime` or a `Describer`.
        benchmark: the evaluation set.
        groupings: each as `Grouping.parse` reads it, such as "single"; or "published:NAME", where
            NAME is cricavpr, crisalad or sage, for the batches of that paper, followed by single
            images and by shuffled and masked batches of the same size.
        seed: seed of the first shuffle of the database; the queries use the next seed.
        seeds: number of shuffles of a grouping with `shuffled`, by `seed`, `seed` + 2 and so on.
        pca: principal components that shorten the descriptors, fitted to images of other places.
        dtype: how descriptors are compared; "bits" compares their signs (`pack_bits`) by the
            Hamming distance.
        observe: called with the descriptors of each grouping's first seed; for bits, with unit
            vectors of the signs.
        rerank: a second stage; each grouping then has two results, without and with this stage.
        precision: adds an `operating_point` to each result: the similarity threshold at which first
            retrievals reach this precision (above 0, at most 1), and the recall that remains.
        reading: how images are read; its batch size is the number of images that attend to each
            other, unless a grouping has its own. With `on_bad_image` "skip" the results are for the
            benchmark without unreadable images (`GroupingResult.skipped`).

    Returns:
        A result for each grouping, and with `rerank` a second one.

    Raises:
        InputError: the parameters do not fit the configuration; `pca` was fitted to another model;
            descriptors as bits have a length that is not a multiple of 8; there is no ground truth;
            an image cannot be read, or no query or no database image can; a number is out of range;
            a grouping is unknown, or a published one has no batches for this set; or the second
            stage does not fit (`Reranking.check` and `stage`).

    Example:
        >>> import jax, shutil
        >>> from crisalad_jax import PRESETS, Model, init_crisalad, open_benchmark
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> lines = ["query,database", *(f"{number}.png,{number}.png" for number in range(4))]
        >>> _ = (folder / "set" / "ground_truth.csv").write_text("\n".join(lines))
        >>> benchmark = open_benchmark(folder / "set", layout="folders")
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> quiet = Reading(quiet=True)
        >>> result, *_ = evaluate(model, benchmark, groupings=["single"], reading=quiet)
        >>> result.recalls[1]
        1.0
    """
    kinds = check_evaluation(groupings, seed=seed, seeds=seeds, precision=precision)
    describer = describer_of(model, kinds)
    config, attends = describer.config, describer.config.cross_image.attends
    parsed = groupings_of(groupings if attends else ["single"], benchmark)
    length, is_unit = shortened(pca, describer, "model")
    is_bits = dtype == "bits"
    if is_bits:
        check_packable(length, "dtype")
    if rerank is not None:
        rerank.check(config, len(benchmark.database))
        if rerank.needs_model and rerank.model is None:
            if not isinstance(model, tuple):
                raise InputError(
                    "rerank: found no JAX model, expected separate weights (--rerank-weights)"
                )
            rerank = dataclasses.replace(rerank, model=model)
    benchmark.ground_truth()  # fails before any work if there is none
    reading = reading.fitted(max(len(benchmark.database), len(benchmark.queries)))
    database, queries = (
        TokenSet(describer, paths, reading, label)
        for paths, label in ((benchmark.database, "database"), (benchmark.queries, "queries"))
    )
    skipped = Skipped(*(tuple(side.unreadable.tolist()) for side in (queries, database)))
    benchmark = skipped.rest_of(benchmark)
    positives = benchmark.ground_truth()
    same_queries, same_database = _same_place(benchmark, positives)
    sides = _Side(database, same_database, 0, pca), _Side(queries, same_queries, 1, pca)
    stages: dict[str | None, Callable[[Neighbours], Neighbours]] = {None: lambda ranked: ranked}
    with contextlib.ExitStack() as stack:
        if rerank is not None:
            stages[rerank.label] = stack.enter_context(
                rerank.stage(benchmark.database, benchmark.queries, reading)
            )
        k = min(max(*KS, rerank.top if rerank else 0), len(benchmark.database))
        results = []
        for grouping in parsed:
            is_random = "shuffled" in (grouping.queries, grouping.database)
            drawn = [seed + 2 * number for number in range(seeds if is_random else 1)]
            name = str(grouping) if attends else ANY
            observer = observe and functools.partial(observe, name)
            rankings, shares = _rank(
                sides, grouping, drawn, k, positives, observer, unit=is_unit, bits=is_bits
            )
            for label, stage in stages.items():
                result = summarise(
                    name,
                    {seed: stage(each).first(max(KS)) for seed, each in rankings.items()},
                    positives,
                    KS,
                    is_random=is_random,
                    precision=precision,
                    rerank=label,
                    skipped=skipped,
                    **shares,
                )
                results.append(result)
    return over_single(results)


def check_evaluation(
    groupings: Sequence[str], *, seed: int, seeds: int, precision: float | None
) -> list[str]:
    """Check arguments of `evaluate`, and return the kinds of groupings in them, such as "single".

    Raises:
        InputError: a grouping is unknown, or a number is out of range.
    """
    check_seed("seed", seed)
    check_count("seeds", seeds)
    if precision is not None:
        check_precision(precision)
    return check_groupings(groupings)


class _Side(NamedTuple):
    """One side, database or queries: its tokens and its test of same-place images."""

    tokens: TokenSet
    same: SamePlace
    offset: int
    """Added to the seed of a shuffle, so that the two sides never get the same one."""
    pca: Pca | None

    def batches(self, kind: str, batch_size: int | None, seed: int) -> Batches:
        """Group the images of this side."""
        if kind == MASKED:
            return masked(self.tokens.batches("sequential", batch_size), self.same)
        return self.tokens.batches(kind, batch_size, seed + self.offset)

    def describe(self, batches: Batches) -> Descriptors:
        """Return the descriptors of images in batches."""
        descriptors = self.tokens.describe(batches)
        return descriptors if self.pca is None else self.pca.apply(descriptors)


def same_place_rule(benchmark: Benchmark) -> str:
    """Describe how `evaluate` decides if two queries, or two database images, share a place."""
    if benchmark.query_positions is None or benchmark.database_positions is None:
        return "a common positive"
    return f"a distance of at most {benchmark.radius:g} m"


def _same_place(
    benchmark: Benchmark, positives: Sequence[Int64[np.ndarray, " _"]]
) -> tuple[SamePlace, SamePlace]:
    """Return the same-place tests of both sides, by positions or else by ground truth."""
    if benchmark.query_positions is None or benchmark.database_positions is None:
        return by_truth(positives, len(benchmark.database))
    radius = benchmark.radius
    return near(benchmark.query_positions, radius), near(benchmark.database_positions, radius)


def _rank(
    sides: tuple[_Side, _Side],
    grouping: Grouping,
    seeds: Sequence[int],
    k: int,
    positives: Sequence[Int64[np.ndarray, " _"]],
    observe: Callable[[Descriptors, Descriptors], None] | None,
    *,
    unit: bool,
    bits: bool,
) -> tuple[dict[int, Neighbours], dict[str, float | None]]:
    """Rank the k nearest neighbours for each seed; only shuffled sides are described again.

    `observe` gets the descriptors of the first seed. Descriptors that are not unit vectors are
    ranked by Euclidean distance, and bits by Hamming distance.

    Returns:
        The rankings by seed, and the leakage: fields of `GroupingResult`, averaged over the seeds.
    """
    kinds = grouping.database, grouping.queries
    descriptors: dict[int, Descriptors] = {}
    batches: dict[int, Batches] = {}
    shares: dict[int, float | None] = {}
    leaks: list[tuple[float | None, ...]] = []
    rankings = {}
    for seed in seeds:
        for number, (side, kind) in enumerate(zip(sides, kinds, strict=True)):
            if kind == "shuffled" or seed == seeds[0]:
                descriptors.pop(number, None)  # frees memory
                batches[number] = side.batches(kind, grouping.batch_size, seed)
                shares[number] = same_place_share(batches[number], side.same)
                described = side.describe(batches[number])
                descriptors[number] = pack_bits(described) if bits else described
        leaks.append((*shares.values(), mirrored_share(batches[1], batches[0], positives)))
        pair = descriptors[0], descriptors[1]
        if observe is not None and seed == seeds[0]:
            observe(*(map(sign_vectors, pair) if bits else pair))
        if not unit and not bits:
            pair = to_unit_vectors(*pair)
        rankings[seed] = search(*pair, k=k)
    names = ("database_share", "query_share", "mirrored_share")
    means = map(_mean_known, zip(*leaks, strict=True))
    return rankings, dict(zip(names, means, strict=True))


def _mean_known(shares: Sequence[float | None]) -> float | None:
    known = [share for share in shares if share is not None]
    return statistics.fmean(known) if known else None
