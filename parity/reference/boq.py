"""Bag of queries (Ali-bey et al., CVPR 2024), built from torch's transformer modules."""

import torch
from torch import Tensor, nn
from torch.func import functional_call

from crisalad_jax.nn.aggregators.queries import BoqConfig
from parity.reference.layers import Conv2d, LayerNorm, Linear, at_least_float32


class BoqBlock(nn.Module):
    """An encoder layer over patches, and queries that attend to each other, then to the patches."""

    def __init__(self, config: BoqConfig) -> None:
        """Make a block whose queries start normal with deviation 1."""
        super().__init__()
        width, heads = config.channels, config.heads
        self.encoder = nn.TransformerEncoderLayer(
            width, heads, dim_feedforward=4 * width, dropout=0.0, batch_first=True
        )
        self.queries = nn.Parameter(torch.randn(1, config.queries, width))
        self.self_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm_q = LayerNorm(width)
        self.cross_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm_out = LayerNorm(width)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map (batch, patch, channel) to the next block's input and (batch, query, channel)."""
        x = _cast(self.encoder, x)
        queries = self.queries.to(x.dtype).expand(len(x), -1, -1)
        queries = self.norm_q(queries + _cast(self.self_attn, queries, queries, queries)[0])
        return x, self.norm_out(_cast(self.cross_attn, queries, x, x)[0])


class Boq(nn.Module):
    """A channel reduction, the blocks in order, then a linear mix of all their outputs."""

    def __init__(self, dim: int, config: BoqConfig) -> None:
        """Make a head for feature maps of `dim` channels."""
        super().__init__()
        self.proj_c = Conv2d(dim, config.channels, 3, padding=1)
        self.norm_input = LayerNorm(config.channels)
        self.boqs = nn.ModuleList(BoqBlock(config) for _ in range(config.layers))
        self.fc = Linear(config.layers * config.queries, config.rows)

    def forward(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to (batch, row, channel)."""
        x = self.norm_input(self.proj_c(patches).flatten(2).mT)
        answers = []
        for block in self.boqs:
            x, answer = block(x)
            answers.append(answer)
        return at_least_float32(self.fc(torch.cat(answers, dim=1).mT)).mT


def _cast(module: nn.Module, *inputs: Tensor) -> Tensor:
    """Apply a torch module with its parameters cast to the type of the inputs."""
    cast = {name: parameter.to(inputs[0].dtype) for name, parameter in module.named_parameters()}
    return functional_call(module, cast, inputs)
