"""Query a map: find its images that are most similar to others, and where they were taken."""

import itertools
import json
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import check_count, require, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import frame_time
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.metres import Zone
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import is_remote
from crisalad_jax.data.sources import ImageSource, open_sources
from crisalad_jax.retrieval.describe import (
    Described,
    check_readable,
    described,
    readable,
    shown,
)
from crisalad_jax.retrieval.maps.calibration import check_min_similarity
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.map import Answer, Map
from crisalad_jax.retrieval.maps.tracking import SequenceSearch, SequenceTracker, TrackResult
from crisalad_jax.retrieval.maps.verified import calibration_of, verify_answers
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.verification.results import MapPose, Verification
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.progress import Bar, progress_bar
from crisalad_jax.utils.shapes import Bool, Float32, Float64

if TYPE_CHECKING:  # answers are searched without JAX
    from crisalad_jax.nn.model import Model

Thresholds = tuple[float | None, int | None]
"""Minimum similarity, and minimum inliers, of a best answer; None accepts any."""
AT_ONCE = 1024
"""Number of queries that are searched for together: the map is read once for all of them."""


@brief
class Answers(NamedTuple):
    """The answers to some queries, by query."""

    queries: list[pathlib.Path]
    """Image files, in order."""
    neighbours: Neighbours
    """Numbers of the map's images and their similarities, (query, k), best first."""
    images: Sequence[MapImage]
    """All images of the map, by number."""
    axes: tuple[str, str] | None
    """Axes of the positions; None if no image has one."""
    unreadable: Sequence[pathlib.Path] = ()
    """Image files that could not be read, which have no answers."""
    min_similarity: float | None = None
    """Minimum similarity of a best answer; None accepts any."""
    probabilities: Float64[np.ndarray, "query k"] | None = None
    """Probability that the camera is at each answer; None without `sequence`."""
    best: Float32[np.ndarray, " query"] | None = None
    """Similarity of the map's most similar image, if `sequence` or `verify` may have ranked another
    first; None if it is the first answer's."""
    zone: Zone | None = None
    """UTM zone of all positions; None if unknown."""
    root: pathlib.Path | None = None
    """Folder that names of queries are relative to: that of their source or, if there are several,
    the one that contains them all; None if names are full paths."""
    checks: Sequence[Sequence[Verification]] | None = None
    """Verifications of the first answers to each query, in the order of `neighbours`; None if
    answers were not verified."""
    poses: Sequence[MapPose | None] | None = None
    """Camera pose of each query, if verified answers determine it; None without `verify`."""
    min_inliers: int | None = None
    """Minimum number of inliers of a verified best answer; None accepts any."""

    @property
    def is_thresholded(self) -> bool:
        """Whether answers must be similar enough, or have enough inliers, to count."""
        return (self.min_similarity, self.min_inliers) != (None, None)

    @property
    def names(self) -> list[str]:
        """Name of each query: a posix path below `root`, or the full path if `root` is None."""
        root = self.root
        named = self.queries if root is None else [path.relative_to(root) for path in self.queries]
        return [path.as_posix() for path in named]

    @property
    def known(self) -> Bool[np.ndarray, " query"]:
        """Whether each query shows a place of the map.

        True if an image is similar enough and the best answer, if verified, has enough inliers.
        """
        best = self.neighbours.similarities[:, 0] if self.best is None else self.best
        least = -np.inf if self.min_similarity is None else self.min_similarity
        known = best.astype(np.float64) >= least  # float32 would round the least similarity
        if self.min_inliers is not None and self.checks is not None:
            known &= [first.inliers >= self.min_inliers for first, *_ in self.checks]
        return known

    def rows(self) -> Iterator[tuple[pathlib.Path, list[Answer]]]:
        """Yield each query with its answers, best first."""
        for number, query in enumerate(self.queries):
            found = [part[number].tolist() for part in self.neighbours]
            found.append([] if self.probabilities is None else self.probabilities[number].tolist())
            found.append([] if self.checks is None else self.checks[number])
            ranked = enumerate(itertools.zip_longest(*found), 1)
            yield query, [Answer(rank, s, self.images[i], *more) for rank, (i, s, *more) in ranked]

    def position(self, image: MapImage) -> dict[str, float] | None:
        """Return where an image was taken, by the names of the axes; None if unknown."""
        return position_fields(image, self.axes)


