"""Tables that the commands print."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from crisalad_jax.checkpoints.cache import is_cached
from crisalad_jax.checkpoints.published import GITHUB, Published
from crisalad_jax.data.sets import CheckedPart, PublishedSet
from crisalad_jax.experiments.tables import NOTHING, Cell, Table
from crisalad_jax.nn.costs import PartCost
from crisalad_jax.training.summary import ModelSummary
from crisalad_jax.utils.output import printable


def summary_table(summary: ModelSummary, name: str) -> Table:
    """Make a table of a model's parts; `name` is the model's name."""
    height, width = summary.image_size
    whole = PartCost("all", *(sum(each) for each in list(zip(*summary.parts, strict=True))[1:]))
    rows = [
        [Cell(cost.part), Cell(f"{cost.parameters:,}"), Cell(f"{cost.macs:,}")]
        for cost in (*summary.parts, whole)
    ]
    headers = ["part", "parameters", "multiply-accumulates an image"]
    return Table(headers, rows, title=printable(f"{name} at {height} x {width}"), summed=True)


def models_table(models: Sequence[Published]) -> Table:
    """Make a table of published models; those in the cache have a star."""
    rows = [
        (
            f"{model.name} *" if is_cached(model) else model.name,
            model.licence.name,
            model.images,
            model.repository.removeprefix(GITHUB),
            f"{model.descriptor:,}",
            f"{model.parameters / 1e6:,.1f} M",
        )
        for model in models
    ]
    headers = ["name", "licence", "images", "GitHub", "descriptor", "parameters"]
    return Table(headers, [list(map(Cell, row)) for row in rows], labels=4)


def sets_table(sets: Sequence[PublishedSet]) -> Table:
    """Make a table of public data sets."""
    rows = []
    for each in sets:
        counts = [
            " + ".join(NOTHING if count is None else f"{count:,}" for count in numbers)
            for part in each.parts
            if any(numbers := (part.database, part.queries))
        ]
        size = "not known" if each.gigabytes is None else f"{each.gigabytes} GB"
        fetched = "fetch" if each.is_fetched else "by hand"
        licence = each.licence or "not known"
        rows.append([each.name, each.title, fetched, each.host, licence, size, "; ".join(counts)])
    headers = ["name", "set", "how", "where", "licence", "size", "database + queries"]
    return Table(headers, [list(map(Cell, row)) for row in rows], labels=5)


def checked_table(parts: Sequence[CheckedPart]) -> Table:
    """Make a table of what a folder of images contains, with a row for each part of the set."""
    rows = []
    for part in parts:
        counts = [
            NOTHING if count is None else f"{count:,}" for count in (part.database, part.queries)
        ]
        verdict = (
            "does not match"
            if part.problem
            else "as published"
            if part.known
            else "nothing to compare"
        )
        rows.append([Cell(each) for each in (part.name, part.known or NOTHING, verdict, *counts)])
    headers = ["part", "published as", "verdict", "images", "queries or places"]
    return Table(headers, rows, labels=2 + 1)


_MOST = 10
"""Maximum rows to list for a fact."""


def fact_lines(facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines to print for facts: one each, or one per object of a list, up to ten of them."""
    width = max(map(len, facts))
    for name, value in facts.items():
        is_table = isinstance(value, list) and all(isinstance(each, dict) for each in value)
        rows = value if is_table else [value]
        more = [f"and {len(rows) - _MOST} more"] if len(rows) > _MOST else []
        for number, row in enumerate([*rows[:_MOST], *more]):
            yield f"{'' if number else name:<{width}}  {_words(row)}"


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value))
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    return f"{value:,}" if isinstance(value, int) else value or "-"
