"""A comparison from its configuration to its tables."""

import os
import pathlib
import warnings
from collections.abc import Callable

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.experiments.comparison.ablation import adapter_costs_once
from crisalad_jax.experiments.comparison.page import write_page
from crisalad_jax.experiments.comparison.plan import ComparisonConfig, prepare, without_unreadable
from crisalad_jax.experiments.comparison.runner import carry_out, runs_left
from crisalad_jax.experiments.comparison.summary import Summary, summarise
from crisalad_jax.experiments.comparison.tables import markdown, put_in_page, write_tables
from crisalad_jax.experiments.comparison.workers import run_jobs
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_target, real_path, split_markers
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import Note


@takes(config=ComparisonConfig, out=PATH)
def compare(
    config: ComparisonConfig,
    out: str | os.PathLike[str],
    *,
    page: str | os.PathLike[str] | None = None,
    on_bad_image: OnBadImage = "stop",
    jobs: int = 1,
    say: Callable[[str], None] = lambda line: None,
    quiet: bool = False,
) -> Summary:
    """Train or load the methods of a comparison, evaluate them alike, and write the tables.

    Everything is checked before any work, as far as it can be. The same call resumes after a kill.
    It also goes on with a folder that holds a part of the comparison, or more: methods, rows, seeds
    and sets may be added. Several hosts that share the folder may make the same call, and share
    the runs.

    Args:
        config: what to compare.
        out: the folder. Beside the runs it holds table.md, table.csv, results.json and the page
            index.html.
        page: a Markdown page that gets the tables too, between its comments <!-- NAME --> and
            <!-- end of NAME -->, where NAME is the name of the folder.
        on_bad_image: "stop" at an unreadable image, or "skip" it: training masks it out, and the
            sets are compared on without it. Each call reads all images of the sets to find them.
        jobs: number of runs at once, each in a process with its share of this host's devices; no
            more than runs are left, and a single one is done by this process.
        say: is given a line at the start and before each run.
        quiet: whether to show no progress bars.

    Returns:
        The results, as the tables show them.

    Raises:
        InputError: what `prepare`, `carry_out` and `summarise` raise; or the page has no place for
            the tables.
        Interrupted: a signal asked for the end; the same call resumes.
    """
    out = pathlib.Path(out)
    check_target(out / "config.json")
    place = real_path(out).name
    if page is not None:
        split_markers(pathlib.Path(page), place)
    if jobs < 1:
        raise InputError(f"--jobs: found {jobs}, expected at least 1")
    jobs = min(jobs, runs_left(config, out))
    with warnings.catch_warnings():
        if jobs > 1:
            run_jobs(config, out, jobs, on_bad_image=on_bad_image, say=say)
            warnings.simplefilter("ignore", Note)  # the processes have told them
        prepared = prepare(config, on_bad_image)
    prepared, left_out = without_unreadable(prepared, on_bad_image, quiet=quiet)
    carry_out(prepared, out, say=say, quiet=quiet)
    with lock(out, wait=True):
        # Table 3 belongs to the paper's rows, and takes a minute.
        papers = config.kind == "ablate" and not config.rows
        adapters = adapter_costs_once(out) if papers else []
        summary = summarise(prepared, out, adapters)
        summary.notes.extend(left_out)
        write_tables(summary, out)
        write_page(summary, out)
    if page is not None:
        put_in_page(pathlib.Path(page), place, markdown(summary))
    return summary
