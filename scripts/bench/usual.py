"""The reference of the parity checks, as a torch user would write it.

The reference is written for readability: attention step by step, a bias added after its product,
every step rounded separately. Here attention is torch's own (`scaled_dot_product_attention`), and
biases are added within the products.
"""

import dataclasses

from torch import Tensor
from torch.nn import functional as F

from parity.reference import attention, layers
from parity.reference.model import Crisalad


class _Linear(layers.Linear):
    def forward(self, x: Tensor) -> Tensor:
        bias = None if self.bias is None else self.bias.to(x.dtype)
        return F.linear(x, self.weight.to(x.dtype), bias)


class _Conv2d(layers.Conv2d):
    def forward(self, x: Tensor) -> Tensor:
        bias = None if self.bias is None else self.bias.to(x.dtype)
        return self._conv_forward(x, self.weight.to(x.dtype), bias)


def _attend(qkv: Tensor, heads: int, mask: Tensor | None, dropout_rate: float) -> Tensor:
    queries, keys, values = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4).unbind()
    mixed = F.scaled_dot_product_attention(
        queries, keys, values, attn_mask=mask, dropout_p=dropout_rate
    )
    return mixed.transpose(1, 2).flatten(2)


class _Attention(attention.Attention):
    def forward(self, x: Tensor) -> Tensor:
        return self.proj(_attend(self.qkv(x), self.heads, None, 0.0))


class _MultiheadAttention(attention.MultiheadAttention):
    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        qkv = F.linear(x, self.in_proj_weight.to(x.dtype), self.in_proj_bias.to(x.dtype))
        rate = self.dropout if self.training else 0.0
        return self.out_proj(_attend(qkv, self.heads, mask, rate))


_USUAL: dict[type, type] = {
    layers.Linear: _Linear,
    layers.Conv2d: _Conv2d,
    attention.Attention: _Attention,
    attention.MultiheadAttention: _MultiheadAttention,
}


def as_users_write_it(model: Crisalad) -> Crisalad:
    """Convert a reference model to the usual torch layers, in place."""
    for layer in model.modules():
        layer.__class__ = _USUAL.get(type(layer), type(layer))
    return model


def narrowed(model: Crisalad) -> Crisalad:
    """Store a converted model's product weights in its compute type, in place.

    Otherwise each call converts them. Norms stay float32, like all parameters that train.
    """
    for layer in model.modules():
        if isinstance(layer, _Linear | _Conv2d | _MultiheadAttention):
            for parameter in layer.parameters(recurse=False):
                parameter.data = parameter.data.to(model.compute_dtype)
    return model


def widened(model: Crisalad) -> Crisalad:
    """Return a copy of a converted model that computes in float32."""
    config = dataclasses.replace(model.config, compute_dtype="float32")
    wide = as_users_write_it(Crisalad(config))
    wide.load_state_dict(model.state_dict())
    return wide.eval()
