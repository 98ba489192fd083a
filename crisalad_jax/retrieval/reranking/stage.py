"""The second stage: compute local features of retrieved images once, and re-rank by them."""

import dataclasses
import os
import pathlib
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.config.checks import choose, require
from crisalad_jax.config.short_repr import with_field_docs
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, cast_params
from crisalad_jax.retrieval.reranking import divergence, fol, matching, pair_vpr, patch_netvlad
from crisalad_jax.retrieval.reranking.local import LocalReranker
from crisalad_jax.retrieval.reranking.second_stage import SecondStage
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool, Float, Int


@dataclasses.dataclass(frozen=True)
class Method:
    """A method of re-ranking: which local features it computes, and how it scores image pairs."""

    aggregator: str | None
    """Name of the aggregator that the model must have; None accepts any that has local features."""
    shape: Callable[[ModelConfig], tuple[int, int]]
    """Returns the number of local features of an image, and their length."""
    describe: Callable[[Crisalad, Any, ModelConfig], Any]
    """Computes the features of a batch of images, (image, feature, length)."""
    score: Callable[..., Any]
    """Scores each candidate of a query independently: one score, or one for each part, such as a
    window size. Takes the features of the query, those of the candidates, and the configuration."""
    fuse: Callable[[np.ndarray, ModelConfig], Float[np.ndarray, " candidate"]] = (
        lambda scores, config: scores
    )
    """Combines the scores of the parts into one per candidate, for all candidates of a query."""
    dtype: type[np.floating] = np.float16
    """Type of the features in the temporary file."""
    by_params: bool = False
    """Whether `score` also takes the model's parameters, as its first argument."""


_PATCH_NETVLAD = Method(
    "netvlad",
    patch_netvlad.shape,
    patch_netvlad.describe,
    patch_netvlad.spatial_scores,
    patch_netvlad.standardised_sum,
)
_METHODS: Mapping[str, Method | None] = {
    "fol": Method("fol", fol.shape, fol.describe, fol.count_matches),
    "local": None,
    "pair-vpr": Method(
        "pair-vpr", matching.patch_shape, pair_vpr.describe, pair_vpr.scores, by_params=True
    ),
    "patch-netvlad": _PATCH_NETVLAD,
    "patch-netvlad-ransac": dataclasses.replace(_PATCH_NETVLAD, score=patch_netvlad.inlier_scores),
    "patch-netvlad-sum": dataclasses.replace(_PATCH_NETVLAD, fuse=patch_netvlad.weighted_sum),
    "sinkhorn-divergence": Method(None, divergence.shape, divergence.describe, divergence.scores),
    "selavpr": Method(
        "selavpr", matching.selavpr_shape, matching.describe_selavpr, matching.count_matches
    ),
    # One feature per image: float32 takes little space, and ranks as the authors' code does.
    "selavprpp": Method(
        "selavprpp-hash",
        matching.selavprpp_shape,
        matching.describe_selavprpp,
        matching.nearness,
        dtype=np.float32,
    ),
    "transvpr": Method(
        "transvpr", matching.patch_shape, matching.describe_transvpr, matching.count_inliers
    ),
}
RERANKERS = tuple(_METHODS)
"""Names of the methods of re-ranking; all but "local" compute local features by a model."""
_AT_ONCE = 16
"""Maximum number of candidates of a query that are scored together."""
_NUMBERS = 2**25
"""Maximum number of values in the features that are scored together: 64 MiB."""


@with_field_docs
@dataclasses.dataclass(frozen=True)
class Reranking:
    """Which retrievals to re-rank, by which method, with which model.

    Example:
        >>> Reranking("transvpr", 100).label
        'transvpr:100'
    """

    name: str
    """Method: patch-netvlad, patch-netvlad-ransac or patch-netvlad-sum with a NetVLAD model; fol,
    pair-vpr, selavpr or transvpr with a model of that aggregator; selavprpp with a selavprpp-hash
    model; sinkhorn-divergence with any model with local tokens; local with SIFT or `matcher`."""
    top: int
    """Number of best retrievals per query to re-rank; the others stay in their places."""
    model: Model | None = None
    """The model for the local features; None uses the first stage's."""
    matcher: str | os.PathLike[str] | None = None
    """For the method local, the ONNX file of a matcher (see `OnnxMatcher`); None is SIFT."""

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
        """Whether a model computes the local features."""
        return _METHODS[self.name] is not None

    def check(self, config: ModelConfig, database: int | None = None) -> None:
        """Check that this re-ranking can follow a first stage whose model has `config`.

        Raises:
            InputError: the method cannot use the model for local features (its aggregator, size
                rule, image size or descriptors); or `top` is above the number of `database` images.
        """
        method, own = _METHODS[self.name], config if self.model is None else self.model.config
        if method is not None:
            found = own.aggregator.part_name, own.preprocessing.size_rule
            wanted = method.aggregator or found[0], "fixed"
            require(
                found == wanted,
                f"rerank: found a model with aggregator {found[0]} and size rule {found[1]}, "
                f"expected {wanted[0]} and fixed, whose local features {self.name} compares "
                "(--rerank-weights takes another model than the first stage's)",
            )
            method.shape(own)
        if database is not None and self.top > database:
            found = f"{self.label} over a database of {database} images"
            raise InputError(f"rerank: found {found}, expected at most {database}")

    def stage(
        self,
        database: Sequence[pathlib.Path],
        queries: Sequence[pathlib.Path],
        reading: Reading = Reading(),
    ) -> SecondStage:
        """Create the second stage for these images; use it as a context manager.

        Raises:
            InputError: the method needs a `model`, and it is None; or `check` or `Verifier` fails.
        """
        if self.needs_model:
            return Reranker(self, database, queries, reading)
        verifier = Verifier(Verify(answers=self.top, matcher=self.matcher))
        return LocalReranker(verifier, database, queries, reading)


