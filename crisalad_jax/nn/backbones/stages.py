"""Convolutional backbones: a stem, and stages that each halve the grid."""

import abc
import dataclasses
from typing import Any, ClassVar

import jax
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require
from crisalad_jax.nn.backbones.base import Backbone, FeatureRequest, Features
from crisalad_jax.utils.pytree import pytree_dataclass

Map = Float[Array, "image _ _ _"]
"""Features in rows and columns, channels last."""


@pytree_dataclass
class Stage:
    """The layers of one stage, in order."""

    layers: tuple[Any, ...]


@pytree_dataclass
class Stages:
    """A convolutional backbone: what comes before its stages, if anything, and the stages.

    Training cuts `blocks` in two, a tuple of tuples of stages, where only the last ones train.
    """

    stem: Any
    blocks: tuple[Stage, ...] | tuple[tuple[Stage, ...], ...]


@dataclasses.dataclass(frozen=True)
class StagedBackbone(Backbone):
    """A backbone whose blocks are stages, and whose features are the last stage's positions.

    Its width and its number of stages follow from its other settings.
    """

    class_token: ClassVar[bool] = False
    # Annotated anew so that they are no fields: subclasses compute them.
    dim: ClassVar[int]  # pyright: ignore[reportIncompatibleVariableOverride]
    depth: ClassVar[int]  # pyright: ignore[reportIncompatibleVariableOverride]

    @abc.abstractmethod
    def run_stem(self, params: Any, images: Map) -> Map:
        """Return what the first stage takes."""

    @abc.abstractmethod
    def run_stage(self, number: int, params: Stage, x: Map) -> Map:
        """Return the output of the stage of this number, from 0."""

    def apply(
        self,
        params: Stages,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
    ) -> Features:
        """Return the last stage's vectors, in row order; there is no class token, and no last norm.

        With remat "full" the backward pass computes every stage again from its input.

        Raises:
            InputError: while tracing, for another level than the last, or a facet of attention.
        """
        require(
            request.levels in (None, (self.depth,)) and request.facet == "token",
            f"features: found a request for levels {request.levels} and facet {request.facet} of "
            f"backbone {self.part_name}, expected its last stage's",
        )
        x = self.run_stem(params.stem, images)
        for number, stage in enumerate(_joined(params.blocks)):

            def run(stage: Stage, x: Map, number: int = number) -> Map:
                return self.run_stage(number, stage, x)

            with jax.named_scope("blocks"):
                x = jax.checkpoint(run)(stage, x) if remat == "full" else run(stage, x)
        patches = x.reshape(x.shape[0], -1, x.shape[-1])
        return Features(patches[:, 0, :0], patches)

    def split_blocks(self, params: Stages, first: int) -> Stages:
        """Cut the stages in two."""
        stages = _joined(params.blocks)
        return dataclasses.replace(params, blocks=(stages[:first], stages[first:]))

    def join_blocks(self, params: Stages) -> Stages:
        """Join the stages into one tuple."""
        return dataclasses.replace(params, blocks=_joined(params.blocks))


def _joined(
    blocks: tuple[Stage, ...] | tuple[tuple[Stage, ...], ...],
) -> tuple[Stage, ...]:
    stages: list[Stage] = []
    for part in blocks:
        stages += part if isinstance(part, tuple) else (part,)
    return tuple(stages)
