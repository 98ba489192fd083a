"""`crisalad ablate`."""

import dataclasses

from crisalad_jax.cli.comparing import Side, compare, names_of, settings_of


@dataclasses.dataclass(frozen=True)
class Ablate(Side):
    """Train CriSALAD with one part changed at a time; what its adapters cost (Tables 2 and 3)."""

    rows: str | None = None
    """Comma-separated; by default all: crisalad, lr-1e-4, step, multi-resolution, mlp, no-adapter,
    no-encoder, no-encoder-step."""


def run(arguments: Ablate) -> None:
    """Do what is left, and print the tables."""
    from crisalad_jax.comparison import ABLATIONS, ComparisonConfig

    names = tuple(ABLATIONS) if arguments.rows is None else names_of(arguments.rows)
    compare(ComparisonConfig("ablate", names, **settings_of(arguments)), arguments)
