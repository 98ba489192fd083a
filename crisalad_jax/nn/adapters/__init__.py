"""Adapters for the blocks of a vision transformer, one module for each family."""

import importlib
import pkgutil

from crisalad_jax.nn.adapters.base import ADAPTERS as ADAPTERS
from crisalad_jax.nn.adapters.base import Adapter as Adapter
from crisalad_jax.nn.adapters.base import BlockShape as BlockShape
from crisalad_jax.nn.adapters.base import TokenInfo as TokenInfo

register_adapter = ADAPTERS.register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
