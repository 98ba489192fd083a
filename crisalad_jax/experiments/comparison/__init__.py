"""Comparison of methods, trained or loaded, evaluated the same way: the paper's Tables 1 to 3."""

from crisalad_jax.experiments.comparison.costs import AdapterCost as AdapterCost
from crisalad_jax.experiments.comparison.costs import adapter_costs as adapter_costs
from crisalad_jax.experiments.comparison.methods import ABLATIONS as ABLATIONS
from crisalad_jax.experiments.comparison.methods import METHODS as METHODS
from crisalad_jax.experiments.comparison.methods import AblationRow as AblationRow
from crisalad_jax.experiments.comparison.methods import ComparedMethod as ComparedMethod
from crisalad_jax.experiments.comparison.methods import parse_row as parse_row
from crisalad_jax.experiments.comparison.plan import ComparisonConfig as ComparisonConfig
from crisalad_jax.experiments.comparison.plan import Prepared as Prepared
from crisalad_jax.experiments.comparison.plan import names_to_compare as names_to_compare
from crisalad_jax.experiments.comparison.plan import prepare as prepare
from crisalad_jax.experiments.comparison.results import Recall as Recall
from crisalad_jax.experiments.comparison.results import Row as Row
from crisalad_jax.experiments.comparison.results import Summary as Summary
from crisalad_jax.experiments.comparison.results import summarise as summarise
from crisalad_jax.experiments.comparison.runner import compare as compare
