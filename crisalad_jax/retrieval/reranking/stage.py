"""The second stage: local features of the retrieved images, computed once, and the new order."""

import contextlib
import dataclasses
import os
import pathlib
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.config.short_repr import with_field_docs
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, cast_params
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.reranking import divergence, fol, matching, pair_vpr, patch_netvlad
from crisalad_jax.retrieval.reranking.local import LocalReranker
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.progress import Bar, progress_bar
from crisalad_jax.utils.shapes import Bool, Float, Int


@dataclasses.dataclass(frozen=True)
class Method:
    """A second stage's local features, and its scores of pairs of images."""

    aggregator: str | None
    """Name of the aggregator whose models it takes; None takes any that has what it compares."""
    shape: Callable[[ModelConfig], tuple[int, int]]
    """Returns the number of an image's features, and their length."""
    describe: Callable[[Crisalad, Any, ModelConfig], Any]
    """Computes the features of a batch of images."""
    score: Callable[[Crisalad, Any, Any, ModelConfig], Any]
    """Scores any number of a query's candidates, each by itself: one score, or one of each part."""
    fuse: Callable[[np.ndarray, ModelConfig], Float[np.ndarray, " candidate"]] = (
        lambda scores, config: scores
    )
    """Makes one score of the parts, of all candidates of a query together."""
    dtype: type[np.floating] = np.float16
    """Type of the features in the temporary file."""


def _by_features(score: Callable[[Any, Any, ModelConfig], Any]) -> Callable[..., Any]:
    """Score features without the model's parameters."""
    return lambda params, *rest: score(*rest)


_PATCH_NETVLAD = Method(
    "netvlad",
    patch_netvlad.shape,
    patch_netvlad.describe,
    _by_features(patch_netvlad.spatial_scores),
    patch_netvlad.standardised_sum,
)
_METHODS: Mapping[str, Method | None] = {
    "fol": Method("fol", fol.shape, fol.describe, _by_features(fol.count_matches)),
    "local": None,
    "pair-vpr": Method("pair-vpr", matching.patch_shape, pair_vpr.describe, pair_vpr.scores),
    "patch-netvlad": _PATCH_NETVLAD,
    "patch-netvlad-ransac": dataclasses.replace(
        _PATCH_NETVLAD, score=_by_features(patch_netvlad.inlier_scores)
    ),
    "patch-netvlad-sum": dataclasses.replace(_PATCH_NETVLAD, fuse=patch_netvlad.weighted_sum),
    "sinkhorn-divergence": Method(
        None, divergence.shape, divergence.describe, _by_features(divergence.scores)
    ),
    "selavpr": Method(
        "selavpr",
        matching.selavpr_shape,
        matching.describe_selavpr,
        _by_features(matching.count_matches),
    ),
    # One feature an image: float32 takes little, and ranks as the authors' code does.
    "selavprpp": Method(
        "selavprpp-hash",
        matching.selavprpp_shape,
        matching.describe_selavprpp,
        _by_features(matching.nearness),
        dtype=np.float32,
    ),
    "transvpr": Method(
        "transvpr",
        matching.patch_shape,
        matching.describe_transvpr,
        _by_features(matching.count_inliers),
    ),
}
RERANKERS = tuple(_METHODS)
"""Names of the second stages. A method that is None compares local features of no model."""
_AT_ONCE = 16
"""Largest number of candidates of a query that are scored together."""
_NUMBERS = 2**25
"""Largest size of the features that are scored together, in numbers: 64 MiB."""


