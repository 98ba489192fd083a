"""Convolutional backbones: a stem, and stages that each halve the grid."""

import abc
import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from crisalad_jax.config.checks import require
from crisalad_jax.nn.backbones.base import BackboneWithStatistics, FeatureRequest, Features
from crisalad_jax.utils.devices import parts_for_caches
from crisalad_jax.utils.pytree import pytree_dataclass

Map = Float[Array, "image _ _ _"]
"""Features in rows and columns, channels last."""


Valid = Bool[Array, " image"] | None

_PIXELS = 2**18
"""Pixels of the images that a CPU's core computes at once: of ResNet-50 the largest activation is
16 MB then. One image of 480 x 640 at a time takes 0.8 of the time of eight."""


@pytree_dataclass
class Stage:
    """The layers of one stage, in order."""

    layers: tuple[Any, ...]


Blocks = tuple[Stage, ...] | tuple[tuple[Stage, ...], ...]
"""Stages, or two parts of them."""


@pytree_dataclass
class Stages:
    """A convolutional backbone: what comes before its stages, if anything, and the stages.

    Training cuts `blocks` in two, a tuple of tuples of stages, where only the last ones train.
    """

    stem: Any
    blocks: Blocks


@dataclasses.dataclass(frozen=True)
class StagedBackbone(BackboneWithStatistics):
    """A backbone whose blocks are stages, and whose features are the last stage's positions.

    Its width and its number of stages follow from its other settings.
    """

    class_token: ClassVar[bool] = False
    # Annotated anew so that they are no fields: subclasses compute them.
    dim: ClassVar[int]  # pyright: ignore[reportIncompatibleVariableOverride]
    depth: ClassVar[int]  # pyright: ignore[reportIncompatibleVariableOverride]

    @abc.abstractmethod
    def run_stem(self, params: Any, images: Map, valid: Valid) -> tuple[Map, Any]:
        """Return what the first stage takes, and the stem with updated statistics.

        `valid` is that of `apply_training`; None takes the stored statistics, which stay.
        """

    @abc.abstractmethod
    def run_stage(self, number: int, params: Stage, x: Map, valid: Valid) -> tuple[Map, Stage]:
        """Return the output of the stage of this number, from 0, and the stage as `run_stem`."""

    def run(
        self,
        params: Stages,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
        valid: Bool[Array, " image"] | None,
    ) -> tuple[Features, Stages]:
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
        if valid is None:
            return self._infer(params, images, remat), params
        patches, updated = self._run(params, images, remat, valid)
        return Features(patches[:, 0, :0], patches), updated

    def _infer(self, params: Stages, images: Map, remat: str) -> Features:
        """Return the features by the stored statistics, on a CPU of few images at a time."""
        count, height, width, _ = images.shape
        parts = parts_for_caches(count, _PIXELS // (height * width))

        def one(images: Map) -> Float[Array, "image patch dim"]:
            return self._run(params, images, remat, None)[0]

        if parts == 1:
            patches = one(images)
        else:
            # A part takes some images of every device's: a batch's first axis is spread over them.
            split = images.reshape(-1, parts, *images.shape[1:])
            found = jax.lax.map(one, jnp.moveaxis(split, 1, 0))
            patches = jnp.moveaxis(found, 0, 1).reshape(count, *found.shape[2:])
        return Features(patches[:, 0, :0], patches)

    def _run(
        self, params: Stages, images: Map, remat: str, valid: Valid
    ) -> tuple[Float[Array, "image patch dim"], Stages]:
        x, stem = self.run_stem(params.stem, images, valid)
        updated = []
        for number, stage in enumerate(_joined(params.blocks)):

            def run(stage: Stage, x: Map, number: int = number) -> tuple[Map, Stage]:
                return self.run_stage(number, stage, x, valid)

            with jax.named_scope("blocks"):
                x, stage = jax.checkpoint(run)(stage, x) if remat == "full" else run(stage, x)
            updated.append(stage)
        patches = x.reshape(x.shape[0], -1, x.shape[-1])
        return patches, Stages(stem, _cut_as(tuple(updated), params.blocks))

    def split_blocks(self, params: Stages, first: int) -> Stages:
        """Cut the stages in two."""
        stages = _joined(params.blocks)
        return dataclasses.replace(params, blocks=(stages[:first], stages[first:]))

    def join_blocks(self, params: Stages) -> Stages:
        """Join the stages into one tuple."""
        return dataclasses.replace(params, blocks=_joined(params.blocks))


def _cut_as(stages: tuple[Stage, ...], blocks: Blocks) -> Blocks:
    """Cut stages as `blocks` are cut."""
    if not isinstance(blocks[0], tuple):
        return stages
    first = len(blocks[0])
    return stages[:first], stages[first:]


def _joined(blocks: Blocks) -> tuple[Stage, ...]:
    stages: list[Stage] = []
    for part in blocks:
        stages += part if isinstance(part, tuple) else (part,)
    return tuple(stages)
