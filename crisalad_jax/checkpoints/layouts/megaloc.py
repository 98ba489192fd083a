"""The layouts of gmberton/MegaLoc (Berton and Masone, 2025): SALAD of 16,640 numbers, projected."""

import functools

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, Reader, State, register_layout
from crisalad_jax.checkpoints.layouts.dino_salad import infer_salad, salad_lines
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_parts, vit_config, vit_lines, vit_of
from crisalad_jax.checkpoints.layouts.forms import LINEAR, affine
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig

_HEAD = "aggregator.agg."
_LINEAR = "aggregator.linear"


def _accepts(config: ModelConfig) -> str | None:
    return accepts_parts(config, "salad", "none", cross_image=False, projection=True)


def _detects(state: State, backbone: str) -> bool:
    embedded = f"{backbone}cls_token" in state or f"{backbone}pos_embed" in state
    return embedded and f"{_LINEAR}.weight" in state


def _infer(state: State, backbone: str) -> ModelConfig:
    return ModelConfig(
        image_size=(322, 322),
        backbone=vit_config(Reader(state, backbone)),
        aggregator=infer_salad(state, _HEAD),
        cross_image=CrossImageConfig(layers=0),
        projection=ProjectionConfig(dim=Reader(state).size(f"{_LINEAR}.weight", 0)),
    )


def _lines(config: ModelConfig, backbone: str, *, mask_token: bool) -> Lines:
    assert isinstance(config.aggregator, SaladConfig)
    yield from vit_lines(vit_of(config), backbone, mask_token=mask_token)
    yield from salad_lines(config.aggregator, _HEAD)
    yield from affine("projection", _LINEAR, LINEAR)


for _name, _file, _backbone, _mask_token in (
    ("megaloc", "MegaLoc model.safetensors", "backbone.", False),
    ("megaloc-v1", "MegaLoc v1 .torch", "backbone.model.", True),
):
    register_layout(
        Layout(
            _name,
            _file,
            _accepts,
            functools.partial(_lines, backbone=_backbone, mask_token=_mask_token),
            functools.partial(_detects, backbone=_backbone),
            functools.partial(_infer, backbone=_backbone),
            stored="safetensors" if _file.endswith(".safetensors") else "torch",
        )
    )
