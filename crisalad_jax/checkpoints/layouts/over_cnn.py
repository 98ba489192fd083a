"""Layouts of models that are a head over a ResNet or a VGG, told by what they differ in."""

from collections.abc import Callable
from typing import Any

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    head_lines,
    register_layout,
    tells_head,
)
from crisalad_jax.checkpoints.layouts.cnn import Names, accepts_head_over, cnn_lines, infer_cnn
from crisalad_jax.checkpoints.layouts.forms import LINEAR, Form, affine
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.backbones.stages import StagedBackbone
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError


def register_over_cnn(
    name: str,
    holds: str,
    aggregator: str,
    infer_head: Callable[[State], Aggregator],
    *,
    backbones: tuple[type[StagedBackbone], ...],
    names: Names,
    mark: str,
    image_size: Callable[[State], tuple[int, int]],
    head: Callable[[Any], Lines] | None = None,
    projection: str | None = None,
    projection_form: Form = LINEAR,
    under: str | None = None,
    preprocessing: Callable[[Any], PreprocessingConfig] = lambda head: PreprocessingConfig(),
) -> None:
    """Register the layout of one family of models.

    Args:
        name: see `Layout`, and so are `holds` and `under`.
        holds: see `name`.
        aggregator: name of the head's aggregator.
        infer_head: makes the aggregator's configuration from names and shapes.
        backbones: the classes of the family's backbones.
        names: how its files name their layers.
        mark: a name that only files of this family, or of the same names, have.
        image_size: returns the height and width in pixels that the models are evaluated at.
        head: yields the aggregator's table; by default the registered one.
        projection: their name of the projection; None without one.
        projection_form: form of the projection's weight.
        under: see `name`.
        preprocessing: returns how a model with this head resizes and normalises images.
    """

    def accepts(config: ModelConfig) -> str | None:
        projects = projection is not None
        return accepts_head_over(config, aggregator, backbones, projection=projects)

    def lines(config: ModelConfig) -> Lines:
        yield from cnn_lines(config.backbone, names)
        yield from head_lines(config) if head is None else head(config.aggregator)
        if projection is not None:
            yield from affine("projection", projection, projection_form)

    def infer(state: State) -> ModelConfig:
        backbone = infer_cnn(state, names)
        if not isinstance(backbone, backbones):
            wanted = " or ".join(kind.part_name for kind in backbones)
            raise InputError(f"found backbone {backbone.part_name}, expected {wanted}")
        found = infer_head(state)
        dim = 0 if projection is None else Reader(state).size(f"{projection}.weight", 0)
        return ModelConfig(
            image_size=image_size(state),
            preprocessing=preprocessing(found),
            backbone=backbone,
            aggregator=found,
            cross_image=CrossImageConfig(layers=0),
            projection=ProjectionConfig(dim=dim),
        )

    def has_backbone(state: State) -> bool:
        return names.first in state

    def detects(state: State) -> bool:
        return has_backbone(state) and mark in state

    register_layout(
        Layout(
            name,
            holds,
            accepts,
            lines,
            detects,
            infer,
            under=under,
            has_backbone=has_backbone,
            has_head=tells_head(infer_head),
        )
    )
