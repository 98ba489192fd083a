"""EDTformer (Jin et al. 2025): side adapters and a decoder, built from torch's attention."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.nn.aggregators.queries import EdtFormerConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from parity.reference.layers import l2_normalise
from parity.reference.vit import ViT


class SideAdapter(nn.Module):
    """Down, GELU, up."""

    def __init__(self, dim: int, width: int) -> None:
        """Make an adapter for tokens of `dim` with a bottleneck of `width`."""
        super().__init__()
        self.D_fc1 = nn.Linear(dim, width)
        self.D_fc2 = nn.Linear(width, dim)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map (batch, token, dim) to the same shape."""
        return self.D_fc2(F.gelu(self.D_fc1(tokens)))


class SideViT(ViT):
    """Unmodified DINOv2 with a side path: z = x + y, then y = z + alpha A(z) for each block."""

    def __init__(self, config: ViTConfig) -> None:
        """Make one adapter for each block, outside the block."""
        super().__init__(config)
        self.alpha = config.adapter.alpha
        width = config.adapter.width(config.dim)
        self.adapters = nn.ModuleList(SideAdapter(config.dim, width) for _ in self.blocks)

    def run_blocks(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Map (batch, token, dim) to the output of the side path."""
        beside = tokens
        for block, adapter in zip(self.blocks, self.adapters, strict=True):
            tokens = block(tokens, grid)
            both = tokens + beside
            beside = both + self.alpha * adapter(both)
        return beside


class DecoderLayer(nn.Module):
    """Queries attend to each other, then to the tokens, with a norm after each."""

    def __init__(self, width: int, heads: int) -> None:
        """Make a layer with two of torch's attentions."""
        super().__init__()
        self.self_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.multihead_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)

    def forward(self, queries: Tensor, tokens: Tensor) -> Tensor:
        """Map (batch, query, width) and (batch, token, width) to (batch, query, width)."""
        queries = self.norm1(queries + self.self_attn(queries, queries, queries)[0])
        return self.norm2(queries + self.multihead_attn(queries, tokens, tokens)[0])


class Decoder(nn.Module):
    """The layers in order."""

    def __init__(self, config: EdtFormerConfig) -> None:
        """Make the number of layers in `config`."""
        super().__init__()
        made = (DecoderLayer(config.width, config.heads) for _ in range(config.layers))
        self.layers = nn.ModuleList(made)

    def forward(self, queries: Tensor, tokens: Tensor) -> Tensor:
        """Map (batch, query, width) and (batch, token, width) to (batch, query, width)."""
        for layer in self.layers:
            queries = layer(queries, tokens)
        return queries


class EdtFormer(nn.Module):
    """The whole model, under the public names."""

    def __init__(self, backbone: ViTConfig, head: EdtFormerConfig) -> None:
        """Make a model with random parameters."""
        super().__init__()
        self.queries = nn.Parameter(torch.randn(1, head.queries, head.width))
        self.backbone = SideViT(backbone)
        self.fc = nn.Linear(backbone.dim, head.width)
        self.decoder = Decoder(head)
        self.channel_proj = nn.Linear(head.width, head.channels)
        self.row_proj = nn.Linear(head.queries, head.rows)

    def forward(self, images: Tensor) -> Tensor:
        """Map (batch, 3, height, width) to unit descriptors, ordered by channel."""
        features = self.backbone(images)
        tokens = [features.class_token[:, None], features.patches.flatten(2).mT]
        tokens = self.fc(torch.cat(tokens, dim=1))
        answers = self.decoder(self.queries.expand(len(images), -1, -1), tokens)
        rows = self.row_proj(self.channel_proj(answers).mT)
        return l2_normalise(rows.flatten(1))
