"""Models that others published, by name: a module for each family of files.

Addresses and licences are those that the models' repositories state. A licence is the repository's;
few say one for the weights alone.
"""

import importlib
import pkgutil

from crisalad_jax.checkpoints.published.base import PUBLISHED as PUBLISHED
from crisalad_jax.checkpoints.published.base import Licence as Licence
from crisalad_jax.checkpoints.published.base import Published as Published
from crisalad_jax.checkpoints.published.base import published_model as published_model
from crisalad_jax.checkpoints.published.base import register_published as register_published

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
