"""Descriptors of whole folders, and what they are worth on a benchmark by how they are grouped."""

import contextlib
import functools
import pathlib
import statistics
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int64

from crisalad_jax import platform
from crisalad_jax.config import ModelConfig
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.loader import ImageBatch, ImageCache, OnBadImage, image_batches
from crisalad_jax.errors import InputError
from crisalad_jax.groupings import (
    DEFAULT_GROUPINGS,
    Batches,
    Grouping,
    batches_of,
    check_grouping,
    parse_groupings,
)
from crisalad_jax.model import Crisalad, relate, tokenise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.pca import Pca
from crisalad_jax.platform import devices_for
from crisalad_jax.progress import progress_bar
from crisalad_jax.reranking import Reranker, Reranking
from crisalad_jax.results import ANY, GroupingResult, summarise
from crisalad_jax.retrieval import Neighbours, search
from crisalad_jax.same_place import SamePlace, by_truth, near, same_place_share

KS = (1, 5, 10, 20)


class FolderTokens(NamedTuple):
    """Tokens of many images on the host (see `Tokens`), and which images could be read."""

    global_tokens: Float[np.ndarray, "image global_dim"]
    local: Float[np.ndarray, "image token dim"]
    readable: Bool[np.ndarray, " image"]


def read_tokens(
    params: Crisalad,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    label: str,
    on_bad_image: OnBadImage = "stop",
    cache: ImageCache | None = None,
    quiet: bool = False,
) -> FolderTokens:
    """Tokens of every image, resized to `config.image_size`, in the order of `paths`.

    Raises:
        InputError: an image cannot be read, and `on_bad_image` is "stop".
    """
    parts: list[tuple[np.ndarray, ...]] = []
    stream = tokens_in_batches(
        params, config, paths, batch_size=batch_size, on_bad_image=on_bad_image, cache=cache
    )
    with progress_bar(label, len(paths), "images", quiet=quiet) as bar:
        for tokens, batch in stream:
            used = int((batch.indices >= 0).sum())
            parts.append(tuple(leaf[:used] for leaf in tokens))
            bar.advance(used)
    return FolderTokens(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def tokens_in_batches(
    params: Crisalad,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    cache: ImageCache | None = None,
) -> Iterator[tuple[FolderTokens, ImageBatch]]:
    """Tokens of images in order, a batch at a time with what it was made of; the last is padded.

    Two batches are in memory, and images that are read ahead.

    Raises:
        InputError: an image cannot be read and `on_bad_image` is "stop"; a batch of none.
    """
    batches = image_batches(
        paths,
        image_size=config.image_size,
        batch_size=batch_size,
        on_bad_image=on_bad_image,
        cache=cache,
    )
    devices = devices_for(batch_size)
    params = devices.share(params)

    def back(tokens: Tokens, batch: ImageBatch) -> tuple[FolderTokens, ImageBatch]:
        global_tokens, local = jax.device_get((tokens.global_token, tokens.local))
        return FolderTokens(global_tokens, local, batch.valid), batch

    ahead = None
    for batch in batches:
        tokens = tokenise(params, devices.spread(batch.images), config)
        # While the device is at this one, the one before comes back.
        if ahead is not None:
            yield back(*ahead)
        ahead = (tokens, batch)
    if ahead is not None:
        yield back(*ahead)


def group(
    params: Crisalad,
    config: ModelConfig,
    folder: FolderTokens,
    grouping: str,
    *,
    batch_size: int,
    seed: int = 0,
    label: str = "images",
    quiet: bool = True,
) -> Float[np.ndarray, "image descriptor"]:
    """Descriptors of all images, in their order, under one of `GROUPINGS`.

    Images that could not be read are seen by none; their rows hold nothing of use.

    Raises:
        InputError: what `check_grouping` raises.
    """
    count = len(folder.readable)
    batches = batches_of(count, grouping, batch_size, seed)
    descriptors = np.empty((count, config.descriptor_dim), np.float32)
    # A window gives one descriptor; as many of them as a batch has images are taken at a time.
    step = batch_size if grouping == "window" else 1
    # Beside the backbone the other groupings take no time.
    silent = quiet or grouping != "window"
    with progress_bar(f"{label}, {grouping}", count, "images", quiet=silent) as bar:
        for start in range(0, len(batches.images), step):
            part = batches.part(start, start + step)
            relate_part = _relate_windows if grouping == "window" else _relate_batch
            kept = part.images[part.kept]
            descriptors[kept] = relate_part(params, config, folder, part)
            bar.advance(len(kept))
    return descriptors


Observe = Callable[
    [str, Float[np.ndarray, "image descriptor"], Float[np.ndarray, "image descriptor"]], None
]
"""Takes the name of a grouping, the database's descriptors, and the queries'."""


def _relate_batch(
    params: Crisalad, config: ModelConfig, folder: FolderTokens, batch: Batches
) -> Float[np.ndarray, "image descriptor"]:
    """The descriptors that one batch gives."""
    (images,), (kept,), (mask,) = batch.images, batch.kept, batch.looks(folder.readable)
    tokens = Tokens(jnp.asarray(folder.global_tokens[images]), jnp.asarray(folder.local[images]))
    return np.asarray(relate(params, tokens, config, mask=mask))[kept]


def _relate_windows(
    params: Crisalad, config: ModelConfig, folder: FolderTokens, windows: Batches
) -> Float[np.ndarray, "window descriptor"]:
    """The descriptors that some windows give, each of its last image."""
    width = windows.images.shape[1]
    # Windows overlap: each image goes to the device once. Shapes are those of `width` windows.
    images, places = np.unique(windows.images, return_inverse=True)
    images = np.resize(images, 2 * width - 1)
    rows = np.arange(width) % len(windows.images)
    found = _relate_last(
        params,
        Tokens(jnp.asarray(folder.global_tokens[images]), jnp.asarray(folder.local[images])),
        places.reshape(windows.images.shape)[rows],
        windows.looks(folder.readable)[rows],
        config,
    )
    return np.asarray(found)[: len(windows.images)]


@functools.partial(platform.jit, static_argnames="config")
def _relate_last(
    params: Crisalad,
    tokens: Tokens,
    places: Int[Array, "window place"],
    masks: Bool[Array, "window place place"],
    config: ModelConfig,
) -> Float[Array, "window descriptor"]:
    def last(places: Int[Array, " place"], mask: Bool[Array, "place place"]) -> Array:
        window = jax.tree.map(lambda leaf: leaf[places], tokens)
        return relate(params, window, config, mask=mask)[-1]

    return jax.vmap(last)(places, masks)


def evaluate(
    params: Crisalad,
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
    quiet: bool = False,
) -> list[GroupingResult]:
    """Recall@1/5/10/20 and more under each grouping; images are read and tokenised once.

    Two images of one side show the same place where the benchmark's positions, or where it has none
    its ground truth, say so (`same_place`).

    A model without a cross-image encoder has one grouping, `any`: no descriptor depends on a batch.
    Beyond the tokens memory holds the descriptors of one grouping and seed at a time.

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
        quiet: no progress bars.

    Raises:
        InputError: no ground truth, an image cannot be read, components that are not for this model
            or make no unit vectors, or what `parse_groupings`, `check_grouping`, `Reranking.check`
            and `Reranker` raise.
    """
    parsed = parse_groupings(groupings)
    check_grouping((), batch_size, seed, seeds)
    if pca is not None:
        pca.check(config.descriptor_dim, "model")
        if not pca.config.renormalise:
            raise InputError(
                "pca: found components that leave lengths as they are, expected some that make "
                "unit vectors, which are ranked by cosine"
            )
    if rerank is not None:
        rerank.check(config, len(benchmark.database))
    positives = benchmark.ground_truth()

    def side(name: str, paths: Sequence[pathlib.Path], same: SamePlace, offset: int) -> _Side:
        tokens = read_tokens(
            params, config, paths, batch_size=batch_size, label=name, cache=cache, quiet=quiet
        )
        return _Side(name, tokens, same, offset)

    same_queries, same_database = _same_place(benchmark, positives)
    database = side("database", benchmark.database, same_database, 0)
    queries = side("queries", benchmark.queries, same_queries, 1)

    def describe(*side: Any, **options: Any) -> Float[np.ndarray, "image descriptor"]:
        full = group(params, config, *side, batch_size=batch_size, quiet=quiet, **options)
        return full if pca is None else pca.apply(full)

    stages: dict[str | None, Callable[[Neighbours], Neighbours]] = {None: lambda found: found}
    with contextlib.ExitStack() as stack:
        if rerank is not None:
            stages[rerank.label] = stack.enter_context(
                Reranker(
                    rerank.over(params, config),
                    benchmark.database,
                    benchmark.queries,
                    batch_size=batch_size,
                    cache=cache,
                    quiet=quiet,
                )
            )
        k = min(max(*KS, rerank.top if rerank else 0), len(benchmark.database))
        results = []
        for grouping in parsed if params.encoder else [Grouping("single", "single")]:
            is_random = "shuffled" in (grouping.queries, grouping.database)
            drawn = [seed + 2 * number for number in range(seeds if is_random else 1)]
            name = str(grouping) if params.encoder else ANY
            sides = (database, grouping.database), (queries, grouping.queries)
            database_share, query_share = (
                _mean_share(side, kind, drawn, batch_size) for side, kind in sides
            )
            observer = observe and functools.partial(observe, name)
            rankings = _rank(describe, sides, drawn, k, observer)
            for label, stage in stages.items():
                found = {seed: _first(stage(each), max(KS)) for seed, each in rankings.items()}
                results.append(
                    summarise(
                        name,
                        found,
                        positives,
                        KS,
                        query_share=query_share,
                        database_share=database_share,
                        is_random=is_random,
                        rerank=label,
                    )
                )
    return results


def _first(neighbours: Neighbours, count: int) -> Neighbours:
    """The best `count` of each query."""
    return Neighbours(*(part[:, :count] for part in neighbours))


class _Side(NamedTuple):
    """Database or queries, read."""

    name: str
    tokens: FolderTokens
    same: SamePlace
    offset: int
    """From a shuffle's seed to that of this side: two sides are never shuffled alike."""


def same_place_rule(benchmark: Benchmark) -> str:
    """By what `evaluate` tells whether two images of one side show the same place, in words."""
    if benchmark.query_positions is None or benchmark.database_positions is None:
        return "a common positive"
    return f"a distance of at most {benchmark.radius:g} m"


def _same_place(
    benchmark: Benchmark, positives: Sequence[Int64[np.ndarray, " _"]]
) -> tuple[SamePlace, SamePlace]:
    """Of the queries and of the database: by positions, or where there are none by ground truth."""
    if benchmark.query_positions is None or benchmark.database_positions is None:
        return by_truth(positives, len(benchmark.database))
    radius = benchmark.radius
    return near(benchmark.query_positions, radius), near(benchmark.database_positions, radius)


def _mean_share(side: _Side, kind: str, seeds: Sequence[int], batch_size: int) -> float | None:
    """See `GroupingResult`."""
    count = len(side.tokens.readable)
    found = [
        same_place_share(batches_of(count, kind, batch_size, seed + side.offset), side.same)
        for seed in (seeds if kind == "shuffled" else seeds[:1])
    ]
    known = [share for share in found if share is not None]
    return statistics.fmean(known) if known else None


def _rank(
    describe: Callable[..., Float[np.ndarray, "image descriptor"]],
    sides: Sequence[tuple[_Side, str]],
    seeds: Sequence[int],
    k: int,
    observe: Callable[..., None] | None,
) -> dict[int, Neighbours]:
    """The k nearest neighbours by seed. Only a side that is shuffled is described for each anew.

    `observe` is given the descriptors of the first.
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
        return search(database, queries, k=k)

    return {seed: ranking(seed) for seed in seeds}
