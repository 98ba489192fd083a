"""A comparison from its configuration to its tables."""

import os
import pathlib
from collections.abc import Callable

from crisalad_jax.data.benchmarks.readable import leave_out_unreadable
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.experiments.comparison.ablation import adapter_costs_once
from crisalad_jax.experiments.comparison.page import write_page
from crisalad_jax.experiments.comparison.plan import ComparisonConfig, prepare
from crisalad_jax.experiments.comparison.runner import carry_out
from crisalad_jax.experiments.comparison.summary import Summary, summarise
from crisalad_jax.experiments.comparison.tables import markdown, put_in_page, write_tables
from crisalad_jax.utils.files import around, check_target, real_path


def compare(
    config: ComparisonConfig,
    out: str | os.PathLike[str],
    *,
    page: str | os.PathLike[str] | None = None,
    on_bad_image: OnBadImage = "stop",
    say: Callable[[str], None] = lambda line: None,
    quiet: bool = False,
) -> Summary:
    """Train or load the methods of a comparison, evaluate them alike, and write the tables.

    Everything is checked before any work, as far as it can be. The same call resumes after a kill.

    Args:
        config: what to compare.
        out: the folder. Beside the runs it holds table.md, table.csv, results.json and the page
            index.html.
        page: a Markdown page that gets the tables too, between its comments <!-- NAME --> and
            <!-- end of NAME -->, where NAME is the name of the folder.
        on_bad_image: "stop" at an unreadable image, or "skip" it: training masks it out, and the
            sets are compared on without it. Each call reads all images of the sets to find them.
        say: is given a line at the start and before each run.
        quiet: whether to show no progress bars.

    Returns:
        The results, as the tables show them.

    Raises:
        InputError: what `prepare`, `carry_out` and `summarise` raise; or the page has no place for
            the tables.
        Stopped: a signal asked for the end; the same call resumes.
    """
    out = pathlib.Path(out)
    check_target(out / "config.json")
    place = real_path(out).name
    if page is not None:
        around(pathlib.Path(page), place)
    prepared = prepare(config)
    left_out: list[str] = []
    if on_bad_image == "skip":
        readable = [leave_out_unreadable(each, quiet=quiet) for each in prepared.benchmarks]
        for before, after in zip(prepared.benchmarks, readable, strict=True):
            queries = len(before.queries) - len(after.queries)
            database = len(before.database) - len(after.database)
            if queries or database:
                left_out.append(
                    f"{before.name}: unreadable and left out: {queries} queries and {database} "
                    "database images."
                )
        prepared = prepared._replace(benchmarks=readable, on_bad_image=on_bad_image)
    carry_out(prepared, out, say=say, quiet=quiet)
    adapters = adapter_costs_once(out) if config.kind == "ablate" else []
    summary = summarise(prepared, out, adapters)
    summary.notes.extend(left_out)
    write_tables(summary, out)
    write_page(summary, out)
    if page is not None:
        put_in_page(pathlib.Path(page), place, markdown(summary))
    return summary
