"""CriSALAD: the composition of backbone, aggregation and cross-image encoder (paper Figure 1).

DINO-SALAD, CricaVPR and bare DINOv2 are the same composition with other parts.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from crisalad_jax.config import ModelConfig
from parity.reference.cross_image import CrossImageEncoder
from parity.reference.layers import l2_normalise, widen
from parity.reference.pyramid import GemPyramid, UnitPatches
from parity.reference.salad import Salad, published_order
from parity.reference.tokens import Tokens, as_sequence, from_sequence
from parity.reference.transvpr import TransVpr
from parity.reference.vit import Features, ViT
from parity.reference.vlad import AnyLoc, NetVlad

AGGREGATORS: Mapping[str, Callable[[ModelConfig], nn.Module]] = {
    "salad": lambda config: Salad(config.backbone.dim, config.salad),
    "netvlad": lambda config: NetVlad(config.backbone.dim, config.netvlad.clusters),
    "anyloc": lambda config: AnyLoc(config.backbone.dim, config.anyloc.clusters),
    "transvpr": lambda config: TransVpr(config.backbone.dim, config.transvpr),
}
"""Those that are called `aggregator` in a state."""


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
        kind = config.aggregator
        self.aggregator = AGGREGATORS[kind](config) if kind in AGGREGATORS else None
        self.aggregation = (
            nn.Sequential(UnitPatches(), GemPyramid()) if kind == "gem-pyramid" else None
        )
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
        if self.aggregator is not None:
            return self.aggregator(features)
        class_token, patches = widen(features.class_token), widen(features.patches)
        if self.aggregation is not None:
            return Tokens(class_token, self.aggregation(patches))
        return Tokens(class_token, class_token.new_zeros(len(class_token), 0, patches.shape[1]))

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
        salad = self.config.aggregator == "salad"
        local = published_order(tokens.local) if salad else tokens.local
        return l2_normalise(torch.cat([tokens.global_token, local.flatten(1)], dim=1))
