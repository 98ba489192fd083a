"""CriSALAD visual place recognition in pure JAX."""

from typing import TYPE_CHECKING, Any

from crisalad_jax.config import PRESETS, ModelConfig, TrainConfig, recipe
from crisalad_jax.errors import InputError
from crisalad_jax.losses import multi_similarity_loss
from crisalad_jax.model import Crisalad, alone, among, describe, init_crisalad
from crisalad_jax.sinkhorn import sinkhorn

if TYPE_CHECKING:
    from crisalad_jax.checkpoint import load_weights as load
    from crisalad_jax.checkpoint import save_weights as save

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
    "multi_similarity_loss",
    "recipe",
    "save",
    "sinkhorn",
]

_FILES = {"load": "load_weights", "save": "save_weights"}


def __getattr__(name: str) -> Any:
    """`load` and `save` on first use: the model itself does without what reads and writes files."""
    if name in _FILES:
        from crisalad_jax import checkpoint

        return getattr(checkpoint, _FILES[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
