"""The networks that turn pixels into features, one module each."""

import importlib
import pkgutil

from crisalad_jax.nn.backbones.base import BACKBONES as BACKBONES
from crisalad_jax.nn.backbones.base import Backbone as Backbone
from crisalad_jax.nn.backbones.base import Features as Features
from crisalad_jax.nn.backbones.base import FeatureSpec as FeatureSpec

register_backbone = BACKBONES.register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
