"""The layouts of gmberton/MegaLoc (Berton and Masone, 2025): SALAD of 16,640 numbers, projected."""

import functools

from crisalad_jax.checkpoints.layouts.base import Stored
from crisalad_jax.checkpoints.layouts.dino_salad import infer_salad, salad_lines
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig

_HEAD = "aggregator.agg."
_LINEAR = "aggregator.linear"

_FILES: tuple[tuple[str, str, Stored, str, bool], ...] = (
    ("megaloc", "MegaLoc model.safetensors", "safetensors", "backbone.", False),
    ("megaloc-v1", "MegaLoc v1 .torch", "torch", "backbone.model.", True),
)
for _name, _file, _stored, _backbone, _mask_token in _FILES:
    register_over_dinov2(
        _name,
        _file,
        "salad",
        functools.partial(infer_salad, prefix=_HEAD),
        prefix=_backbone,
        mark=f"{_LINEAR}.weight",
        head=functools.partial(salad_lines, prefix=_HEAD),
        image_size=(322, 322),
        preprocessing=PreprocessingConfig(pixels="floats", round_to_patch=True),
        projection=_LINEAR,
        mask_token=_mask_token,
        stored=_stored,
    )
