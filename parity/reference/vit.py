"""DINOv2's vision transformer ViT/14 (Oquab et al. 2023; registers: Darcet et al. 2024)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.nn.backbones.vit import ViTConfig
from parity.reference.adapter import make_adapter
from parity.reference.attention import Attention
from parity.reference.layers import Conv2d, LayerNorm, Linear

NORM_EPSILON = 1e-6
PATCH_SIZE = ViTConfig.patch_size


class Features(NamedTuple):
    """The output of a backbone, after its last layer norm."""

    class_token: Tensor
    """(batch, dim)."""
    patches: Tensor
    """(batch, dim, rows, columns)."""


class PatchEmbed(nn.Module):
    """A linear map of each patch, written as a convolution with stride equal to its size."""

    def __init__(self, dim: int) -> None:
        """Make a map from the 3 x 14 x 14 values of a patch to `dim`."""
        super().__init__()
        self.proj = Conv2d(3, dim, PATCH_SIZE, stride=PATCH_SIZE)

    def forward(self, images: Tensor) -> Tensor:
        """Map (batch, 3, height, width) to (batch, patch, dim), patches in row order."""
        return self.proj(images).flatten(2).mT


class LayerScale(nn.Module):
    """A gain for every channel."""

    def __init__(self, dim: int, start: float) -> None:
        """Initialise all gains to `start`."""
        super().__init__()
        self.gamma = nn.Parameter(torch.full((dim,), start))

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., dim) to the same shape."""
        return self.gamma.to(x.dtype) * x


class Mlp(nn.Module):
    """Feed-forward network: fc1, exact GELU, fc2."""

    def __init__(self, dim: int, hidden: int) -> None:
        """Make a network with one hidden layer of width `hidden`."""
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., dim) to the same shape."""
        return self.fc2(F.gelu(self.fc1(x)))


class SwiGlu(nn.Module):
    """Feed-forward network of ViT-g (Shazeer 2020): gate and value concatenated in w12, then w3."""

    def __init__(self, dim: int, hidden: int) -> None:
        """Make gate and value layers of width `hidden`."""
        super().__init__()
        self.w12 = Linear(dim, 2 * hidden)
        self.w3 = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., dim) to the same shape."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * value)


class Block(nn.Module):
    """One block (paper Eq. 2), with LayerScale over both MLP and adapter, as in CricaVPR."""

    def __init__(self, config: ViTConfig) -> None:
        """Make a block with the feed-forward network and the adapter that `config` names."""
        super().__init__()
        feed_forward = SwiGlu if config.ffn == "swiglu" else Mlp
        self.alpha = getattr(config.adapter, "alpha", 0.0)
        self.norm1 = LayerNorm(config.dim, eps=NORM_EPSILON)
        self.attn = Attention(config.dim, config.heads)
        self.ls1 = LayerScale(config.dim, config.layer_scale_init)
        self.norm2 = LayerNorm(config.dim, eps=NORM_EPSILON)
        self.mlp = feed_forward(config.dim, config.hidden)
        self.ls2 = LayerScale(config.dim, config.layer_scale_init)
        self.adapter = make_adapter(config)

    def forward(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Map (batch, token, dim) to the same shape; `grid` is the rows and columns of patches."""
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        normed = self.norm2(tokens)
        update = self.mlp(normed)
        if self.adapter is not None:
            update = update + self.alpha * self.adapter(normed, grid)
        return tokens + self.ls2(update)


