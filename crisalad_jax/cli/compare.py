"""`crisalad compare`."""

import dataclasses

from crisalad_jax.cli.comparing import Side, compare, names_of, settings_of


@dataclasses.dataclass(frozen=True)
class Compare(Side):
    """Train or load the methods of the paper's Table 1, evaluate them alike, and table that."""

    methods: str | None = None
    """Comma-separated; by default all: netvlad, gem, conv-ap, patch-netvlad, transvpr, cosplace,
    mixvpr, eigenplaces, anyloc, cricavpr, salad, crisalad, boq."""
    weights: tuple[str, ...] = ()
    """NAME=FILE, for each method that is not to be trained: its weights."""
    rerank: int = 20
    """So many first retrievals Patch-NetVLAD and TransVPR rank anew."""


def run(arguments: Compare) -> None:
    """Do what is left, and print the tables."""
    from crisalad_jax.comparison import METHODS, ComparisonConfig

    names = tuple(METHODS) if arguments.methods is None else names_of(arguments.methods)
    config = ComparisonConfig(
        "compare",
        names,
        **settings_of(arguments),
        weights=arguments.weights,
        rerank=arguments.rerank,
    )
    compare(config, arguments)
