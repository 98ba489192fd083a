"""`crisalad ablate`."""

import dataclasses

from crisalad_jax.cli.comparing import ComparisonFlags, names_of, run_comparison, settings_of

COMMON = (
    "test",
    "out",
    "train",
    "rows",
    "backbone",
    "preset",
    "seeds",
    "epochs",
    "image-size",
    "grouping",
    "batch-size",
    "page",
    "json",
    "on-bad-image",
    "quiet",
)
EXAMPLE = (
    "crisalad ablate --test pitts30k_test.mat --train gsv --backbone dinov2-vitb14 --out ablated"
)


@dataclasses.dataclass(frozen=True)
class Ablate(ComparisonFlags):
    """Train CriSALAD with one part changed at a time; what its adapters cost (Tables 2 and 3)."""

    rows: str | None = None
    """Comma-separated; by default all of the paper: crisalad, lr-1e-4, step, multi-resolution, mlp,
    no-adapter, no-encoder, no-encoder-step. Any registered part is a row too, as NAME or KIND:NAME:
    CriSALAD with it in place."""


def run(arguments: Ablate) -> None:
    """Train the rows of the ablation, and print the tables."""
    from crisalad_jax.experiments.comparison import ABLATIONS, ComparisonConfig

    names = tuple(ABLATIONS) if arguments.rows is None else names_of(arguments.rows)
    run_comparison(ComparisonConfig("ablate", names, **settings_of(arguments)), arguments)
