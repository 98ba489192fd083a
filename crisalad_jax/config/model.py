"""A whole model."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Literal, get_args

from crisalad_jax.config.aggregators import (
    PYRAMID_LEVELS,
    AnyLocConfig,
    BoqConfig,
    ClassTokenConfig,
    ConvApConfig,
    CosPlaceConfig,
    CrossImageConfig,
    GemConfig,
    GemPyramidConfig,
    MixVprConfig,
    NetVladConfig,
    SaladConfig,
    TokenShape,
    TransVprConfig,
)
from crisalad_jax.config.backbone import PATCH_SIZE, ViTConfig
from crisalad_jax.config.checks import choose, require, require_choice
from crisalad_jax.errors import InputError

AggregatorName = Literal[
    "salad",
    "gem-pyramid",
    "class-token",
    "gem",
    "netvlad",
    "conv-ap",
    "cosplace",
    "mixvpr",
    "anyloc",
    "boq",
    "transvpr",
]
AGGREGATORS: Mapping[str, str] = {name: name.replace("-", "_") for name in get_args(AggregatorName)}
"""The field of `ModelConfig` that describes each."""

_WIDTHS = {
    "salad": "SaladConfig.cluster_dim",
    "conv-ap": "ConvApConfig.channels",
    "cosplace": "CosPlaceConfig.dim",
    "mixvpr": "MixVprConfig.channels",
    "boq": "BoqConfig.channels",
    "transvpr": "TransVprConfig.dim",
}
"""What sets the width of the tokens; of the others the backbone does."""


AggregatorConfig = (
    SaladConfig
    | GemPyramidConfig
    | ClassTokenConfig
    | GemConfig
    | NetVladConfig
    | ConvApConfig
    | CosPlaceConfig
    | MixVprConfig
    | AnyLocConfig
    | BoqConfig
    | TransVprConfig
)


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """CriSALAD: backbone, aggregation, cross-image encoder; and what it is measured against.

    DINO-SALAD has no adapter and no encoder; CricaVPR the multi-resolution adapter and the GeM
    pyramid; DINOv2 by itself gives its class token. docs/methods.md has them all.
    """

    image_size: tuple[int, int] = (224, 224)
    """Height and width that images are resized to, multiples of 14."""
    normalisation: Literal["imagenet", "local-contrast"] = "imagenet"
    """What 8-bit pixels are normalised by: ImageNet or local mean and deviation."""
    backbone: ViTConfig = ViTConfig()
    aggregator: AggregatorName = "salad"
    """What makes descriptors of the backbone's features; docs/methods.md tells of each."""
    salad: SaladConfig = SaladConfig()
    gem_pyramid: GemPyramidConfig = GemPyramidConfig()
    class_token: ClassTokenConfig = ClassTokenConfig()
    gem: GemConfig = GemConfig()
    netvlad: NetVladConfig = NetVladConfig()
    conv_ap: ConvApConfig = ConvApConfig()
    cosplace: CosPlaceConfig = CosPlaceConfig()
    mixvpr: MixVprConfig = MixVprConfig()
    anyloc: AnyLocConfig = AnyLocConfig()
    boq: BoqConfig = BoqConfig()
    transvpr: TransVprConfig = TransVprConfig()
    encoder: CrossImageConfig = CrossImageConfig()
    compute_dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    """Type of the matrix products; normalisations, softmax and transport are float32 at least.
    float64 is for numerical studies, under JAX's 64-bit mode."""
    keeps: Literal["products", "blocks", "everything"] = "products"
    """What of a block's work stays in memory for the gradient: the results of its large products,
    its input alone (the least memory, a forward pass more), or all of it. Results are the same."""

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        choose(
            "ModelConfig.normalisation", self.normalisation, {"imagenet": 0, "local-contrast": 0}
        )
        choose(
            "ModelConfig.compute_dtype",
            self.compute_dtype,
            {"float32": 0, "bfloat16": 0, "float64": 0},
        )
        require_choice(self, "keeps")
        choose("ModelConfig.aggregator", self.aggregator, AGGREGATORS)
        self.check_image_size(self.image_size)
        depth = self.backbone.depth
        require(
            self.aggregator != "transvpr" or self.transvpr.levels <= depth,
            f"TransVprConfig.levels: found {self.transvpr.levels}, expected at most {depth}, the "
            "backbone's blocks",
        )
        if self.aggregator == "anyloc":
            self._check_anyloc()
        if self.encoder.layers:
            self._check_encoder()

    def _check_anyloc(self) -> None:
        self.anyloc.block(self.backbone.depth)
        require(
            not self.encoder.layers,
            f"CrossImageConfig.layers: found {self.encoder.layers} for aggregator anyloc, with "
            "which nothing trains, expected 0",
        )

    def _check_encoder(self) -> None:
        shape, heads = self.shape, self.encoder.heads
        width, name = shape.token_dim, f"aggregator {self.aggregator}"
        field = _WIDTHS.get(self.aggregator)
        require(
            width % heads == 0,
            f"{field or name}: found {width if field else f'tokens of {width} numbers'}, expected "
            f"a multiple of the cross-image encoder's {heads} heads",
        )
        require(
            not self.encoder.global_token or shape.global_dim % width == 0,
            f"SaladConfig.token_dim: found {shape.global_dim}, expected a multiple of "
            f"cluster_dim {width} so that the global token can enter the cross-image encoder "
            "(or CrossImageConfig.global_token False)",
        )
        require(
            self.encoder.global_token or shape.tokens > 0,
            f"CrossImageConfig.global_token: found False for {name}, which has no other token, "
            "expected True, or CrossImageConfig.layers 0",
        )

    @property
    def part(self) -> "AggregatorConfig":
        """The configuration of the aggregator that is chosen."""
        return getattr(self, AGGREGATORS[self.aggregator])

    @property
    def shape(self) -> TokenShape:
        """The tokens of an image."""
        return self.part.shape(self.backbone.dim)

    @property
    def descriptor_dim(self) -> int:
        """Numbers in one descriptor."""
        shape = self.shape
        return shape.global_dim + shape.tokens * shape.token_dim

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches in an image of `image_size`."""
        height, width = self.image_size
        return height // PATCH_SIZE, width // PATCH_SIZE

    @property
    def patches(self) -> int:
        """How many there are in an image of `image_size`."""
        return math.prod(self.grid)

    @property
    def aggregator_layers(self) -> int:
        """Layers of the aggregator, of which each has parameters of its own; 0 if it is fixed."""
        return {"mixvpr": self.mixvpr.depth, "boq": self.boq.layers}.get(self.aggregator, 0)

    @property
    def one_size(self) -> bool:
        """Whether the parameters belong to the patches of `image_size`, and serve no other."""
        return self.aggregator == "mixvpr"

    def check_image_size(self, image_size: tuple[int, int]) -> None:
        """Check that this model can describe images of this height and width.

        Raises:
            InputError: a side is no multiple of 14, there are too few patches for the aggregator,
                or its parameters are for another size.
        """
        if self.one_size and tuple(image_size) != self.image_size:
            found, expected = (f"{h} x {w}" for h, w in (image_size, self.image_size))
            raise InputError(
                f"image size: found {found}, expected {expected}: aggregator {self.aggregator} has "
                "parameters for every patch, and was made for images of this size alone"
            )
        if self.aggregator == "salad":
            # Where the dustbin's mass is what patches are more than clusters.
            differs = self.salad.sinkhorn.dustbin in ("column", "token")
            check_image_size(image_size, self.salad.clusters if differs else 0)
            return
        _check_sides(image_size)
        side = PATCH_SIZE * {"gem-pyramid": max(PYRAMID_LEVELS), "conv-ap": self.conv_ap.side}.get(
            self.aggregator, 1
        )
        require(
            min(image_size) >= side,
            f"image size: found {image_size[0]} x {image_size[1]}, expected at least {side} x "
            f"{side}, a patch for every region of aggregator {self.aggregator}",
        )


def check_image_size(image_size: tuple[int, int], clusters: int) -> None:
    """Check that images of this size make whole patches, and more of them than clusters.

    Raises:
        InputError: a side is no multiple of 14, or there are too few patches.
    """
    _check_sides(image_size)
    height, width = image_size
    patches = (height // PATCH_SIZE) * (width // PATCH_SIZE)
    side = next(s for s in range(1, clusters + 2) if s * s > clusters) * PATCH_SIZE
    require(
        patches > clusters,
        f"image size: found {height} x {width}, which is {patches} patches for {clusters} "
        "clusters; expected more patches than clusters (the smallest square that works: "
        f"{side} x {side})",
    )


def _check_sides(image_size: tuple[int, int]) -> None:
    height, width = image_size
    require(
        height > 0 and width > 0 and height % PATCH_SIZE == 0 and width % PATCH_SIZE == 0,
        f"image size: found {height} x {width}, expected sides that are multiples of {PATCH_SIZE} "
        f"(nearest: {_nearest_side(height)} x {_nearest_side(width)})",
    )


def _nearest_side(side: int) -> int:
    return max(PATCH_SIZE, round(side / PATCH_SIZE) * PATCH_SIZE)
