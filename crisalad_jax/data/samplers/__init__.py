"""Samplers of training batches, one module each."""

import importlib
import pkgutil

from crisalad_jax.data.samplers.base import SAMPLERS as SAMPLERS
from crisalad_jax.data.samplers.base import Draw as Draw
from crisalad_jax.data.samplers.base import Sampler as Sampler

register_sampler = SAMPLERS.register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
