"""Methods side by side: trained or loaded, evaluated alike, tabled as the paper's Tables 1 to 3."""

from crisalad_jax.experiments.comparison.costs import AdapterCost, adapter_costs
from crisalad_jax.experiments.comparison.methods import (
    ABLATIONS,
    METHODS,
    AblationRow,
    ComparedMethod,
    parse_row,
)
from crisalad_jax.experiments.comparison.plan import (
    ComparisonConfig,
    Prepared,
    names_to_compare,
    prepare,
)
from crisalad_jax.experiments.comparison.results import (
    Difference,
    Recall,
    Row,
    Summary,
    paired_difference,
    summarise,
)
from crisalad_jax.experiments.comparison.runner import compare

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
    "compare",
    "names_to_compare",
    "paired_difference",
    "parse_row",
    "prepare",
    "summarise",
]
