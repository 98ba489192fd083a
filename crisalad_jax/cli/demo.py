"""`crisalad demo`."""

import pathlib
from typing import Annotated, Any

from crisalad_jax.cli.common import echo, show_tables
from crisalad_jax.cli.flags import FOLDER, QuietFlag, TableFlags
from crisalad_jax.retrieval.grouping import grouping_words


class Demo(TableFlags, QuietFlag):
    """Render a synthetic city, train a tiny model on it, and show Recall@K before and after."""

    out: Annotated[pathlib.Path, FOLDER] = pathlib.Path("demo")
    """Folder for the city, the run, the tables and the pictures."""
    seed: int = 0
    """Seed of the city and the run."""


def run(arguments: Demo) -> dict[str, Any]:
    """Run the demo, and print its table; return the result for --json."""
    from crisalad_jax.experiments.demo import GROUPINGS, DemoConfig, run_demo
    from crisalad_jax.experiments.report import recall_table

    summary = run_demo(DemoConfig(seed=arguments.seed), arguments.out, quiet=arguments.quiet)
    table = recall_table(summary.rows, "Recall@K in percent, synthetic city")
    show_tables(table, latex=arguments.latex)
    echo(f"A descriptor of this model may depend on its batch: {grouping_words(GROUPINGS)}.")
    echo(
        f"{summary.seconds:.0f} s in all, {summary.training_seconds:.0f} s of it training. "
        f"Pictures: {', '.join(map(str, summary.pictures))}"
    )
    rows = [
        row._asdict() | {"recalls": {f"R@{k}": v for k, v in row.recalls.items()}}
        for row in summary.rows
    ]
    pictures = [str(picture) for picture in summary.pictures]
    values = {"out": str(arguments.out), "rows": rows, "pictures": pictures}
    return summary._asdict() | values
