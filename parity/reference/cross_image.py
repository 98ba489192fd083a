"""The cross-image encoder (paper section 3.4): an explicit `nn.TransformerEncoder` across images.

Its layers are CricaVPR's: post-norm, with exact GELU.
"""

from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.nn.cross_image import CrossImageConfig
from parity.reference.attention import MultiheadAttention
from parity.reference.layers import LayerNorm, Linear

NORM_EPSILON = 1e-5


class EncoderLayer(nn.Module):
    """Attention and feed-forward network, with a layer norm after each."""

    def __init__(self, dim: int, config: CrossImageConfig) -> None:
        """Make it for tokens of width `dim`."""
        super().__init__()
        self.self_attn = MultiheadAttention(dim, config.heads, config.dropout)
        self.linear1 = Linear(dim, config.feedforward)
        self.linear2 = Linear(config.feedforward, dim)
        self.norm1 = LayerNorm(dim, eps=NORM_EPSILON)
        self.norm2 = LayerNorm(dim, eps=NORM_EPSILON)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        """Map (image, token, dim) to the same shape."""
        across = tokens.transpose(0, 1)
        attended = self.self_attn(across, mask).transpose(0, 1)
        tokens = self.norm1(tokens + self.dropout(attended))
        hidden = self.dropout(F.gelu(self.linear1(tokens)))
        return self.norm2(tokens + self.dropout(self.linear2(hidden)))


class CrossImageEncoder(nn.Module):
    """The layers, in order."""

    def __init__(self, dim: int, config: CrossImageConfig) -> None:
        """Make it for tokens of width `dim`."""
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(dim, config) for _ in range(config.layers))

    def forward(self, tokens: Tensor, mask: Tensor | None = None) -> Tensor:
        """Let each token attend to the same token of other images, for (image, token, dim).

        `mask[i, j]` is whether image i may attend to image j; None allows all.
        """
        for layer in self.layers:
            tokens = layer(tokens, mask)
        return tokens
