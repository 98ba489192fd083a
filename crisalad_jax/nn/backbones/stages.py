"""Convolutional backbones: a stem, and stages that halve the grid."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax
from jaxtyping import Array, Float

from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Pixels, Valid
from crisalad_jax.nn.convolutions import Map
from crisalad_jax.utils.devices import parts_for_caches
from crisalad_jax.utils.pytree import pytree_dataclass

_PIXELS = 2**18
"""Image pixels that a CPU core computes at once: ResNet-50's largest activation is then 16 MB. One
image of 480 x 640 at a time takes 0.8 times as long as eight at a time."""


@pytree_dataclass
class Stage:
    """The layers of one stage, in order."""

    layers: tuple[Any, ...]


@pytree_dataclass
class Stages:
    """Parameters of a convolutional backbone: the stem, if any, and the stages after it."""

    stem: Any
    blocks: tuple[Stage, ...]


@dataclasses.dataclass(frozen=True)
class StagedBackbone(Backbone):
    """A backbone whose blocks are stages; each position of the last stage is a feature.

    Its width `dim` and number of stages `depth` follow from its other settings.
    """

    any_size: ClassVar[bool] = True
    class_token: ClassVar[bool] = False
    exposes_levels: ClassVar[bool] = False
    # Annotated again so that they are not fields: subclasses compute them.
    dim: ClassVar[int]  # pyright: ignore[reportIncompatibleVariableOverride]
    depth: ClassVar[int]  # pyright: ignore[reportIncompatibleVariableOverride]

    def run_stem(self, params: Any, images: Map, valid: Valid) -> tuple[Map, Any]:
        """Return the input of the first stage, and the stem with updated statistics.

        By default there is no stem. `valid` is as in `apply`.
        """
        return images, params

    @abc.abstractmethod
    def run_stage(self, number: int, params: Stage, x: Map, valid: Valid) -> tuple[Map, Stage]:
        """Return the output of stage `number`, from 0, and the stage with updated statistics."""

    def apply(
        self, params: Stages, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, Stages]:
        """Return the last stage's vectors in row order, without a class token or a last norm.

        With remat "full" the backward pass recomputes every stage from its input.
        """
        count, height, width, _ = images.shape
        parts = parts_for_caches(count, _PIXELS // (height * width)) if valid is None else 1
        if parts == 1:
            patches, params = self._run(params, images, remat, valid)
        else:
            run = lambda params, images: self._run(params, images, remat, None)[0]  # noqa: E731
            patches = _in_parts(run, parts, params, images)
        return Features(patches[:, 0, :0], patches), params

    def _run(
        self, params: Stages, images: Map, remat: str, valid: Valid
    ) -> tuple[Float[Array, "image patch dim"], Stages]:
        x, stem = self.run_stem(params.stem, images, valid)
        updated = []
        for number, stage in enumerate(params.blocks):

            def run(stage: Stage, x: Map, number: int = number) -> tuple[Map, Stage]:
                return self.run_stage(number, stage, x, valid)

            with jax.named_scope("blocks"):
                x, stage = jax.checkpoint(run)(stage, x) if remat == "full" else run(stage, x)
            updated.append(stage)
        return x.reshape(x.shape[0], -1, x.shape[-1]), Stages(stem, tuple(updated))


def _compute_in_parts(
    run: Callable[[Stages, Map], Array], parts: int, params: Stages, images: Map
) -> Float[Array, "image patch dim"]:
    """Call `run` on some images at a time if no gradient is requested.

    Gradients use the whole batch: XLA has no fast convolutions for the backward pass in a loop (16
    images through a ResNet-18 of width 32: 13.8 s in parts, 0.8 s as one batch).
    """
    # Each part takes images from every device: the first axis of a batch is sharded over them.
    split = images.reshape(-1, parts, *images.shape[1:]).swapaxes(0, 1)
    found = jax.lax.map(functools.partial(run, params), split)
    return found.swapaxes(0, 1).reshape(len(images), *found.shape[2:])


_in_parts = jax.custom_vjp(_compute_in_parts, nondiff_argnums=(0, 1))
_in_parts.defvjp(
    lambda run, parts, params, images: jax.vjp(run, params, images),
    lambda run, parts, backward, change: backward(change),
)
