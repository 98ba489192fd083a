"""Entropic transport; `crisalad_jax.sinkhorn` is its public interface.

Every module here is imported, so that its steps, dustbins and gradients are registered.
"""

import importlib
import pkgutil

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