def parse_reranking(text: str) -> Reranking:
    """Parse NAME:TOPK, as in patch-netvlad:100.

    Raises:
        InputError: the text has another form, the name is unknown, or the number is below 2.
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
    """Whether the features of an image are computed."""


class Reranker(SecondStage):
    """Re-ranks the neighbours of any number of first stages over the same images.

    Local features of the queries and of the retrieved database images are computed once, in batches
    of `reading.batch_size`, and stored in temporary files, mostly in float16; the system caches
    these in memory if there is room. Scores of pairs stay in memory. The device scores up to 16
    candidates of a query at a time, in one compiled program.
    """

    def __init__(
        self,
        reranking: Reranking,
        database: Sequence[pathlib.Path],
        queries: Sequence[pathlib.Path],
        reading: Reading = Reading(),
    ) -> None:
        """Prepare the second stage of a re-ranking with a model; use it as a context manager.

        Raises:
            InputError: no model is given, or `Reranking.check` refuses it.
        """
        method = _METHODS[reranking.name]
        if method is None or reranking.model is None:
            raise InputError(
                f"rerank: found {reranking.label} without a model, expected one whose features are "
                "compared, or `Reranking.stage`"
            )
        params, self._config = reranking.model
        reranking.check(self._config, len(database))
        super().__init__(reranking.name, reranking.top, reading)
        self._method = method
        self._devices = devices_for(reading.batch_size)
        self._params = self._devices.replicate(cast_params(params, self._config))
        self._folder = tempfile.TemporaryDirectory(prefix="rerank-", ignore_cleanup_errors=True)
        self._database, self._queries = self._side(database, "db"), self._side(queries, "queries")

    def _side(self, paths: Sequence[pathlib.Path], name: str) -> _Side:
        shape = len(paths), *self._method.shape(self._config)
        file = pathlib.Path(self._folder.name) / name
        features = np.memmap(file, self._method.dtype, "w+", shape=shape)
        return _Side(paths, features, np.zeros(len(paths), bool))

    def __exit__(self, *_: object) -> None:
        """Remove the temporary files."""
        del self._database, self._queries  # some systems cannot remove open files
        self._folder.cleanup()

    def prepare(self, first: Int[np.ndarray, "query candidate"]) -> None:
        """Compute the features of all queries and of their candidates, except known ones."""
        self._describe(self._queries, np.arange(len(first)), "queries")
        self._describe(self._database, np.unique(first), "candidates")

    def _describe(self, side: _Side, images: Int[np.ndarray, " image"], name: str) -> None:
        """Compute the features of images that have none yet.

        Raises:
            InputError: an image cannot be read, or the disk has no space.
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
        with self.bar(name, len(missing), "images") as bar:
            for batch in self._reading.batches(paths, Preparation.of(config)):
                sharded = self._devices.shard_batch(batch.images)
                found = np.asarray(self._method.describe(self._params, sharded, config))
                rows = missing[batch.indices[batch.valid]]
                side.features[rows], side.known[rows] = found[batch.valid], True
                bar.advance(len(rows))

    def compare(self, query: int, candidates: Sequence[int]) -> Iterator[float | list[float]]:
        """Yield the score of a query with each candidate; a list if the method scores parts."""
        patches, dim = self._queries.features.shape[1:]
        step = max(1, min(_AT_ONCE, self._top, _NUMBERS // (patches * dim)))
        given = (self._params,) if self._method.by_params else ()
        for start in range(0, len(candidates), step):
            part = candidates[start : start + step]
            # The last part is padded, so that all have one shape and compile once.
            filled = np.resize(part, step)
            ours, theirs = self._queries.features[query], self._database.features[filled]
            pairs = np.asarray(ours), np.asarray(theirs)
            found = self._method.score(*given, *pairs, self._config)
            yield from np.asarray(found)[: len(part)].tolist()

    def order(self, scores: np.ndarray, similarities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Order candidates by score, fusing the scores of parts; similarities are not used."""
        fused = self._method.fuse(scores, self._config).astype(np.float32)
        return np.argsort(-fused, kind="stable"), fused
