"""Descriptors of whole folders, and Recall@K of a benchmark by how its images are grouped."""

import pathlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from crisalad_jax.config import ModelConfig, choose
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.loader import ImageCache, OnBadImage, image_batches
from crisalad_jax.errors import InputError
from crisalad_jax.model import Crisalad, alone, among, relate, tokenise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.platform import devices_for
from crisalad_jax.progress import progress_bar
from crisalad_jax.retrieval import Neighbours, recalls, search

KS = (1, 5, 10, 20)
GROUPINGS = {
    "single": "every image alone",
    "shuffled": "batches of images in random order",
    "sequential": "batches of images in file order: neighbours help each other",
}
"""Which images look at each other in the cross-image encoder. Queries and database never mix."""


def check_grouping(groupings: Sequence[str], batch_size: int, seed: int) -> None:
    """Check how images are to be grouped, before the work of describing them.

    Raises:
        InputError: an unknown grouping, a batch of none, or a negative seed.
    """
    for grouping in groupings:
        choose("grouping", grouping, GROUPINGS)
    for name, value, least in (("batch size", batch_size, 1), ("seed", seed, 0)):
        if value < least:
            raise InputError(f"{name}: found {value}, expected at least {least}")


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
    batches = image_batches(
        paths,
        image_size=config.image_size,
        batch_size=batch_size,
        on_bad_image=on_bad_image,
        cache=cache,
    )
    devices = devices_for(batch_size)
    params = devices.share(params)
    with progress_bar(label, len(paths), "images", quiet=quiet) as bar:

        def collect(tokens: Tokens, valid: Bool[np.ndarray, " image"], used: int) -> None:
            found = *jax.device_get((tokens.global_token, tokens.local)), valid
            parts.append(tuple(leaf[:used] for leaf in found))
            bar.advance(used)

        ahead = None
        for batch in batches:
            tokens = tokenise(params, devices.spread(batch.images), config)
            # While the device is at this one, the one before comes back.
            if ahead is not None:
                collect(*ahead)
            ahead = (tokens, batch.valid, int((batch.indices >= 0).sum()))
        if ahead is not None:
            collect(*ahead)
    return FolderTokens(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def group(
    params: Crisalad,
    config: ModelConfig,
    folder: FolderTokens,
    grouping: str,
    *,
    batch_size: int,
    seed: int = 0,
) -> Float[np.ndarray, "image descriptor"]:
    """Descriptors of all images, in their order, under one of `GROUPINGS`.

    Images that could not be read are seen by none; their rows hold nothing of use.

    Raises:
        InputError: what `check_grouping` raises.
    """
    check_grouping([grouping], batch_size, seed)
    count = len(folder.readable)
    order = np.random.default_rng(seed).permutation(count) if grouping == "shuffled" else None
    order = np.arange(count) if order is None else order
    descriptors = np.empty((count, config.descriptor_dim), np.float32)
    for start in range(0, count, batch_size):
        chosen = order[start : start + batch_size]
        # A last batch that is not full repeats its first image, unseen, so that shapes stay alike.
        padded = np.resize(chosen, batch_size)
        valid = folder.readable[padded] & (np.arange(batch_size) < len(chosen))
        mask = alone(batch_size) if grouping == "single" else among(jnp.asarray(valid))
        tokens = Tokens(
            jnp.asarray(folder.global_tokens[padded]), jnp.asarray(folder.local[padded])
        )
        descriptors[chosen] = relate(params, tokens, config, mask=mask)[: len(chosen)]
    return descriptors


Observe = Callable[
    [str, Float[np.ndarray, "image descriptor"], Float[np.ndarray, "image descriptor"]], None
]
"""Takes the name of a grouping, the database's descriptors, and the queries'."""


class GroupingResult(NamedTuple):
    """A benchmark under one grouping."""

    grouping: str
    recalls: dict[int, float]
    """Recall@K as a fraction, by K."""
    neighbours: Neighbours
    """The nearest database images of every query, best first."""


def evaluate(
    params: Crisalad,
    config: ModelConfig,
    benchmark: Benchmark,
    *,
    groupings: Sequence[str] = tuple(GROUPINGS),
    batch_size: int = 16,
    seed: int = 0,
    cache: ImageCache | None = None,
    observe: Observe | None = None,
    quiet: bool = False,
) -> list[GroupingResult]:
    """Recall@1/5/10/20 under each grouping; images are read and tokenised once.

    A model without a cross-image encoder has one result, `any`: no descriptor depends on a batch.
    `observe` is given the descriptors of each grouping while they are there.

    Raises:
        InputError: an image cannot be read, or what `check_grouping` raises.
    """
    check_grouping(groupings, batch_size, seed)

    def tokens_of(paths: Sequence[pathlib.Path], label: str) -> FolderTokens:
        return read_tokens(
            params, config, paths, batch_size=batch_size, label=label, cache=cache, quiet=quiet
        )

    database = tokens_of(benchmark.database, "database")
    queries = tokens_of(benchmark.queries, "queries")
    if params.encoder is None:
        groupings = ("single",)
    results = []
    for grouping in groupings:
        sides = [
            group(params, config, folder, grouping, batch_size=batch_size, seed=seed + side)
            for side, folder in enumerate((database, queries))
        ]
        if observe is not None:
            observe(grouping, *sides)
        neighbours = search(*sides, k=min(max(KS), len(benchmark.database)))
        name = "any" if params.encoder is None else grouping
        found = recalls(neighbours.indices, benchmark.positives, KS)
        results.append(GroupingResult(name, found, neighbours))
    return results
