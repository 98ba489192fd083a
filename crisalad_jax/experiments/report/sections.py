"""The sections of a page: words and pictures, which are written as files and embedded."""

import math
import pathlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.metres import flattened
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.report.curves import PrecisionCurve, precision_curves, recall_curves
from crisalad_jax.experiments.report.embedding import Drawing, drawing, webp
from crisalad_jax.experiments.report.gallery import prediction_gallery, thumbnail
from crisalad_jax.experiments.report.placeholders import Placed, find_placed
from crisalad_jax.experiments.report.positions import position_map
from crisalad_jax.experiments.report.query_selection import Shown, Verdicts, judge
from crisalad_jax.experiments.report.similarity import similarity_matrix
from crisalad_jax.retrieval.neighbours import Neighbours

RETRIEVALS = 4
"""Number of retrievals shown for each query."""
_THUMBNAIL = 320


class Subject(NamedTuple):
    """The evaluation that all sections show, and the folder of their pictures."""

    out: pathlib.Path
    benchmark: Benchmark
    neighbours: Neighbours
    verdicts: Verdicts
    placed: Placed | None = None
    """Which images have a likely position; None where none has one."""

    @classmethod
    def of(cls, out: pathlib.Path, benchmark: Benchmark, neighbours: Neighbours) -> "Subject":
        """Judge an evaluation's retrievals and positions."""
        places, asked = benchmark.database_positions, benchmark.query_positions
        placed = None if places is None or asked is None else find_placed(places, asked)
        verdicts = judge(neighbours, benchmark.ground_truth())
        return cls(out, benchmark, neighbours, verdicts, placed)

    @property
    def has_positions(self) -> bool:
        """Whether the positions of both sides' images are known."""
        return self.placed is not None

    def name(self, path: pathlib.Path) -> str:
        """Name a file of the benchmark by its path in the benchmark's folder."""
        root = self.benchmark.root
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name

    def metres(self, query: int, index: int) -> float | None:
        """Measure the metres from a query to a database image; None without likely positions."""
        places, asked = self.benchmark.database_positions, self.benchmark.query_positions
        if places is None or asked is None or self.placed is None:
            return None
        if not (self.placed.queries[query] and self.placed.database[index]):
            return None
        return math.dist(asked[query], places[index])


class Photograph(NamedTuple):
    """A small photograph in a gallery."""

    uri: str
    width: int
    height: int
    alt: str
    kind: str
    """One of query, right, wrong and expected."""
    lines: tuple[str, ...]


class Retrieval(NamedTuple):
    """A query and what was retrieved for it."""

    file: str
    photographs: list[Photograph]


class Gallery(NamedTuple):
    """Some queries of one kind."""

    name: str
    title: str
    words: str
    total: int
    retrievals: list[Retrieval]


def curves(subject: Subject, groupings: Sequence[GroupingResult]) -> list[Drawing]:
    """Draw recall by K and, where it is known, precision by recall: a line for each grouping."""
    best = "; ".join(f"{g.label} {100 * g.recalls[min(g.recalls)]:.1f} %" for g in groupings)
    path = subject.out / "recall_curves.png"
    recall_curves(path, {g.label: g.recalls for g in groupings}, "", narrow=True)
    drawings = [drawing(path, f"Recall at K against K. At K = 1: {best}")]
    known = {
        g.label: PrecisionCurve(g.precision_recall.precision, g.precision_recall.recall)
        for g in groupings
        if g.precision_recall is not None
    }
    if known:
        path = subject.out / "precision_recall.png"
        precision_curves(path, known)
        drawings.append(drawing(path, f"Precision against recall: {', '.join(known)}"))
    return drawings


_GALLERIES = {
    "right": ("Right", "The first retrieval is right; from the most to the least confident."),
    "wrong": (
        "Wrong",
        "The last picture would have been right. The most confident mistakes come first.",
    ),
    "unmatched": (
        "Nothing to find",
        "No database image is right for these queries; the most confident retrievals first.",
    ),
}


def galleries(subject: Subject, shown: Shown) -> Iterator[Gallery]:
    """Yield the queries shown of each kind, as pictures in the page; write a PNG of each kind."""
    totals = {
        "right": subject.verdicts.right,
        "wrong": subject.verdicts.wrong,
        "unmatched": ~subject.verdicts.matched,
    }
    benchmark = subject.benchmark
    for kind, queries in shown._asdict().items():
        if not queries:
            continue
        title, words = _GALLERIES[kind]
        prediction_gallery(
            subject.out / f"gallery_{kind}.png",
            benchmark.queries,
            benchmark.database,
            *subject.neighbours,
            benchmark.ground_truth(),
            columns=RETRIEVALS,
            chosen=queries,
            title=f"{benchmark.name}: {title.lower()}",
        )
        retrievals = [_retrieval(subject, query) for query in queries]
        yield Gallery(kind, title, words, int(totals[kind].sum()), retrievals)


