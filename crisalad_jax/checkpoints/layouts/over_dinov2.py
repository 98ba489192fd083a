"""Layouts of models that are a head over DINOv2, told by what they differ in."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    Stored,
    head_lines,
    register_layout,
    tells_head,
)
from crisalad_jax.checkpoints.layouts.dinov2 import (
    accepts_parts,
    has_vit,
    vit_config,
    vit_lines,
    vit_of,
)
from crisalad_jax.checkpoints.layouts.encoder import encoder_lines, infer_encoder
from crisalad_jax.checkpoints.layouts.forms import LINEAR, Form, affine
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig


def register_over_dinov2(
    name: str,
    holds: str,
    aggregator: str,
    infer_head: Callable[[State], Aggregator],
    *,
    prefix: str,
    mark: str | None = None,
    head: Callable[[Any], Lines] | None = None,
    first: int = 0,
    image_size: tuple[int, int] = (224, 224),
    adapter: str = "none",
    backbone: Mapping[str, Any] = MappingProxyType({}),
    encoder: bool | None = False,
    projection: str | None = None,
    projection_form: Form = LINEAR,
    mask_token: bool = True,
    norm: bool = True,
    module: str = "",
    under: str | None = None,
    stored: Stored = "torch",
    preprocessing: PreprocessingConfig = PreprocessingConfig(),
) -> None:
    """Register the layout of one family of models.

    Args:
        name: see `Layout`, and so are `holds`, `module`, `under` and `stored`.
        holds: see `name`.
        aggregator: name of the head's aggregator.
        infer_head: makes the aggregator's configuration from names and shapes.
        prefix: their names of the backbone begin with it.
        mark: a name that tells the family from others of the same prefix.
        head: yields the aggregator's table; by default the registered one.
        first: number of that table's lines that are before the backbone's.
        image_size: height and width in pixels that the family's models are evaluated at.
        adapter: kind of the adapters.
        backbone: fields of the backbone's configuration that no shape tells.
        encoder: whether there is a cross-image encoder; None where the file tells.
        projection: their name of the projection, with {dim} for its width; None without one.
        projection_form: see `affine`.
        mask_token: see `vit_lines`, and so is `norm`.
        norm: see `mask_token`.
        module: see `name`.
        under: see `name`.
        stored: see `name`.
        preprocessing: how the family's models resize and normalise images.
    """

    def accepts(config: ModelConfig) -> str | None:
        across = bool(config.cross_image.layers) if encoder is None else encoder
        projects = projection is not None
        return accepts_parts(config, aggregator, adapter, cross_image=across, projection=projects)

    def lines(config: ModelConfig) -> Lines:
        of_head = list(head_lines(config) if head is None else head(config.aggregator))
        yield from of_head[:first]
        yield from vit_lines(vit_of(config), prefix, mask_token=mask_token, norm=norm)
        yield from of_head[first:]
        yield from encoder_lines(config.cross_image)
        if projection is not None:
            theirs = projection.format(dim=config.projection.dim)
            yield from affine("projection", theirs, projection_form)

    def infer(state: State) -> ModelConfig:
        dim = 0 if projection is None else _projection_dim(state, projection)
        return ModelConfig(
            image_size=image_size,
            preprocessing=preprocessing,
            backbone=dataclasses.replace(vit_config(Reader(state, prefix)), **backbone),
            aggregator=infer_head(state),
            cross_image=CrossImageConfig(layers=0) if encoder is False else infer_encoder(state),
            projection=ProjectionConfig(dim=dim),
        )

    def has_backbone(state: State) -> bool:
        return has_vit(state, prefix)

    def detects(state: State) -> bool:
        return has_backbone(state) and (mark is None or mark in state)

    register_layout(
        Layout(
            name,
            holds,
            accepts,
            lines,
            detects,
            infer,
            module,
            under,
            stored,
            has_backbone=has_backbone,
            has_head=tells_head(infer_head),
        )
    )


def _projection_dim(state: State, projection: str) -> int:
    """Return the width of the projection that a state has under a name with {dim}."""
    pattern = re.compile(re.escape(f"{projection}.weight").replace(r"\{dim\}", "[0-9]+"))
    found = next((name for name in state if pattern.fullmatch(name)), f"{projection}.weight")
    return Reader(state).size(found, 0)
