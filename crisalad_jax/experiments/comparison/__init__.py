"""Methods side by side: trained or loaded, evaluated alike, tabled as the paper's Tables 1 to 3."""

from crisalad_jax.experiments.comparison.ablation import (
    ABLATIONS,
    AdapterCost,
    adapter_costs,
    adapter_costs_once,
)
from crisalad_jax.experiments.comparison.compare import compare
from crisalad_jax.experiments.comparison.ledger import claim
from crisalad_jax.experiments.comparison.methods import METHODS, ComparedMethod
from crisalad_jax.experiments.comparison.paired import Difference, paired_difference
from crisalad_jax.experiments.comparison.plan import (
    ComparisonConfig,
    Prepared,
    names_to_compare,
    prepare,
)
from crisalad_jax.experiments.comparison.rows import AblationRow, parse_row
from crisalad_jax.experiments.comparison.runner import carry_out
from crisalad_jax.experiments.comparison.summary import Recall, Row, Summary, summarise

__all__ = [
    "ABLATIONS",
    "METHODS",
    "AblationRow",
    "AdapterCost",
    "ComparedMethod",
    "ComparisonConfig",
    "Difference",
    "Prepared",
    "Recall",
    "Row",
    "Summary",
    "adapter_costs",
    "adapter_costs_once",
    "carry_out",
    "claim",
    "compare",
    "names_to_compare",
    "paired_difference",
    "parse_row",
    "prepare",
    "summarise",
]