@with_field_docs
@dataclasses.dataclass(frozen=True)
class Reranking:
    """Which retrievals are re-ranked, by which method, with which model.

    Example:
        >>> Reranking("transvpr", 100).label
        'transvpr:100'
    """

    name: str
    """patch-netvlad, patch-netvlad-ransac or patch-netvlad-sum, by a model with NetVLAD; fol,
    pair-vpr, selavpr or transvpr, by one with that aggregator; selavprpp, by one with
    selavprpp-hash; sinkhorn-divergence, by one with local tokens; local, by SIFT or `matcher`."""
    top: int
    """Number of a query's first retrievals that are re-ranked; the later ones keep their places."""
    model: Model | None = None
    """The model that makes local features; None uses the first stage's."""
    matcher: str | os.PathLike[str] | None = None
    """For local, the ONNX file of `Verify.matcher`; None is SIFT."""

    def __post_init__(self) -> None:
        """Check the name and the number."""
        choose("rerank", self.name, _METHODS)
        if self.top < 2:
            raise InputError(
                f"rerank: found {self.label}, expected at least 2 retrievals to put in order"
            )

    @property
    def label(self) -> str:
        """Name and number in the form that `parse_reranking` reads."""
        return f"{self.name}:{self.top}"

    @property
    def needs_model(self) -> bool:
        """Whether a model makes the local features."""
        return _METHODS[self.name] is not None

    def check(self, config: ModelConfig, database: int | None = None) -> None:
        """Check that this re-ranking fits a first stage of `config`.

        Raises:
            InputError: the model that makes local features has another aggregator, or its images
                too few patches; more retrievals than the database has images, if that is given.
        """
        method, own = _METHODS[self.name], config if self.model is None else self.model.config
        found = own.aggregator.part_name, own.preprocessing.size_rule
        wanted = (method and method.aggregator) or found[0], "fixed"
        if method is not None and found != wanted:
            raise InputError(
                f"rerank: found a model with aggregator {found[0]} and size rule {found[1]}, "
                f"expected {wanted[0]} and fixed, whose local features {self.name} "
                "compares (--rerank-weights takes another model than the first stage's)"
            )
        if method is not None:
            method.shape(own)
        if database is not None and self.top > database:
            raise InputError(
                f"rerank: found {self.label} over a database of {database} images, expected at "
                f"most {database}"
            )

    def stage(
        self,
        database: Sequence[pathlib.Path],
        queries: Sequence[pathlib.Path],
        reading: Reading = Reading(),
    ) -> "Reranker | LocalReranker":
        """Make the second stage over some images, which is entered before use.

        Raises:
            InputError: what `check` and `open_matcher` raise.
        """
        if self.needs_model:
            return Reranker(self, database, queries, reading)
        verifier = Verifier(Verify(answers=self.top, matcher=self.matcher))
        return LocalReranker(verifier, database, queries, reading)


def parse_reranking(text: str) -> Reranking:
    """Read NAME:TOPK, as in patch-netvlad:100.

    Raises:
        InputError: the form, the name or the number is wrong.
    """
    match = re.fullmatch(r"(.+):([0-9]{1,9})", text)
    if match is None:
        raise InputError(
            f"rerank: found {text!r}, expected NAME:TOPK, as in patch-netvlad:100, with one of "
            f"{', '.join(sorted(_METHODS))}"
        )
    return Reranking(match[1], int(match[2]))


class _Side(NamedTuple):
    """The images of one side, and their local features in a sparse file."""

    paths: Sequence[pathlib.Path]
    features: Float[np.ndarray, "image feature dim"]
    known: Bool[np.ndarray, " image"]
    """Whether the features of an image are there."""