class ViT(nn.Module):
    """The backbone. `mask_token` is DINOv2's training token, stored but never used here."""

    def __init__(self, config: ViTConfig) -> None:
        """Initialise like DINOv2: matrices normal with deviation 0.02, biases 0."""
        super().__init__()
        dim, side = config.dim, config.position_grid
        if config.position_init == "sincos":
            positions = _sincos_positions(side, dim)
        else:
            positions = 0.02 * torch.randn(side * side, dim)
        self.cls_token = nn.Parameter(1e-6 * torch.randn(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.cat([torch.zeros(1, dim), positions])[None])
        self.register_tokens = (
            nn.Parameter(1e-6 * torch.randn(1, config.registers, dim)) if config.registers else None
        )
        self.mask_token = nn.Parameter(torch.zeros(1, dim))
        self.patch_embed = PatchEmbed(dim)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.norm = LayerNorm(dim, eps=NORM_EPSILON)
        for name, parameter in self.named_parameters():
            if ".adapter." in name:
                continue
            if name.endswith(".bias"):
                nn.init.zeros_(parameter)
            elif name.endswith(".weight") and parameter.ndim > 1:
                nn.init.trunc_normal_(parameter, std=0.02, a=-0.04, b=0.04)

    def forward(self, images: Tensor, depths: Sequence[int] | None = None) -> Features:
        """Map (batch, 3, height, width) to features; the sides are multiples of 14.

        With `depths`, the patches after those numbers of blocks, each through the last norm, are
        concatenated.
        """
        grid = grid_of(images)
        if depths is not None:
            tokens, levels = self.embed(images), []
            for depth, block in enumerate(self.blocks, 1):
                tokens = block(tokens, grid)
                if depth in depths:
                    levels.append(self.norm(tokens)[:, -grid[0] * grid[1] :])
            patches = torch.cat(levels, dim=2)
            return Features(self.norm(tokens)[:, 0], patches.mT.unflatten(-1, grid))
        tokens = self.norm(self.run_blocks(self.embed(images), grid))
        patches = tokens[:, -grid[0] * grid[1] :]
        return Features(tokens[:, 0], patches.mT.unflatten(-1, grid))

    def facet(self, images: Tensor, number: int, name: str) -> Features:
        """Return queries, keys, values or tokens of block `number`, heads concatenated (AnyLoc)."""
        grid = grid_of(images)
        tokens = self.embed(images)
        for block in self.blocks[:number]:
            tokens = block(tokens, grid)
        last = self.blocks[number]
        assert isinstance(last, Block)
        if name == "token":
            found = last(tokens, grid)
        else:
            three = last.attn.qkv(last.norm1(tokens)).chunk(3, dim=-1)
            found = dict(zip(("query", "key", "value"), three, strict=True))[name]
        patches = found[:, -grid[0] * grid[1] :]
        return Features(found[:, 0], patches.mT.unflatten(-1, grid))

    def embed(self, images: Tensor) -> Tensor:
        """Embed class token, registers and patches, with positions except for registers."""
        patches = self.patch_embed(images)
        positions = self.interpolate_positions(grid_of(images))
        special = self.cls_token + self.pos_embed[:, :1]
        if self.register_tokens is not None:
            special = torch.cat([special, self.register_tokens], dim=1)
        special = special.to(images.dtype).expand(len(images), -1, -1)
        return torch.cat([special, patches + positions.to(images.dtype)], dim=1)

    def run_blocks(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Apply all blocks in order."""
        for block in self.blocks:
            tokens = block(tokens, grid)
        return tokens

    def interpolate_positions(self, grid: tuple[int, int]) -> Tensor:
        """Resize position embeddings to a grid, (1, rows x columns, dim), like DINOv2.

        Models without registers resize by the scale (size + 0.1) / side, those with registers to
        the exact size with antialiasing. A grid of the stored size is left unchanged.
        """
        stored = self.pos_embed[:, 1:]
        side = round(stored.shape[1] ** 0.5)
        if grid == (side, side):
            return stored
        image = stored.mT.unflatten(-1, (side, side))
        if self.register_tokens is None:
            scale = [(size + 0.1) / side for size in grid]
            resized = F.interpolate(image, scale_factor=scale, mode="bicubic")
        else:
            resized = F.interpolate(image, size=grid, mode="bicubic", antialias=True)
        return resized.flatten(2).mT


def grid_of(images: Tensor) -> tuple[int, int]:
    """Return rows and columns of patches."""
    return images.shape[-2] // PATCH_SIZE, images.shape[-1] // PATCH_SIZE


def _sincos_positions(side: int, dim: int) -> Tensor:
    """Compute MoCo v3's fixed 2-D sine-cosine codes, half the width each for rows and columns."""
    frequencies = 1e4 ** -(torch.arange(dim // 4) / (dim // 4))
    angles = torch.outer(torch.arange(side), frequencies)
    code = torch.cat([angles.sin(), angles.cos()], dim=1)
    return torch.cat([code.repeat_interleave(side, dim=0), code.repeat(side, 1)], dim=1)
