"""`crisalad compare`."""

import dataclasses

from crisalad_jax.cli.comparing import ComparisonFlags, names_of, run_comparison, settings_of


@dataclasses.dataclass(frozen=True)
class Compare(ComparisonFlags):
    """Train or load the methods of the paper's Table 1, evaluate them alike, and table that."""

    methods: str | None = None
    """Comma-separated; by default the methods of Table 1 over one backbone: crisalad+netvlad (or
    gem, conv-ap, patch-netvlad, transvpr, mixvpr: that head with CriSALAD's backbone and training),
    cosplace-vit, eigenplaces-vit, anyloc, cricavpr, salad, crisalad, boq. Any recipe of `train` is
    a method too, and so is RECIPE+PART, with a registered part as NAME or KIND:NAME."""
    weights: tuple[str, ...] = ()
    """NAME=FILE, for each method that is not to be trained: its weights, or a published model's
    name (`crisalad models`)."""
    rerank: int = 20
    """So many first retrievals Patch-NetVLAD and TransVPR rank anew."""


def run(arguments: Compare) -> None:
    """Compare the methods, and print the tables."""
    from crisalad_jax.experiments.comparison import METHODS, ComparisonConfig

    config = ComparisonConfig(
        "compare",
        tuple(METHODS) if arguments.methods is None else names_of(arguments.methods),
        **settings_of(arguments),
        weights=arguments.weights,
        rerank=arguments.rerank,
    )
    run_comparison(config, arguments)