class Reranker:
    """Puts the neighbours of any number of first stages over the same images in a new order.

    Local features of the queries and of the retrieved database images are computed once, by
    `batch_size`. Temporary files hold them, most in float16, and the system caches these in memory
    as far as there is room; scores of pairs stay in memory. The device scores up to 16 candidates
    of a query at a time, in one compiled program.
    """

    def __init__(
        self,
        reranking: Reranking,
        database: Sequence[pathlib.Path],
        queries: Sequence[pathlib.Path],
        reading: Reading = Reading(),
    ) -> None:
        """Prepare the second stage, of a re-ranking with a model; enter it before use.

        Raises:
            InputError: no model, or what `Reranking.check` raises.
        """
        method = _METHODS[reranking.name]
        if method is None or reranking.model is None:
            raise InputError(
                f"rerank: found {reranking.label} without a model, expected one whose features are "
                "compared, or `Reranking.stage`"
            )
        params, self._config = reranking.model
        reranking.check(self._config, len(database))
        self._top, self._label = reranking.top, reranking.name
        self._method, self._reading = method, reading
        self._devices = devices_for(reading.batch_size)
        self._params = self._devices.replicate(cast_params(params, self._config))
        self._scores: dict[tuple[int, int], float | list[float]] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="rerank-", ignore_cleanup_errors=True)
        self._database, self._queries = self._side(database, "db"), self._side(queries, "queries")

    def _side(self, paths: Sequence[pathlib.Path], name: str) -> _Side:
        shape = len(paths), *self._method.shape(self._config)
        file = pathlib.Path(self._folder.name) / name
        features = np.memmap(file, self._method.dtype, "w+", shape=shape)
        return _Side(paths, features, np.zeros(len(paths), bool))

    def __enter__(self) -> Self:
        """Return the second stage itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the temporary files."""
        del self._database, self._queries  # some systems cannot remove open files
        self._folder.cleanup()

    def __call__(self, neighbours: Neighbours) -> Neighbours:
        """Sort each query's first `top` neighbours by falling score.

        Equal scores keep the first stage's order, and so do the neighbours after the first `top`.
        Scores replace the similarities of the neighbours that are re-ranked.

        Raises:
            InputError: an image cannot be read; the disk has no room for the features.
        """
        indices, similarities = (np.array(part) for part in neighbours)
        top = self._top
        first = indices[:, :top]
        self._describe(self._queries, np.arange(len(indices)), "queries")
        self._describe(self._database, np.unique(first), "candidates")
        with self._bar("pairs", len(first) * top, "pairs") as bar:
            for query, candidates in enumerate(first):
                scores = self._score(query, candidates)
                order = np.argsort(-scores, kind="stable")
                indices[query, :top] = candidates[order]
                similarities[query, :top] = scores[order]
                bar.advance(top)
        return Neighbours(indices, similarities)

    def _bar(self, what: str, count: int, unit: str) -> contextlib.AbstractContextManager[Bar]:
        return progress_bar(f"{self._label}, {what}", count, unit, quiet=self._reading.quiet)

    def _describe(self, side: _Side, images: Int[np.ndarray, " image"], name: str) -> None:
        """Compute the features of those images that have none yet.

        Raises:
            InputError: an image cannot be read, or the disk has no room.
        """
        missing = images[~side.known[images]]
        if not len(missing):
            return
        needed = len(missing) * side.features[:1].nbytes
        free = shutil.disk_usage(self._folder.name).free
        if needed > free:
            raise InputError(
                f"{self._folder.name}: found {free / 2**30:.1f} GiB free, expected "
                f"{needed / 2**30:.1f} GiB for the local features of {len(missing)} images"
            )
        config, paths = self._config, [side.paths[i] for i in missing]
        with self._bar(name, len(missing), "images") as bar:
            for batch in self._reading.batches(paths, Preparation.of(config)):
                sharded = self._devices.shard_batch(batch.images)
                found = np.asarray(self._method.describe(self._params, sharded, config))
                rows = missing[batch.indices[batch.valid]]
                side.features[rows], side.known[rows] = found[batch.valid], True
                bar.advance(len(rows))

    def _score(
        self, query: int, candidates: Int[np.ndarray, " candidate"]
    ) -> Float[np.ndarray, " candidate"]:
        """Score all candidates of one query; scores of pairs are kept for later calls."""
        new = np.array([c for c in candidates if (query, int(c)) not in self._scores], int)
        patches, dim = self._queries.features.shape[1:]
        step = max(1, min(_AT_ONCE, self._top, _NUMBERS // (patches * dim)))
        for start in range(0, len(new), step):
            part = new[start : start + step]
            # The last part is padded, so that all have one shape and compile once.
            filled = np.resize(part, step)
            ours, theirs = self._queries.features[query], self._database.features[filled]
            pairs = np.asarray(ours), np.asarray(theirs)
            found = self._method.score(self._params, *pairs, self._config)
            values = np.asarray(found)[: len(part)]
            self._scores |= {(query, int(c)): s for c, s in zip(part, values.tolist(), strict=True)}
        scores = np.array([self._scores[query, int(c)] for c in candidates])
        return self._method.fuse(scores, self._config).astype(np.float32)