@takes(places=Map)
def query(
    places: Map,
    images: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    model: "Model | Runtime | None" = None,
    k: int = 5,
    fps: float | None = None,
    topic: str | None = None,
    window: int = 1,
    exact: bool = False,
    min_similarity: float | None = None,
    sequence: SequenceSearch | None = None,
    where: Where | str | None = None,
    verify: Verify | None = None,
    reading: Reading = Reading(),
) -> Answers:
    """Find the images of a map that are most similar to the given ones.

    Args:
        places: the map, open.
        images: an image file, a folder, another source of images (docs/how-to/image-sources.md), or
            a list of these.
        model: the model that made the map; None loads it from its recorded path (`Map.load_model`).
        k: number of answers per query.
        fps: frames per second to take from a video or robot log; None is 1.
        topic: the image topic of a robot log; None takes the only one.
        window: number of frames that are described together: each with those just before it in its
            source, as a moving camera sees them. Files listed one after the other are one source. 1
            describes each independently, like a map's images.
        exact: whether to search exactly even if the map has an approximate search.
        min_similarity: a query is of an unknown place if no image is this similar to it; see
            `Answers.known`. None is the map's calibration or, without one, -1, which accepts all.
        sequence: how to match consecutive frames of one camera to the map's images in order; None
            answers every query independently.
        where: which images of the map to search, such as "folder=monday, added>=2026-05-01"
            (`Where.parse`); None is all, which `sequence` requires.
        verify: how to verify the best answers by local features and rank them by their inliers
            (docs/verification.md); None ranks them by similarity.
        reading: how images are read.

    Returns:
        The answers, which remain usable after the map is closed.

    Raises:
        InputError: `model` did not make the map; no image is readable, or an unreadable one is
            not skipped; a number is out of range; answers cannot be verified; or the search fails.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, index, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> quiet = Reading(quiet=True)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
        >>> with Map.open(folder / "map") as places:
        ...     answers = query(places, pictures / "2.png", k=1, reading=quiet)
        >>> [answer.image.name for _, found in answers.rows() for answer in found]
        ['2.png']
    """
    check_count("k", k)
    verifier = None if verify is None else Verifier(verify)
    thresholds = asked_thresholds(places, min_similarity, verifier)
    how = {"fps": fps, "topic": topic, "on_bad_image": reading.on_bad_image}
    root, sources = _below_one_root(open_sources(images, **how, position_topic="none"))
    paths = list(itertools.chain(*sources))
    describer = places.describer(model, groupings=["single" if window == 1 else "window"])
    ask = asking(places, k, verifier, sequence, where, exact=exact)
    reading, how = reading.fitted(len(paths)), {"window": window, "components": places.components}

    def stream() -> Iterator[Described]:
        first = 0
        for some in [paths] if window == 1 else sources:  # a window is within one source
            for part in described(describer, some, reading, **how):
                yield Described(part.indices + first, part.descriptors, part.unreadable + first)
            first += len(some)

    found: list[Sequence[np.ndarray]] = []
    asked: list[pathlib.Path] = []
    unreadable: list[pathlib.Path] = []
    parts = shown(stream(), "queries", len(paths), quiet=reading.quiet)
    for frames, descriptors in readable(parts, AT_ONCE, paths, unreadable):
        found.append(ask(descriptors, frames))
        asked += frames
    check_readable("images", len(paths), len(asked))
    answers = answers_of(places, asked, found, thresholds, unreadable=unreadable, root=root)
    if verifier is None:
        return answers
    with progress_bar("verified", len(asked), "queries", quiet=reading.quiet) as bar:
        return verified(answers, verifier, _read_each(asked, bar), k)


