"""Small layers of torch that compute in the type of their input; parameters may be wider."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def at_least_float32(x: Tensor) -> Tensor:
    """Cast `x` to float32 unless its type is wider, for norms, softmax and transport."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


class Linear(nn.Linear):
    """Affine map of the last axis."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., d_in) to (..., d_out)."""
        # Product and sum are rounded separately, as in `crisalad_jax`.
        y = F.linear(x, self.weight.to(x.dtype))
        return y if self.bias is None else y + self.bias.to(x.dtype)


class Conv2d(nn.Conv2d):
    """Convolution, with or without bias."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, d_in, height, width) to (batch, d_out, height, width)."""
        weight = self.weight.to(x.dtype)
        y = F.conv2d(x, weight, stride=self.stride, padding=self.padding, groups=self.groups)
        return y if self.bias is None else y + self.bias.to(x.dtype)[:, None, None]


class LayerNorm(nn.LayerNorm):
    """Layer norm of the last axis, in at least float32."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., dim) to the same shape."""
        y = F.layer_norm(
            at_least_float32(x), self.normalized_shape, self.weight, self.bias, self.eps
        )
        return y.to(x.dtype)


class BatchNorm2d(nn.BatchNorm2d):
    """Batch norm that computes in at least float32."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, dim, height, width) to the same shape."""
        return super().forward(at_least_float32(x)).to(x.dtype)


def l2_normalise(x: Tensor) -> Tensor:
    """Scale the last axis to length 1."""
    return F.normalize(x, dim=-1)
