"""The configuration of a model, and presets for model sizes."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from crisalad_jax.config.checks import require, require_field
from crisalad_jax.config.part import OrName, non_semantic_field
from crisalad_jax.config.preprocessing import PreprocessingConfig, Size
from crisalad_jax.config.registry import part_field, resolve_names
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.nn.aggregators import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones import BACKBONES, Backbone
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.cross_image import CROSS_IMAGE, CrossImage, CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig

MOST_PIXELS = 4096
"""Largest image side in pixels that models accept: the cost of attention grows as its 4th power."""


@short_repr("backbone", "aggregator")
@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The configuration of CriSALAD and of the methods that it is compared with.

    DINO-SALAD has no adapter and no cross-image encoder. CricaVPR has the multi-resolution adapter
    and the GeM pyramid. Bare DINOv2 uses its class token. See docs/methods.md for all methods.

    Example:
        >>> model = ModelConfig(aggregator="gem", cross_image="none")
        >>> model.descriptor_dim
        768
    """

    image_size: tuple[int, int] = non_semantic_field((224, 224))
    """Height and width in pixels that images are resized to, multiples of the patch size (but see
    `PreprocessingConfig.size_rule`)."""
    preprocessing: PreprocessingConfig = PreprocessingConfig()
    """How images are resized and normalised."""
    backbone: OrName[Backbone] = part_field(BACKBONES, "vit")
    """Registered backbone, or its name; it turns pixels into features."""
    aggregator: OrName[Aggregator] = part_field(AGGREGATORS, "salad")
    """Registered aggregator, or its name; it turns features into tokens."""
    cross_image: OrName[CrossImage] = part_field(CROSS_IMAGE, "transformer")
    """Registered cross-image encoder, or its name; it relates the images of a batch."""
    projection: ProjectionConfig = ProjectionConfig()
    """Linear layer over the descriptor; by default none."""
    compute_dtype: Literal["float32", "bfloat16", "float64"] = non_semantic_field("float32")
    """Type of the matrix products; normalisations, softmax and transport are at least float32.
    float64 is for numerical studies, under JAX's 64-bit mode."""
    precision: Literal["highest", "high", "default"] = non_semantic_field("highest")
    """Precision of float32 products on accelerators, as JAX names it: "highest" is float32,
    "high" fewer bits, and "default" the platform's fastest (docs/accelerators.md). A CPU
    computes in float32. Products of another `compute_dtype` are in that type."""
    remat: Literal["dots", "full", "none"] = non_semantic_field("dots")
    """Rematerialisation of a block in the backward pass. "dots" stores the results of large matrix
    products, "full" only the block's input (least memory, one more forward pass), and "none"
    everything. Results are the same."""

    def __post_init__(self) -> None:
        """Check that the parts are compatible."""
        resolve_names(self)
        request = self.aggregator.features(self.backbone.depth)
        backbone, aggregator = self.backbone, f"aggregator {self.aggregator.part_name}"
        attends, inserts = backbone.exposes_cls_attention, backbone.supports_prompt_tokens
        several = request.levels not in (None, (backbone.depth,))
        for has, is_asked, what in (
            (backbone.class_token, request.class_token, "a class token"),
            (attends, request.class_attention, "a class token that attends to patches, like vit's"),
            (attends, request.facet != "token", "facets of attention, like vit's"),
            (inserts, request.insertion is not None, "blocks that take tokens, such as vit"),
            (backbone.exposes_levels, several, "features of other blocks than the last"),
            (backbone.side_paths > request.path, True, "adapters on two side paths"),
        ):
            require(
                has or not is_asked,
                f"backbone: found {backbone.part_name} for {aggregator}, expected one with {what}",
            )
        fits = self.preprocessing.size_rule == "fixed" or not self.aggregator.fixed_grid
        words = f"fixed: {aggregator} has parameters for every patch, so all images need one size"
        require_field(self.preprocessing, "size_rule", fits, words)
        how, as_bytes = self.preprocessing, ("bytes", (0.0,) * 3, (1 / 255,) * 3)
        require(
            backbone.local_features is None or (how.pixels, how.mean, how.deviation) == as_bytes,
            f"preprocessing: found {how.pixels} of mean {how.mean} and deviation {how.deviation} "
            f"for backbone {backbone.part_name}, expected bytes of mean 0 and deviation 1/255",
        )
        self.check_image_size(self.input_size)
        encoder, (global_dim, tokens, dim) = self.cross_image, self.token_shape
        if not encoder.attends:
            return
        require(
            self.aggregator.trainable,
            f"cross_image: found {encoder.part_name} for {aggregator}, which cannot be trained, "
            "expected none",
        )
        whole, cuts = encoder.global_token, encoder.width is not None
        length, rest = self.unprojected_dim, 0 if cuts or not whole else global_dim % dim
        for name, fits, expected in (
            ("width", not cuts or length % self.sequence_dim == 0, f"a divisor of {length}"),
            ("global_token", rest == 0, f"False: its width is not a multiple of {dim}"),
            ("global_token", whole or tokens > 0, "True, or no encoder: it is the only token"),
        ):
            require_field(encoder, name, fits, expected)
        encoder.check(self.sequence_dim)

    @property
    def token_shape(self) -> TokenShape:
        """Shape of an image's tokens."""
        return TokenShape(*self.aggregator.token_shape(self.backbone.dim))

    @property
    def sequence_dim(self) -> int:
        """Width of the cross-image encoder's tokens."""
        width = self.cross_image.width
        return self.token_shape.token_dim if width is None else width

    @property
    def descriptor_dim(self) -> int:
        """Width of a descriptor."""
        return self.projection.dim or self.unprojected_dim

    @property
    def unit_length(self) -> bool:
        """Whether descriptors are unit vectors, which the projection or the encoder decides."""
        alone = not self.cross_image.attends or self.cross_image.width is None
        return self.projection.renormalise if self.projection.dim else alone

    @property
    def unprojected_dim(self) -> int:
        """Width of a descriptor before `projection`."""
        shape = self.token_shape
        return shape.global_dim + shape.tokens * shape.token_dim

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches in an image of `input_size`."""
        return self.backbone.grid(self.input_size)

    @property
    def patches(self) -> int:
        """Number of patches in an image of `input_size`."""
        return math.prod(self.grid)

    @property
    def input_size(self) -> Size:
        """Height and width of the network's input: `image_size`, rounded if `preprocessing` rounds.

        Training, exports and cost counts use this size, whatever `PreprocessingConfig.size_rule`
        is. For local features, it is `Backbone.encoded_size`.
        """
        return self.backbone.encoded_size or self.rounded_size(self.image_size)

    def rounded_size(self, size: Size) -> Size:
        """Return the height and width of the network's input for an image resized to `size`."""
        return self.preprocessing.rounded_size(size, self.side_multiple)

    @property
    def side_multiple(self) -> int:
        """Number of pixels that image sides are multiples of: 1 if the backbone takes any size."""
        return 1 if self.backbone.any_size else self.backbone.patch_size

    @property
    def images_in_words(self) -> str:
        """The size and resize filter of images, as a short text.

        Example:
            >>> PRESETS["b14"].images_in_words
            '224 x 224, bilinear, antialiased, on bytes'
        """
        words = self.preprocessing.in_words(self.image_size)
        multiple = self.side_multiple
        needed = self.preprocessing.size_rule != "fixed" or self.input_size != self.image_size
        rounded = self.preprocessing.rounds and multiple > 1 and needed
        return f"{words}, rounded to multiples of {multiple}" if rounded else words

    def check_image_size(self, image_size: tuple[int, int]) -> None:
        """Check that this model accepts images of this height and width.

        Raises:
            InputError: a side is above `MOST_PIXELS` or not a multiple of the patch size, there are
                too few patches for the aggregator, or the aggregator is for another size.
        """
        found = " x ".join(map(str, image_size))
        require(
            max(image_size) <= MOST_PIXELS,
            f"image size: found {found}, expected at most {MOST_PIXELS} pixels a side",
        )
        require(
            not self.aggregator.fixed_grid or tuple(image_size) == tuple(self.input_size),
            f"image size: found {found}, expected {' x '.join(map(str, self.input_size))}: "
            f"aggregator {self.aggregator.part_name} has parameters for every patch, and was made "
            "for images of this size only",
        )
        self.aggregator.check_grid(self.backbone.grid(image_size), self.backbone.patch_size)

    def resized(self, image_size: Size | None, resize: Sequence[str] = ()) -> "ModelConfig":
        """Return this model with another image size, or another way to resize images.

        Args:
            image_size: height and width in pixels; None is the model's own.
            resize: values of `preprocessing.WORDS`, such as "bicubic"; empty changes nothing.

        Returns:
            The configuration, for the same parameters.

        Raises:
            InputError: see `check_image_size` and `PreprocessingConfig.changed_by`; also if a size
                is given for a model that takes images at their own size.

        Example:
            >>> PRESETS["tiny"].resized((70, 98)).grid
            (5, 7)
        """
        changed = self.preprocessing.changed_by(resize)
        config = dataclasses.replace(self, preprocessing=changed) if resize else self
        if image_size is None:
            return config
        # With "native" in `resize`, a size is deliberate: training and exports use it.
        require(
            changed.size_rule != "native" or "native" in resize,
            f"--image-size: found {' x '.join(map(str, image_size))} for a model that takes images "
            "at their own size, expected --resize fixed (or shorter-side, longer-side) as well",
        )
        config.check_image_size(config.rounded_size(image_size))
        return dataclasses.replace(config, image_size=image_size)