def _read_each(paths: Sequence[pathlib.Path], bar: Bar) -> Iterator[np.ndarray]:
    for path in paths:
        yield read_pixels(path)
        bar.advance(1)


Ask = Callable[[Float32[np.ndarray, "query d"], Sequence[pathlib.Path]], Neighbours | TrackResult]
"""A function that finds the answers to images from their descriptors and paths."""


def asking(
    places: Map,
    k: int,
    verifier: Verifier | None,
    sequence: SequenceSearch | None,
    where: Where | str | None,
    *,
    exact: bool = False,
) -> Ask:
    """Return a function that finds k answers: by the map's search, or by `sequence` if given.

    If more than k answers are to be verified, it finds that many, of which `verified` returns k.

    Raises:
        InputError: `where` has conditions that no image meets, or is combined with `sequence`.
    """
    if verifier is not None:
        k = max(k, verifier.verify.answers)
    if where is not None:
        require(sequence is None, f"where: found {where} with a sequence, expected only one")
        places.left_out(where)
    if sequence is None:
        return lambda descriptors, _: places.search(descriptors, k, exact=exact, where=where)
    tracker = SequenceTracker(places, sequence)
    return lambda descriptors, frames: tracker.answer(descriptors, k, frames)


def answers_of(
    places: Map,
    asked: list[pathlib.Path],
    found: Sequence[Sequence[np.ndarray]],
    thresholds: Thresholds,
    **more: Any,
) -> Answers:
    """Join parts found by a function of `asking`; `more` are other fields of `Answers`."""
    indices, similarities, *filtered = map(np.concatenate, zip(*found, strict=True))
    neighbours = Neighbours(indices, similarities)
    more |= dict(zip(("probabilities", "best"), filtered, strict=False))  # of a filter
    more |= dict(zip(("min_similarity", "min_inliers"), thresholds, strict=True))
    return Answers(asked, neighbours, places.images, places.axes, zone=places.zone, **more)


def verified(answers: Answers, verifier: Verifier, images: Iterable[np.ndarray], k: int) -> Answers:
    """Verify answers, rank the verified ones by their inliers, and return k per query.

    Args:
        answers: the answers to verify, from `answers_of`.
        verifier: the verifier.
        images: the images of the queries.
        k: number of answers per query that are returned.

    Raises:
        InputError: answers cannot be verified; see `Verifier.check`.
    """
    indices, similarities = answers.neighbours
    rows = np.tile(np.arange(indices.shape[1]), (len(indices), 1))
    first, checks, poses = verifier.verify.answers, [], []
    for number, image in enumerate(images):
        found = [answers.images[i] for i in indices[number, :first]]
        order, checked, pose = verify_answers(
            verifier, image, found, similarities[number, :first], answers.axes
        )
        rows[number, : len(order)] = order
        checks.append(checked[:k])
        poses.append(pose)

    def ordered(column: np.ndarray) -> Any:
        return np.take_along_axis(column, rows[:, :k], axis=1)

    chances = answers.probabilities
    return answers._replace(
        neighbours=Neighbours(ordered(indices), ordered(similarities)),
        probabilities=None if chances is None else ordered(chances),
        best=similarities[:, 0] if answers.best is None else answers.best,
        checks=checks,
        poses=poses,
    )


def asked_thresholds(
    places: Map, min_similarity: float | None, verifier: Verifier | None
) -> Thresholds:
    """Return the minimum similarity and number of inliers of best answers; None accepts any.

    Args:
        places: the map, whose calibration may have them.
        min_similarity: as in `query`.
        verifier: the verifier, which may set the minimum of inliers; None without verification.

    Raises:
        InputError: the similarity is not a cosine; the calibration is damaged or of another model.
    """
    inliers = None if verifier is None else verifier.verify.min_inliers
    measured = calibration_of(places, verifier) if None in (min_similarity, inliers) else None
    if measured is not None:  # its inliers are 0 if answers were not verified
        min_similarity = measured.min_similarity if min_similarity is None else min_similarity
        inliers = measured.min_inliers if inliers is None else inliers
    if min_similarity is not None:
        check_min_similarity(min_similarity)
        min_similarity = min_similarity if min_similarity > -1 else None
    return min_similarity, inliers or None


