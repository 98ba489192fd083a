"""Settings of an evaluation, as JSON and as text, without which its recalls mean nothing."""

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

from crisalad_jax.checkpoints import starter
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.evaluate import same_place_rule
from crisalad_jax.evaluation.operating_point import caveats
from crisalad_jax.evaluation.protocols import protocol_notes
from crisalad_jax.evaluation.results import ANY, GroupingResult, to_json
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.grouping import Grouping, grouping_words

_RECALLS = (
    "Percent of all queries; below, the 95 % bootstrap interval, as if queries were independent. "
    "AP: area under the precision-recall curve of first retrievals, by similarity. R at 100 % P: "
    "share of the queries with a positive whose correct first retrieval is above every wrong one."
)


class Record(NamedTuple):
    """What is written and printed for an evaluation, in addition to its tables."""

    settings: dict[str, Any]
    """All settings that decide the results, as JSON values by name."""
    notes: list[str]
    """Paragraphs that explain the tables, from `table_notes`."""
    values: dict[str, Any]
    """The settings, the results and the skipped images, as JSON values by name."""


def evaluation_record(
    results: Sequence[GroupingResult],
    benchmark: Benchmark,
    config: ModelConfig,
    *,
    model_name: str,
    **asked: Any,
) -> Record:
    """Record the results of an evaluation, with its settings.

    Args:
        results: what `evaluate` returned.
        benchmark: the evaluated benchmark.
        config: the model's configuration.
        model_name: name of the model, written into each result.
        **asked: the options of `crisalad evaluate`: the files `weights` (None for an untrained
            model), `pca`, and `rerank_weights` (None for the weights of the first stage); and
            `groupings`, `batch_size`, `seed`, `seeds`, `dtype` and `rerank`.

    Returns:
        The record, whose settings `write_report` takes.

    Example:
        >>> import shutil
        >>> import crisalad_jax as cj
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> lines = ["query,database", *(f"{number}.png,{number}.png" for number in range(4))]
        >>> _ = (folder / "set" / "ground_truth.csv").write_text("\\n".join(lines))
        >>> benchmark = cj.open_benchmark(folder / "set", layout="folders")
        >>> model, quiet = cj.load("starter"), cj.Reading(quiet=True)
        >>> results = cj.evaluate(model, benchmark, groupings=["single"], reading=quiet)
        >>> asked = {"model_name": "starter", "batch_size": 4, "seed": 0, "seeds": 1}
        >>> record = evaluation_record(results, benchmark, model.config, **asked)
        >>> record.values["results"][0]["model"]
        'starter'
    """
    files = {name: each for name, each in asked.items() if isinstance(each, os.PathLike)}
    settings = {
        **asked,
        **{name: starter.named(file) for name, file in files.items()},
        "benchmark": benchmark.name,
        "rule": benchmark.rule,
        "same_place": same_place_rule(benchmark),
        "model": to_plain(config),
    }
    names = {"benchmark": benchmark.name, "model": model_name}
    skipped = {
        side: [str(getattr(benchmark, side)[number]) for number in numbers]
        for side, numbers in results[0].skipped._asdict().items()
    }
    rows = [names | to_json(result) for result in results]
    values = settings | {"results": rows, "skipped": skipped}
    return Record(settings, table_notes(results, settings), values)


def table_notes(results: Sequence[GroupingResult], settings: dict[str, Any]) -> list[str]:
    """Explain a table of results as text, with a paragraph for each topic.

    Args:
        results: what `evaluate` returned.
        settings: the settings in the `Record` of these results.

    Returns:
        The paragraphs.
    """
    notes = [_RECALLS]
    skipped = results[0].skipped
    if any(skipped):
        notes.append(
            f"Unreadable and left out: {len(skipped.queries)} queries and {len(skipped.database)} "
            "database images. All results are for the rest; a query whose positives were all left "
            "out counts as a miss."
        )
    parsed = [Grouping.parse(each.grouping) for each in results if each.grouping != ANY]
    kinds = dict.fromkeys(kind for each in parsed for kind in (each.queries, each.database))
    if kinds:
        sized = "; after @ a separate size" if any(each.batch_size for each in parsed) else ""
        notes.append(
            "A descriptor of this model depends on the images in its batch of "
            f"{settings['batch_size']}{sized}: {grouping_words(kinds)}. Same place: share of the "
            f"others an image attends to that show its own place, by {settings['same_place']}. "
            "Mirrored: share of the others in a query's batch whose place is also in its correct "
            "answer's batch; what both batches show identifies that part of the sequence."
        )
        notes += protocol_notes(settings.get("groupings", ()))
    else:
        notes.append("No cross-image encoder: no descriptor depends on its batch.")
    if settings.get("dtype") == "bits":
        notes.append(
            "Bits: descriptors are compared by their signs. If h of d bits differ, the "
            "similarity is 1 - 2 h / d."
        )
    if "shuffled" in kinds and settings["seeds"] > 1:
        notes.append(
            f"Shuffled: mean of {settings['seeds']} seeds ± their standard deviation; the interval "
            "is of the mean."
        )
    for label in dict.fromkeys(each.rerank for each in results if each.rerank is not None):
        notes.append(
            f"+ {label}: the first {label.partition(':')[2]} retrievals by its scores, which "
            "replace similarities in AP and R at 100 % P."
        )
    points = {each.label: each.operating_point for each in results if each.operating_point}
    if points:
        notes.append(
            "Similarity threshold: at or above it, first retrievals have the requested precision "
            "on these queries, on which it was chosen. A query without a positive is an "
            "unknown place, and wrong when answered. 95 % bound: the lower bound of that "
            "precision by Clopper and Pearson."
        )
        notes += [f"{name}: {words}." for name, point in points.items() for words in caveats(point)]
    return notes