def _preset(dim: int, depth: int, heads: int, **backbone: Any) -> ModelConfig:
    return ModelConfig(backbone=ViTConfig(dim=dim, depth=depth, heads=heads, **backbone))


# The widths of DINOv2's four sizes; b14 is the paper's model. tiny is for training from scratch.
PRESETS: Mapping[str, ModelConfig] = {
    "tiny": ModelConfig(
        image_size=(98, 98),
        preprocessing=PreprocessingConfig(normalisation="local-contrast"),
        backbone=ViTConfig(dim=128, depth=4, heads=4, position_grid=7, position_init="sincos"),
        aggregator=AGGREGATORS.make("salad", "tiny"),
        cross_image=CrossImageConfig(heads=4, feedforward=128, dropout=0.0),
    ),
    "s14": _preset(384, 12, 6),
    "b14": _preset(768, 12, 12),
    "l14": _preset(1024, 24, 16),
    "g14": _preset(1536, 40, 24, ffn="swiglu"),
}
"""Configurations by model size; "b14" is the model of the paper."""


def check_unit_length(model: ModelConfig, name: str) -> None:
    """Check that a model outputs unit vectors, which are compared by cosine.

    Raises:
        InputError: the descriptors are not unit vectors; the message begins with `name`.
    """
    require(
        model.unit_length,
        f"{name}: found a model whose descriptors are not unit vectors, expected unit vectors, "
        "which are compared by cosine",
    )


def with_aggregator(model: ModelConfig, name: str, preset: str, **changes: Any) -> ModelConfig:
    """Return a model's configuration with another aggregator, at the size of a preset.

    Args:
        model: the configuration.
        name: a registered aggregator.
        preset: model size, such as "b14", for which the aggregator's settings are made.
        **changes: other fields of the model to change.

    Returns:
        The changed configuration.

    Raises:
        InputError: the aggregator is not registered, or does not fit the model.

    Example:
        >>> with_aggregator(PRESETS["tiny"], "gem", "tiny", cross_image="none").descriptor_dim
        128
    """
    return dataclasses.replace(model, aggregator=AGGREGATORS.make(name, preset), **changes)
