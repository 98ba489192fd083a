"""CriSALAD visual place recognition in pure JAX.

Names are imported on first use, so that reading pictures takes no jax and a model no file formats.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crisalad_jax.checkpoint import load_weights as load
    from crisalad_jax.checkpoint import save_weights as save
    from crisalad_jax.config import PRESETS, ModelConfig, TrainConfig, recipe
    from crisalad_jax.errors import InputError
    from crisalad_jax.losses import metric_loss
    from crisalad_jax.model import Crisalad, alone, among, describe, init_crisalad
    from crisalad_jax.sinkhorn import sinkhorn as solve_transport

__all__ = [
    "PRESETS",
    "Crisalad",
    "InputError",
    "ModelConfig",
    "TrainConfig",
    "alone",
    "among",
    "describe",
    "init_crisalad",
    "load",
    "metric_loss",
    "recipe",
    "save",
    "solve_transport",
]

_HOMES = {
    "PRESETS": "config.PRESETS",
    "Crisalad": "model.Crisalad",
    "InputError": "errors.InputError",
    "ModelConfig": "config.ModelConfig",
    "TrainConfig": "config.TrainConfig",
    "alone": "model.alone",
    "among": "model.among",
    "describe": "model.describe",
    "init_crisalad": "model.init_crisalad",
    "load": "checkpoint.load_weights",
    "metric_loss": "losses.metric_loss",
    "recipe": "config.recipe",
    "save": "checkpoint.save_weights",
    # `crisalad_jax.sinkhorn` is the module.
    "solve_transport": "sinkhorn.sinkhorn",
}


def __getattr__(name: str) -> Any:
    """A public name, from the module it lives in."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOMES[name].partition(".")
    return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
