"""`crisalad ablate`."""

from typing import Any

import tyro

from crisalad_jax.cli.compare import ComparisonFlags, names_of, run_comparison


class Ablate(ComparisonFlags):
    """Train CriSALAD with one part changed at a time, and show costs (the paper's Tables 2, 3)."""

    rows: str | None = None
    """Rows, comma-separated; by default the paper's: crisalad, lr-1e-4, step, multi-resolution,
    mlp, no-adapter, no-encoder, no-encoder-step. NAME or KIND:NAME of a registered part is a row
    too: CriSALAD with that part. With --row the default is only crisalad."""
    row: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A custom row, as "NAME: flag=value, flag=value" with any flags of `train` that set the model,
    loss, optimiser, augmentation or training, and recipe=NAME to start from a recipe other than
    crisalad. Repeat --row for each row. Separate a flag's numbers by spaces (image-size=224 224),
    and quote a value with a comma."""


def run(arguments: Ablate) -> dict[str, Any]:
    """Train the rows of the ablation, and print the tables; return the result for --json."""
    from crisalad_jax.experiments.comparison import ABLATIONS

    if arguments.rows is not None:
        names = names_of(arguments.rows)
    else:
        names = ("crisalad",) if arguments.row else tuple(ABLATIONS)
    return run_comparison(arguments, "ablate", names, rows=arguments.row)
