"""Methods side by side: trained or loaded, evaluated alike, tabled as the paper's Tables 1 to 3."""

from crisalad_jax.comparison.ablation import (
    ABLATIONS,
    AdapterCost,
    adapter_costs,
    adapter_costs_once,
)
from crisalad_jax.comparison.methods import METHODS, ComparedMethod
from crisalad_jax.comparison.plan import ComparisonConfig, Prepared, prepare
from crisalad_jax.comparison.summary import Recall, Row, Summary, summarise
from crisalad_jax.comparison.work import carry_out, claim

__all__ = [
    "ABLATIONS",
    "METHODS",
    "AdapterCost",
    "ComparedMethod",
    "ComparisonConfig",
    "Prepared",
    "Recall",
    "Row",
    "Summary",
    "adapter_costs",
    "adapter_costs_once",
    "carry_out",
    "claim",
    "prepare",
    "summarise",
]
