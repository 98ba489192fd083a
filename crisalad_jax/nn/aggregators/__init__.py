"""Aggregators, which turn features into tokens; docs/methods.md lists the methods."""

import importlib
import pkgutil

from crisalad_jax.nn.aggregators.base import AGGREGATORS as AGGREGATORS
from crisalad_jax.nn.aggregators.base import Aggregator as Aggregator
from crisalad_jax.nn.aggregators.base import TokenShape as TokenShape

register_aggregator = AGGREGATORS.register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
