"""One HTML page of an evaluation, which embeds its pictures and loads nothing from the network."""

import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.operating_point import OperatingPoint, caveats
from crisalad_jax.evaluation.results import ANY, GroupingResult, percent
from crisalad_jax.experiments.report import sections
from crisalad_jax.experiments.report.query_selection import Verdicts, choose_shown
from crisalad_jax.experiments.report.results_table import (
    OUTCOMES,
    RESULTS,
    page_rows,
    write_results,
)
from crisalad_jax.experiments.report.sections import Subject
from crisalad_jax.experiments.report.tables import check_fractions
from crisalad_jax.experiments.report.transport_section import transport_section
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.retrieval.grouping import GROUPINGS, Grouping
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import staged_folder

PAGE = "index.html"
ESCAPED = "backslashreplace"
"""How pages and tables are encoded: bytes of names that are no UTF-8 become escapes."""


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
    """Write index.html, its PNGs and results.csv into the folder `out`; return the page's path.

    Retrievals, map and matrix are those of the first grouping; results.csv has a row for every
    query under every grouping.

    Args:
        out: the folder, made where it is missing. Files of the same names are replaced.
        benchmark: what was evaluated on.
        groupings: the results, at least one.
        params: the model's, for the section on its transport; a model without one has none.
        config: the model's.
        model_name: which weights.
        settings: the evaluation's settings as JSON values, shown folded.
        similarities: what `similarity.similarity_map` gives of the first grouping.

    Raises:
        InputError: no groupings or ground truth, a recall outside 0 to 1, an image that cannot be
            read, or files that cannot be written: then none of them is.
    """
    if not groupings:
        raise InputError("groupings: found none, expected at least one")
    for grouping in groupings:
        check_fractions(grouping.label, grouping.recalls)
    with staged_folder(out) as folder:
        _write(folder, benchmark, groupings, params, config, model_name, settings, similarities)
    return pathlib.Path(out) / PAGE


def _write(
    folder: pathlib.Path,
    benchmark: Benchmark,
    groupings: Sequence[GroupingResult],
    params: Crisalad,
    config: ModelConfig,
    model_name: str,
    settings: Mapping[str, Any],
    similarities: Float[np.ndarray, "rows columns"] | None,
) -> None:
    neighbours = groupings[0].neighbours
    subject = Subject.of(folder, benchmark, neighbours)
    verdicts = subject.verdicts
    shown = choose_shown(neighbours.similarities[:, 0], verdicts)
    write_results(folder / RESULTS, subject, groupings)
    context = {
        "title": benchmark.name,
        "model_name": model_name,
        "facts": _facts(benchmark, config, verdicts),
        "main": groupings[0],
        "table": _table(groupings),
        "meanings": _meanings(groupings),
        "notes": _notes(groupings),
        "depends": params.cross_image is not None,
        "curves": sections.curves(subject, groupings),
        "galleries": list(sections.galleries(subject, shown)),
        "results": page_rows(subject, groupings[0]),
        "outcomes": OUTCOMES,
        "kept": neighbours.indices.shape[1],
        "metres": subject.has_positions,
        "map": sections.positions_map(subject),
        "transport": transport_section(subject, shown, params, config),
        "matrix": sections.matrix(subject, similarities),
        "settings": json.dumps(settings, indent=2),
    }
    (folder / PAGE).write_text(render(context), encoding="utf-8", errors=ESCAPED)


def render(context: Mapping[str, Any], template: str = "page.html") -> str:
    """Render a page from a template; everything in the context is escaped, names of files too."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("crisalad_jax.experiments.report"),
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
    """Text below it, in small letters."""


def _table(groupings: Sequence[GroupingResult]) -> tuple[list[str], list[list[_Cell]]]:
    """Make headers, and a row of cells for each grouping, without columns that all lack."""
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
    points = [g.operating_point for g in groupings]
    if asked := next((f"{100 * point.asked:g}" for point in points if point is not None), None):
        headers.append(f"at {asked} %")
        for row, point in zip(rows, points, strict=True):
            row.append(_Cell("\N{EN DASH}") if point is None else _point_cell(point))
    return headers, rows


def _point_cell(point: OperatingPoint) -> _Cell:
    if not point.reached:
        return _Cell("\N{EN DASH}", f"highest precision {percent(point.precision)}")
    return _Cell(percent(point.recall), f"similarity from {point.min_similarity:.9g}")


def _meanings(groupings: Sequence[GroupingResult]) -> list[tuple[str, str]]:
    """Explain which images look at each other, for every kind of grouping in the results."""
    named = [Grouping.parse(g.grouping) for g in groupings if g.grouping != ANY]
    kinds = dict.fromkeys(kind for each in named for kind in (each.queries, each.database))
    meanings = [(kind, GROUPINGS[kind]) for kind in kinds]
    if any(each.queries != each.database for each in named):
        meanings.append(("a/b", "queries by a, database by b"))
    return meanings


def _notes(groupings: Sequence[GroupingResult]) -> str:
    """Explain the small letters of the table."""
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
    asked = next((g.operating_point.asked for g in groupings if g.operating_point), None)
    if asked is not None:
        notes.append(
            f"At {100 * asked:g} %: the share of all queries that is answered rightly, where first "
            "retrievals from the similarity below it on are answers, and so many of them are right."
        )
    for g in groupings:
        if g.operating_point is not None:
            notes += [f"{g.label}: {words}." for words in caveats(g.operating_point)]
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
    unmatched = int((~verdicts.matched).sum())
    note = f", {unmatched} of them without a positive" if unmatched else ""
    return [
        ("Queries", f"{len(benchmark.queries):,}{note}"),
        ("Database", f"{len(benchmark.database):,} images"),
        ("Positive", benchmark.rule),
        ("Images", config.images_in_words),
        ("Descriptor", f"{config.descriptor_dim:,} numbers"),
    ]
