"""CriSALAD: the composition of backbone, aggregation and cross-image encoder (paper Figure 1).

DINO-SALAD, CricaVPR and plain DINOv2 are the same composition with other parts.
"""

import torch
from torch import Tensor, nn

from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig, GemConfig, GemPyramidConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig, NetVladConfig, SuperVladConfig
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from parity.reference.boq import Boq
from parity.reference.cnn import ResNet, Vgg
from parity.reference.conv_ap import ConvAp
from parity.reference.cosplace import CosPlace
from parity.reference.cross_image import CrossImageEncoder
from parity.reference.gem import GeM, UnitPatches
from parity.reference.layers import at_least_float32, l2_normalise
from parity.reference.mixvpr import MixVpr
from parity.reference.pyramid import GemPyramid
from parity.reference.salad import Salad, published_order
from parity.reference.tokens import Tokens, as_sequence, from_sequence
from parity.reference.transvpr import TransVpr
from parity.reference.vit import Features, ViT
from parity.reference.vlad import AnyLoc, NetVlad, SuperVlad

TRANSPOSED = (SaladConfig, ConvApConfig, MixVprConfig, BoqConfig)
"""Heads whose public descriptors hold the first dimension of all local tokens, then the second."""
HELD = (
    *TRANSPOSED,
    AnyLocConfig,
    ClassTokenConfig,
    CosPlaceConfig,
    GemConfig,
    GemPyramidConfig,
    NetVladConfig,
    SuperVladConfig,
    TransVprConfig,
)


class Crisalad(nn.Module):
    """A whole model. Like every torch module, it applies dropout until `eval()` is called.

    `config.compute_dtype` is the type of the activations; parameters are float32. For a float64
    model, use `compute_dtype="float64"` and `.double()`.
    """

    def __init__(self, config: ModelConfig) -> None:
        """Make a model with random parameters; use `load_state_dict` for those of a checkpoint.

        Raises:
            InputError: a part that doesn't come with `crisalad_jax`.
        """
        super().__init__()
        if not isinstance(config.aggregator, HELD):
            raise InputError(
                f"aggregator: found {config.aggregator.part_name}, expected one that comes with "
                "crisalad_jax"
            )
        self.config = config
        self.compute_dtype: torch.dtype = getattr(torch, config.compute_dtype)
        self.backbone = _backbone(config.backbone)
        self.aggregator = _aggregator(config)
        self.aggregation = _aggregation(config)
        self.encoder = (
            CrossImageEncoder(config.token_shape.token_dim, config.cross_image)
            if config.cross_image.attends
            else None
        )
        dim = config.projection.dim
        self.projection = nn.Linear(config.unprojected_dim, dim) if dim else None

    def forward(self, images: Tensor, mask: Tensor | None = None) -> Tensor:
        """Compute unit descriptors of a batch of images.

        Args:
            images: (batch, 3, height, width), normalised; the sides fit the backbone.
            mask: (batch, batch) of bool: `mask[i, j]` is whether image i may attend to image j;
                None allows all.

        Returns:
            (batch, descriptor).

        Raises:
            InputError: wrong sides, or too few patches for the aggregator.
        """
        return self.attend_across_images(self.extract_tokens(images), mask)

    def extract_tokens(self, images: Tensor) -> Tokens:
        """Compute each image's tokens, independent of others: the first half of `forward`."""
        self.config.check_image_size((images.shape[2], images.shape[3]))
        images = images.to(self.compute_dtype)
        if not isinstance(self.backbone, ViT):
            return self.aggregate(self.backbone(images))
        depth, found = self.config.backbone.depth, self.config.aggregator
        if isinstance(found, AnyLocConfig):
            return self.aggregate(self.backbone.facet(images, found.layer % depth, found.facet))
        if isinstance(found, TransVprConfig):
            return self.aggregate(self.backbone(images, found.features(depth).levels))
        if isinstance(found, BoqConfig | MixVprConfig) and not found.last_norm:
            return self.aggregate(self.backbone.facet(images, depth - 1, "token"))
        return self.aggregate(self.backbone(images))

    def aggregate(self, features: Features) -> Tokens:
        """Aggregate a backbone's features into tokens, in at least float32."""
        if isinstance(self.aggregator, Salad | NetVlad | AnyLoc | TransVpr):
            return self.aggregator(features)
        if self.aggregator is not None:
            return Tokens.of_local(self.aggregator(features.patches))
        if isinstance(self.aggregation, SuperVlad):
            return self.aggregation(features)
        if isinstance(self.aggregation, CosPlace):
            return Tokens.of_global(self.aggregation(features.patches))
        class_token = at_least_float32(features.class_token)
        if self.aggregation is None:
            return Tokens.of_global(class_token)
        pooled = self.aggregation(at_least_float32(features.patches))
        return Tokens.of_global(pooled) if pooled.ndim == 2 else Tokens(class_token, pooled)

    def attend_across_images(self, tokens: Tokens, mask: Tensor | None = None) -> Tensor:
        """Compute descriptors with attention across images: the second half of `forward`."""
        if self.encoder is not None:
            global_token = self.config.cross_image.global_token
            sequence = as_sequence(tokens, global_token=global_token).to(self.compute_dtype)
            sequence = self.encoder(sequence, mask).to(tokens.local.dtype)
            tokens = from_sequence(sequence, tokens, global_token=global_token)
        return self.to_descriptor(tokens)

    def to_descriptor(self, tokens: Tokens) -> Tensor:
        """Concatenate the global token and the local ones in the published order, then project."""
        transposed = isinstance(self.config.aggregator, TRANSPOSED)
        local = published_order(tokens.local) if transposed else tokens.local
        descriptor = l2_normalise(torch.cat([tokens.global_token, local.flatten(1)], dim=1))
        if self.projection is None:
            return descriptor
        projected = self.projection(descriptor)
        return l2_normalise(projected) if self.config.projection.renormalise else projected