def _retrieval(subject: Subject, query: int) -> Retrieval:
    benchmark, positives = subject.benchmark, subject.benchmark.ground_truth()[query]
    path = benchmark.queries[query]
    photographs = [_photograph(subject, path, "query", ("query",), "query")]
    indices = subject.neighbours.indices[query]
    similarities = subject.neighbours.similarities[query]
    for rank, (index, similarity) in enumerate(
        zip(indices[:RETRIEVALS], similarities[:RETRIEVALS], strict=True), 1
    ):
        kind = "right" if index in positives else "wrong"
        lines = f"{rank}", f"{similarity:.3f}", *_metres(subject.metres(query, index))
        words = f"retrieval {rank}, {kind}"
        photographs.append(_photograph(subject, benchmark.database[index], kind, lines, words))
    if subject.verdicts.wrong[query]:
        photographs.append(_expected(subject, query))
    return Retrieval(subject.name(path), photographs)


def _expected(subject: Subject, query: int) -> Photograph:
    """Show what should have come first: the best retrieved positive, or else the nearest one."""
    positives = subject.benchmark.ground_truth()[query]
    indices = subject.neighbours.indices[query]
    ranks = np.flatnonzero(np.isin(indices, positives))
    if ranks.size:
        index, rank = int(indices[ranks[0]]), f"rank {ranks[0] + 1}"
    else:
        away = [subject.metres(query, int(index)) or 0 for index in positives]
        index, rank = int(positives[np.argmin(away)]), f"not in the first {len(indices)}"
    lines = "would be right", rank, *_metres(subject.metres(query, index))
    path = subject.benchmark.database[index]
    return _photograph(subject, path, "expected", lines, f"right for the query, {rank}")


def _metres(distance: float | None) -> tuple[str, ...]:
    if distance is None:
        return ()
    return (f"{distance:,.0f} m" if distance < 10_000 else f"{distance / 1000:,.0f} km",)


def _photograph(
    subject: Subject, path: pathlib.Path, kind: str, lines: tuple[str, ...], words: str
) -> Photograph:
    image = thumbnail(read_image(path, bit_depth="contrast-stretch"), _THUMBNAIL)
    height, width = image.shape[:2]
    alt = f"{words}: {subject.name(path)}"
    return Photograph(webp(image), width, height, alt, kind, lines)


class PositionsMap(NamedTuple):
    """The map, and what is not on it."""

    drawing: Drawing
    note: str
    """Empty where all images are on it."""


def positions_map(subject: Subject) -> PositionsMap | None:
    """Draw the map of all images; None where the benchmark has no positions."""
    places, asked = subject.benchmark.database_positions, subject.benchmark.query_positions
    placed = subject.placed
    if places is None or asked is None or placed is None:
        return None
    places, asked = np.split(flattened(np.concatenate([places, asked])), [len(places)])
    path = subject.out / "positions.png"
    verdicts, first = subject.verdicts, subject.neighbours.indices[:, 0]
    position_map(path, places, asked, first, verdicts.right, verdicts.matched, placed)
    words = (
        f"Map of {len(places)} database images and "
        f"{len(asked)} queries, of which {verdicts.right.sum()} are right and "
        f"{verdicts.wrong.sum()} wrong"
    )
    queries, database = int((~placed.queries).sum()), int((~placed.database).sum())
    note = ""
    if queries or database:
        note = (
            f"Left out: {queries:,} queries and {database:,} database images, whose positions are "
            f"placeholders or over {placed.limit / 1000:,.0f} km from the rest."
        )
    return PositionsMap(drawing(path, words), note)


def matrix(
    subject: Subject, similarities: Float[np.ndarray, "rows columns"] | None
) -> Drawing | None:
    """Draw the similarities of all queries and the whole database; None where they are unknown."""
    if similarities is None:
        return None
    path = subject.out / "similarities.png"
    benchmark, first = subject.benchmark, subject.neighbours.indices[:, 0]
    count = len(benchmark.database)
    similarity_matrix(path, similarities, benchmark.ground_truth(), first, count)
    words = f"Similarities of {len(benchmark.queries)} queries (rows) and {count} database images"
    return drawing(path, words)
