"""CriSALAD: the composition of backbone, aggregation and cross-image encoder (paper Figure 1).

DINO-SALAD, CricaVPR and bare DINOv2 are the same composition with other parts.
"""

import torch
from torch import Tensor, nn

from crisalad_jax.config import ModelConfig
from parity.reference.boq import Boq
from parity.reference.conv_ap import ConvAp
from parity.reference.cosplace import CosPlace
from parity.reference.cross_image import CrossImageEncoder
from parity.reference.gem import GeM, UnitPatches
from parity.reference.layers import l2_normalise, widen
from parity.reference.mixvpr import MixVpr
from parity.reference.pyramid import GemPyramid
from parity.reference.salad import Salad, published_order
from parity.reference.tokens import (
    Tokens,
    as_sequence,
    from_sequence,
    global_alone,
    local_alone,
)
from parity.reference.transvpr import TransVpr
from parity.reference.vit import Features, ViT
from parity.reference.vlad import AnyLoc, NetVlad


class Crisalad(nn.Module):
    """A whole model. As every module of torch it draws dropout until `eval()` is called.

    `config.compute_dtype` is the type of the activations; the parameters are float32, but for a
    float64 model: `compute_dtype="float64"` and `.double()`.
    """

    def __init__(self, config: ModelConfig) -> None:
        """Random parameters; for those of a checkpoint, `load_state_dict`."""
        super().__init__()
        self.config = config
        self.compute_dtype: torch.dtype = getattr(torch, config.compute_dtype)
        self.backbone = ViT(config.backbone)
        self.aggregator = _aggregator(config)
        self.aggregation = _aggregation(config)
        self.encoder = (
            CrossImageEncoder(config.shape.token_dim, config.encoder)
            if config.encoder.layers
            else None
        )

    def forward(self, images: Tensor, mask: Tensor | None = None) -> Tensor:
        """Unit descriptors of a batch of images.

        Args:
            images: (batch, 3, height, width), normalised; the sides are multiples of 14.
            mask: (batch, batch) of bool: `mask[i, j]` says that image i may look at image j. None
                lets all look at all.

        Returns:
            (batch, descriptor).

        Raises:
            InputError: wrong sides, or too few patches for the aggregator.
        """
        return self.relate(self.tokenise(images), mask)

    def tokenise(self, images: Tensor) -> Tokens:
        """The first half of `forward`: every image's tokens, which owe nothing to other images."""
        self.config.check_image_size((images.shape[2], images.shape[3]))
        images = images.to(self.compute_dtype)
        if self.config.aggregator == "anyloc":
            number = self.config.anyloc.block(self.config.backbone.depth)
            return self.aggregate(self.backbone.facet(images, number, self.config.anyloc.facet))
        if self.config.aggregator == "transvpr":
            depths = self.config.transvpr.depths(self.config.backbone.depth)
            return self.aggregate(self.backbone(images, depths))
        return self.aggregate(self.backbone(images))

    def aggregate(self, features: Features) -> Tokens:
        """From a backbone's features to the images' tokens, in float32 at least."""
        if isinstance(self.aggregator, Salad | NetVlad | AnyLoc | TransVpr):
            return self.aggregator(features)
        if self.aggregator is not None:
            return local_alone(self.aggregator(features.patches))
        if isinstance(self.aggregation, CosPlace):
            return global_alone(self.aggregation(features.patches))
        class_token, patches = widen(features.class_token), widen(features.patches)
        if self.aggregation is None:
            return global_alone(class_token)
        pooled = self.aggregation(patches)
        return global_alone(pooled) if pooled.ndim == 2 else Tokens(class_token, pooled)

    def relate(self, tokens: Tokens, mask: Tensor | None = None) -> Tensor:
        """The second half: images look at each other, then become descriptors."""
        if self.encoder is not None:
            global_token = self.config.encoder.global_token
            sequence = as_sequence(tokens, global_token=global_token).to(self.compute_dtype)
            sequence = self.encoder(sequence, mask).to(tokens.local.dtype)
            tokens = from_sequence(sequence, tokens, global_token=global_token)
        return self.join(tokens)

    def join(self, tokens: Tokens) -> Tensor:
        """One unit descriptor: the global token, then the local ones in the published order."""
        transposed = self.config.aggregator in ("salad", "conv-ap", "mixvpr", "boq")
        local = published_order(tokens.local) if transposed else tokens.local
        return l2_normalise(torch.cat([tokens.global_token, local.flatten(1)], dim=1))


def _aggregator(config: ModelConfig) -> nn.Module | None:
    """What is called `aggregator` in a state, as most public checkpoints have it."""
    dim = config.backbone.dim
    conv_ap, mixvpr = config.conv_ap, config.mixvpr
    if config.aggregator == "salad":
        return Salad(dim, config.salad)
    if config.aggregator == "conv-ap":
        return ConvAp(dim, conv_ap.channels, conv_ap.side)
    if config.aggregator == "transvpr":
        return TransVpr(dim, config.transvpr)
    if config.aggregator == "netvlad":
        return NetVlad(dim, config.netvlad.clusters)
    if config.aggregator == "anyloc":
        return AnyLoc(dim, config.anyloc.clusters)
    if config.aggregator == "mixvpr":
        return MixVpr(dim, config.patches, mixvpr.channels, mixvpr.rows, mixvpr.depth)
    return Boq(dim, config.boq) if config.aggregator == "boq" else None


def _aggregation(config: ModelConfig) -> nn.Module | None:
    """What others name `aggregation`."""
    if config.aggregator == "cosplace":
        return CosPlace(config.backbone.dim, config.cosplace.dim)
    pools = {"gem": GeM, "gem-pyramid": GemPyramid}
    if config.aggregator not in pools:
        return None
    return nn.Sequential(UnitPatches(), pools[config.aggregator]())
