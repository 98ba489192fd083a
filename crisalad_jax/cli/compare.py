"""`crisalad compare`."""

import dataclasses
from typing import Any

from crisalad_jax.cli.comparing import ComparisonFlags, names_of, run_comparison

COMMON = (
    "test out train methods weights backbone preset seeds epochs image-size grouping batch-size "
    "rerank reference jobs page json on-bad-image quiet"
)
EXAMPLE = "crisalad compare --test pitts30k_test.mat --weights salad megaloc --out compared"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compare(ComparisonFlags):
    """Train or load the methods of the paper's Table 1, evaluate them alike, and table that."""

    methods: str | None = None
    """Comma-separated. By default the models of --weights; if there are none, or if they replace
    methods, those of Table 1 over one backbone: crisalad+netvlad (or gem, conv-ap, patch-netvlad,
    transvpr, mixvpr: that head with CriSALAD's backbone and training), cosplace-vit,
    eigenplaces-vit, anyloc, cricavpr, salad, crisalad, boq. Any recipe of `train` is a method too,
    and so is RECIPE+PART, with a registered part as NAME or KIND:NAME."""
    weights: tuple[str, ...] = ()
    """NAME=FILE or the NAME of a published model (`crisalad models`). If NAME is a method's, the
    weights are that method's, which is not trained. Any other name is a line of its own, whatever
    model the file holds."""
    rerank: int = 20
    """How many first retrievals Patch-NetVLAD and TransVPR rank again."""


def run(arguments: Compare) -> dict[str, Any]:
    """Compare the methods, and print the tables."""
    from crisalad_jax.experiments.comparison import names_to_compare

    methods = None if arguments.methods is None else names_of(arguments.methods)
    names = names_to_compare(methods, arguments.weights)
    return run_comparison(
        arguments, "compare", names, weights=arguments.weights, rerank=arguments.rerank
    )
