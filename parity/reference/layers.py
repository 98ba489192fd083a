"""The small layers, each in the type of its input: torch's, whose parameters may be wider."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def at_least_float32(x: Tensor) -> Tensor:
    """`x` in float32, or in its own type if that is wider: for norms, softmax and transport."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


class Linear(nn.Linear):
    """Affine map of the last axis."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., d_in) to (..., d_out)."""
        # Product and sum are rounded one by one, as in `crisalad_jax`.
        y = F.linear(x, self.weight.to(x.dtype))
        return y if self.bias is None else y + self.bias.to(x.dtype)


class Conv2d(nn.Conv2d):
    """Convolution, with or without bias."""

    def forward(self, x: Tensor) -> Tensor:
        """(batch, d_in, height, width) to (batch, d_out, height, width)."""
        weight = self.weight.to(x.dtype)
        y = F.conv2d(x, weight, stride=self.stride, padding=self.padding, groups=self.groups)
        return y if self.bias is None else y + self.bias.to(x.dtype)[:, None, None]


class LayerNorm(nn.LayerNorm):
    """Normalises the last axis, in float32 at least."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., dim) to (..., dim)."""
        y = F.layer_norm(
            at_least_float32(x), self.normalized_shape, self.weight, self.bias, self.eps
        )
        return y.to(x.dtype)


class BatchNorm2d(nn.BatchNorm2d):
    """Batch norm, in float32 at least inside."""

    def forward(self, x: Tensor) -> Tensor:
        """(batch, dim, height, width) to the same."""
        return super().forward(at_least_float32(x)).to(x.dtype)


def l2_normalise(x: Tensor) -> Tensor:
    """Scale the last axis to length 1."""
    return F.normalize(x, dim=-1)