def _below_one_root(
    sources: Sequence[ImageSource],
) -> tuple[pathlib.Path, list[list[pathlib.Path]]]:
    """List the images of each source, below a folder that contains them all."""
    roots = {source.root for source in sources}
    if len(roots) == 1:
        return roots.pop(), _runs([source.paths for source in sources])
    if len(set(map(is_remote, roots))) > 1:
        raise InputError("images: found files and addresses, expected only one of the two")
    # As full paths, since relative and absolute ones have no folder in common.
    whole = os.fspath if is_remote(min(roots)) else os.path.abspath
    paths = [[pathlib.Path(whole(path)) for path in source.paths] for source in sources]
    root = pathlib.Path(os.path.commonpath([whole(root) for root in roots]))
    return root, _runs(paths)


def _runs(sources: Sequence[Sequence[pathlib.Path]]) -> list[list[pathlib.Path]]:
    """Join images named one after the other into one source: shells expand a pattern this way."""
    runs: list[list[pathlib.Path]] = []
    for is_one, run in itertools.groupby(sources, lambda paths: len(paths) == 1):
        each = [list(paths) for paths in run]
        runs += [list(itertools.chain(*each))] if is_one else each
    return runs


def position_fields(image: MapImage, axes: tuple[str, str] | None) -> dict[str, float] | None:
    """Return where an image was taken, by the names of the axes; None if unknown."""
    if image.position is None or axes is None:
        return None
    return dict(zip(axes, image.position, strict=True))


def answer_fields(answer: Answer, axes: tuple[str, str] | None) -> dict[str, Any]:
    """Return an answer's rank, name, similarity, position and any other results as JSON values."""
    fields: dict[str, Any] = {
        "rank": answer.rank,
        "name": answer.image.name,
        "similarity": round(answer.similarity, 6),
        "position": position_fields(answer.image, axes),
    }
    if answer.probability is not None:
        fields["probability"] = round(answer.probability, 6)
    if answer.verification is not None:
        fields["verified"] = answer.verification.fields()
    return fields


def json_lines(answers: Answers) -> Iterator[str]:
    """Yield a line of JSON for each query: its name, and its answers' names and positions.

    Names of queries are relative to their source, like those of a map's images. Frames of videos
    also have a `time` in seconds, and UTM metres their `zone`. If answers must meet a threshold,
    the line says whether the query is of a `known` place; the answers of an unknown one are still
    listed. Unprintable characters in a name, or bytes that are not UTF-8, are escaped.
    """
    return map(json_text, json_rows(answers))


def json_rows(answers: Answers) -> Iterator[dict[str, Any]]:
    """Yield the contents of each line of `json_lines`, as JSON values by name."""
    zone = {} if answers.zone is None else {"zone": str(answers.zone)}
    poses = answers.poses or [None] * len(answers.queries)
    columns = answers.names, answers.known, poses, answers.rows()
    for name, known, pose, (path, found) in zip(*columns, strict=True):
        neighbours = [answer_fields(x, answers.axes) | _time(x.image.name) for x in found]
        row = {"query": name, **_time(path), **zone, "neighbours": neighbours}
        if pose is not None:
            at = dict(zip(answers.axes or (), pose.position, strict=True))
            row["pose"] = {"position": at, "heading": round(pose.heading, 2)}
        yield row | {"known": bool(known)} if answers.is_thresholded else row


def _time(name: str | os.PathLike[str]) -> dict[str, float]:
    seconds = frame_time(name)
    return {} if seconds is None else {"time": seconds}


def json_text(row: dict[str, Any]) -> str:
    """Return a row as one line of JSON."""
    text = json.dumps(row, ensure_ascii=False)
    return text if text.isprintable() else json.dumps(row)