def _backbone(config: Backbone) -> ViT | ResNet | Vgg:
    if isinstance(config, ViTConfig):
        return ViT(config)
    if isinstance(config, ResNetConfig):
        return ResNet(config)
    if isinstance(config, VggConfig):
        return Vgg()
    raise InputError(f"backbone: found {config.part_name}, expected vit, resnet or vgg")


def _aggregator(config: ModelConfig) -> nn.Module | None:
    """Make the part named `aggregator` in a state dict, as in most public checkpoints."""
    dim, found = config.backbone.dim, config.aggregator
    if isinstance(found, SaladConfig):
        return Salad(dim, found)
    if isinstance(found, ConvApConfig):
        return ConvAp(dim, found.channels, found.side)
    if isinstance(found, TransVprConfig):
        return TransVpr(dim, found)
    if isinstance(found, NetVladConfig):
        return NetVlad(dim, found.clusters)
    if isinstance(found, AnyLocConfig):
        return AnyLoc(dim, found.clusters)
    if isinstance(found, MixVprConfig):
        return MixVpr(dim, config.patches, found.channels, found.rows, found.depth)
    return Boq(dim, found) if isinstance(found, BoqConfig) else None


def _aggregation(config: ModelConfig) -> nn.Module | None:
    """Make the part that other checkpoints name `aggregation`."""
    found = config.aggregator
    if isinstance(found, CosPlaceConfig):
        return CosPlace(config.backbone.dim, found.dim)
    if isinstance(found, SuperVladConfig):
        return SuperVlad(config.backbone.dim, found.clusters, found.ghosts)
    if isinstance(found, GemPyramidConfig):
        return nn.Sequential(UnitPatches(), GemPyramid())
    if isinstance(found, GemConfig):
        return nn.Sequential(UnitPatches(), GeM())
    return None
