"""The configuration of a whole model, and the presets of model sizes."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal

from crisalad_jax.config.checks import require
from crisalad_jax.config.fields import free_field
from crisalad_jax.config.parts import OrName, part_field, resolve_names
from crisalad_jax.nn.aggregators import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones import BACKBONES, Backbone
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError

MOST_PIXELS = 4096
"""Largest side of an image that models describe: attention grows by its fourth power."""


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The configuration of CriSALAD, and of the methods that it is compared with.

    DINO-SALAD has no adapter and no encoder. CricaVPR has the multi-resolution adapter and the GeM
    pyramid. DINOv2 by itself gives its class token. See docs/methods.md for all methods.

    Example:
        >>> model = ModelConfig(aggregator="gem", cross_image=CrossImageConfig(layers=0))
        >>> model.descriptor_dim
        768
    """

    image_size: tuple[int, int] = free_field((224, 224))
    """Height and width that images are resized to, multiples of 14."""
    normalisation: Literal["imagenet", "local-contrast"] = "imagenet"
    """Mean and deviation that normalise 8-bit pixels: ImageNet's or local ones."""
    backbone: OrName[Backbone] = part_field(BACKBONES, "vit")
    """Registered backbone, or its name; it turns pixels into features."""
    aggregator: OrName[Aggregator] = part_field(AGGREGATORS, "salad")
    """Registered aggregator, or its name; it turns features into tokens."""
    cross_image: CrossImageConfig = CrossImageConfig()
    """Encoder whose attention runs across the images of a batch."""
    projection: ProjectionConfig = ProjectionConfig()
    """Linear layer over the whole descriptor; by default none."""
    compute_dtype: Literal["float32", "bfloat16", "float64"] = free_field("float32")
    """Type of the matrix products; normalisations, softmax and transport are float32 at least.
    float64 is for numerical studies, under JAX's 64-bit mode."""
    remat: Literal["dots", "full", "none"] = free_field("dots")
    """Rematerialisation of a block in the backward pass. "dots" stores the results of large matrix
    products, "full" the block's input alone (least memory, one more forward pass), and "none"
    everything. Results are the same."""

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        resolve_names(self)
        self.check_image_size(self.image_size)
        request = self.aggregator.features(self.backbone.depth)
        name = self.aggregator.part_name
        require(
            request.insertion is None or self.backbone.inserts,
            f"backbone: found {self.backbone.part_name} for aggregator {name}, expected one "
            "through whose blocks tokens can run, such as vit",
        )
        require(
            self.aggregator.learns or not self.cross_image.layers,
            f"CrossImageConfig.layers: found {self.cross_image.layers} for aggregator {name}, with "
            "which nothing trains, expected 0",
        )
        shape = self.token_shape
        if self.cross_image.layers:
            self._check_cross_image(shape)

    def _check_cross_image(self, shape: TokenShape) -> None:
        heads = self.cross_image.heads
        width, name = shape.token_dim, f"aggregator {self.aggregator.part_name}"
        field, kind = self.aggregator.width_field, type(self.aggregator).__name__
        require(
            width % heads == 0,
            f"{f'{kind}.{field}' if field else name}: found "
            f"{width if field else f'tokens of {width} numbers'}, expected a multiple of the "
            f"cross-image encoder's {heads} heads",
        )
        require(
            not self.cross_image.global_token or shape.global_dim % width == 0,
            f"{kind}.token_dim: found {shape.global_dim}, expected a multiple of "
            f"{field or 'the width of local tokens'} {width} so that the global token can enter "
            "the cross-image encoder (or CrossImageConfig.global_token False)",
        )
        require(
            self.cross_image.global_token or shape.tokens > 0,
            f"CrossImageConfig.global_token: found False for {name}, which has no other token, "
            "expected True, or CrossImageConfig.layers 0",
        )

    @property
    def token_shape(self) -> TokenShape:
        """Shape of an image's tokens."""
        shape = self.aggregator.token_shape(self.backbone.dim)
        require(
            isinstance(shape, TokenShape),
            f"aggregator {self.aggregator.part_name}: token_shape found to return {shape!r}, "
            "expected TokenShape(global_dim, tokens, token_dim)",
        )
        return shape

    @property
    def descriptor_dim(self) -> int:
        """Width of a descriptor."""
        return self.projection.dim or self.unprojected_dim

    @property
    def unprojected_dim(self) -> int:
        """Width of a descriptor before `projection`."""
        shape = self.token_shape
        return shape.global_dim + shape.tokens * shape.token_dim

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches in an image of `image_size`."""
        return self.backbone.grid(self.image_size)

    @property
    def patches(self) -> int:
        """Number of patches in an image of `image_size`."""
        return math.prod(self.grid)

    def check_image_size(self, image_size: tuple[int, int]) -> None:
        """Check that this model can describe images of this height and width.

        Raises:
            InputError: a side is above `MOST_PIXELS` or no multiple of the patch size, there are
                too few patches for the aggregator, or its parameters are for another size.
        """
        if max(image_size) > MOST_PIXELS:
            raise InputError(
                f"image size: found {' x '.join(map(str, image_size))}, expected at most "
                f"{MOST_PIXELS} pixels a side"
            )
        if self.aggregator.fixed_grid and tuple(image_size) != tuple(self.image_size):
            given, expected = (f"{h} x {w}" for h, w in (image_size, self.image_size))
            raise InputError(
                f"image size: found {given}, expected {expected}: aggregator "
                f"{self.aggregator.part_name} has parameters for every patch, and was made for "
                "images of this size alone"
            )
        self.aggregator.check_grid(self.backbone.grid(image_size), self.backbone.patch_size)

    def resized(self, image_size: tuple[int, int] | None) -> "ModelConfig":
        """Return this model for images of another size.

        Args:
            image_size: height and width in pixels; None keeps the model's own.

        Returns:
            The configuration, which fits the same parameters.

        Raises:
            InputError: what `check_image_size` raises.

        Example:
            >>> PRESETS["tiny"].resized((70, 98)).grid
            (5, 7)
        """
        if image_size is None:
            return self
        self.check_image_size(image_size)
        return dataclasses.replace(self, image_size=image_size)


def _preset(dim: int, depth: int, heads: int, **backbone: Any) -> ModelConfig:
    return ModelConfig(backbone=ViTConfig(dim=dim, depth=depth, heads=heads, **backbone))


# The widths of DINOv2's four sizes; b14 is the paper's model. tiny is for training from scratch.
PRESETS: Mapping[str, ModelConfig] = {
    "tiny": ModelConfig(
        image_size=(98, 98),
        normalisation="local-contrast",
        backbone=ViTConfig(dim=128, depth=4, heads=4, position_grid=7, position_init="sincos"),
        aggregator=AGGREGATORS.make("salad", "tiny"),
        cross_image=CrossImageConfig(heads=4, feedforward=128, dropout=0.0),
    ),
    "s14": _preset(384, 12, 6),
    "b14": _preset(768, 12, 12),
    "l14": _preset(1024, 24, 16),
    "g14": _preset(1536, 40, 24, ffn="swiglu"),
}
"""Sizes of models by name."""


def with_aggregator(model: ModelConfig, name: str, preset: str, **changes: Any) -> ModelConfig:
    """Return a model with the aggregator of this name, in the size of the preset.

    Args:
        model: the model.
        name: a registered aggregator.
        preset: whose size the aggregator takes, as `PRESETS` names them.
        **changes: other fields of the model.

    Returns:
        The changed model.

    Raises:
        InputError: no such aggregator, or it does not fit the model.

    Example:
        >>> alone = CrossImageConfig(layers=0)
        >>> with_aggregator(PRESETS["tiny"], "gem", "tiny", cross_image=alone).descriptor_dim
        128
    """
    return dataclasses.replace(model, aggregator=AGGREGATORS.make(name, preset), **changes)
