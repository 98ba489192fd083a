"""One HTML page of an evaluation: it holds all it shows, and asks for nothing on the network."""

import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from crisalad_jax.config import ModelConfig
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.errors import InputError
from crisalad_jax.files import atomic_path
from crisalad_jax.groupings import GROUPINGS, Grouping
from crisalad_jax.model import Crisalad
from crisalad_jax.report import sections
from crisalad_jax.report.choice import Verdicts, choose_shown, judge
from crisalad_jax.report.kept import transport_section
from crisalad_jax.report.sections import Subject
from crisalad_jax.report.tables import check_fractions
from crisalad_jax.results import ANY, GroupingResult, percent

PAGE = "index.html"


def write_report(
    out: str | os.PathLike[str],
    benchmark: Benchmark,
    groupings: Sequence[GroupingResult],
    *,
    params: Crisalad,
    config: ModelConfig,
    model_name: str,
    settings: Mapping[str, Any],
    similarities: Float[np.ndarray, "rows columns"] | None = None,
) -> pathlib.Path:
    """Write index.html and its PNGs into the folder `out`; the page's path.

    Retrievals, map and matrix are those of the first grouping.

    Args:
        out: the folder, made where it is missing. Files of the same names are replaced.
        benchmark: what was evaluated on.
        groupings: the results, at least one.
        params: of the model, which shows what its transport kept; of one without SALAD nothing.
        config: of the model.
        model_name: which weights.
        settings: what was asked for, as JSON values, for a fold.
        similarities: what `similarity.similarity_map` gives of the first grouping.

    Raises:
        InputError: no groupings or ground truth, a recall outside 0 to 1, or an image that cannot
            be read.
    """
    if not groupings:
        raise InputError("groupings: found none, expected at least one")
    for grouping in groupings:
        check_fractions(grouping.label, grouping.recalls)
    neighbours = groupings[0].neighbours
    verdicts = judge(neighbours, benchmark.ground_truth())
    shown = choose_shown(neighbours.similarities[:, 0], verdicts)
    subject = Subject(pathlib.Path(out), benchmark, neighbours, verdicts)
    context = {
        "title": benchmark.name,
        "model_name": model_name,
        "facts": _facts(benchmark, config, verdicts),
        "main": groupings[0],
        "table": _table(groupings),
        "meanings": _meanings(groupings),
        "notes": _notes(groupings),
        "depends": params.encoder is not None,
        "curves": sections.curves(subject, groupings),
        "galleries": list(sections.galleries(subject, shown)),
        "metres": subject.has_positions,
        "map": sections.positions_map(subject),
        "transport": transport_section(subject, shown, params, config),
        "matrix": sections.matrix(subject, similarities),
        "settings": json.dumps(settings, indent=2),
    }
    path = subject.out / PAGE
    with atomic_path(path) as temporary:
        temporary.write_text(render(context), encoding="utf-8")
    return path


def render(context: Mapping[str, Any], template: str = "page.html") -> str:
    """The text of a page. Everything in the context is escaped: names of files are anyone's."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("crisalad_jax.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = percent
    return environment.get_template(template).render(context)


class _Cell(NamedTuple):
    text: str
    note: str = ""
    """Below it, in small letters."""


def _table(groupings: Sequence[GroupingResult]) -> tuple[list[str], list[list[_Cell]]]:
    """Headers, and a row of cells for each grouping; a column that all lack is left out."""
    ks = sorted({k for grouping in groupings for k in grouping.recalls})
    headers = ["grouping", *(f"R@{k}" for k in ks)]
    rows = [[_Cell(g.label), *(_recall(g, k) for k in ks)] for g in groupings]
    shares = [(g.query_share, g.database_share) for g in groupings]
    if any(share is not None for pair in shares for share in pair):
        headers.append("same place, queries / database")
        for row, pair in zip(rows, shares, strict=True):
            row.append(_Cell(" / ".join("\N{EN DASH}" if s is None else percent(s) for s in pair)))
    for header, values in {
        "AP": [g.average_precision for g in groupings],
        "recall at 100 % precision": [g.recall_at_full_precision for g in groupings],
    }.items():
        if any(value is not None for value in values):
            headers.append(header)
            for row, value in zip(rows, values, strict=True):
                row.append(_Cell("\N{EN DASH}" if value is None else percent(value)))
    return headers, rows


def _meanings(groupings: Sequence[GroupingResult]) -> list[tuple[str, str]]:
    """Which images look at each other, of every kind of grouping that there is."""
    named = [Grouping.parse(g.grouping) for g in groupings if g.grouping != ANY]
    kinds = dict.fromkeys(kind for each in named for kind in (each.queries, each.database))
    meanings = [(kind, GROUPINGS[kind]) for kind in kinds]
    if any(each.queries != each.database for each in named):
        meanings.append(("a/b", "queries by a, database by b"))
    return meanings


def _notes(groupings: Sequence[GroupingResult]) -> str:
    """What the small letters of the table are."""
    notes = []
    if any(g.intervals for g in groupings):
        notes.append("Below a recall stands its 95 % interval over the queries.")
    if any(g.spread for g in groupings):
        notes.append("± is the standard deviation over random orders.")
    if any(g.query_share is not None or g.database_share is not None for g in groupings):
        notes.append(
            "Same place: of the images in sight, in percent, those that show the image's own place."
        )
    if any(g.average_precision is not None for g in groupings):
        notes.append("AP: the area under precision and recall of the first retrievals.")
    return " ".join(notes)


def _recall(grouping: GroupingResult, k: int) -> _Cell:
    if k not in grouping.recalls:
        return _Cell("\N{EN DASH}")
    notes = []
    if grouping.spread is not None:
        notes.append(f"± {percent(grouping.spread.recalls[k])}")
    if k in grouping.intervals:
        notes.append("\N{EN DASH}".join(map(percent, grouping.intervals[k])))
    return _Cell(percent(grouping.recalls[k]), "\n".join(notes))


def _facts(benchmark: Benchmark, config: ModelConfig, verdicts: Verdicts) -> list[tuple[str, str]]:
    height, width = config.image_size
    unmatched = int((~verdicts.matched).sum())
    note = f", {unmatched} of them without a positive" if unmatched else ""
    return [
        ("Queries", f"{len(benchmark.queries):,}{note}"),
        ("Database", f"{len(benchmark.database):,} images"),
        ("Positive", benchmark.rule),
        ("Images", f"resized to {height} x {width} pixels"),
        ("Descriptor", f"{config.descriptor_dim:,} numbers"),
    ]
