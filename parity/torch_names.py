"""Our parameters from arrays under the public torch names: the parts that golden files hold."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.nn.attention import Attention
from crisalad_jax.nn.cross_image import CrossImageEncoder, EncoderLayer
from crisalad_jax.nn.layers import LayerNorm, Linear
from crisalad_jax.nn.salad import Salad, TwoLayer
from crisalad_jax.nn.vit import Block, Mlp, ViT

State = Mapping[str, np.ndarray]


def _linear(state: State, name: str) -> Linear:
    """A torch linear layer or 1 x 1 convolution."""
    weight = state[f"{name}.weight"]
    return Linear(
        jnp.asarray(weight.reshape(weight.shape[:2]).T), jnp.asarray(state[f"{name}.bias"])
    )


def _layer_norm(state: State, name: str) -> LayerNorm:
    return LayerNorm(jnp.asarray(state[f"{name}.weight"]), jnp.asarray(state[f"{name}.bias"]))


def vit_from_torch(state: State, depth: int) -> ViT:
    """DINOv2 under facebookresearch/dinov2's names (MLP blocks; mask_token is training-only)."""
    positions = state["pos_embed"][0]
    side = round((len(positions) - 1) ** 0.5)
    dim = positions.shape[1]
    patch = state["patch_embed.proj.weight"]  # (dim, channel, row, column)
    blocks = [
        Block(
            norm1=_layer_norm(state, f"blocks.{i}.norm1"),
            attn=Attention(
                _linear(state, f"blocks.{i}.attn.qkv"), _linear(state, f"blocks.{i}.attn.proj")
            ),
            ls1=jnp.asarray(state[f"blocks.{i}.ls1.gamma"]),
            norm2=_layer_norm(state, f"blocks.{i}.norm2"),
            mlp=Mlp(_linear(state, f"blocks.{i}.mlp.fc1"), _linear(state, f"blocks.{i}.mlp.fc2")),
            ls2=jnp.asarray(state[f"blocks.{i}.ls2.gamma"]),
            adapter=None,
        )
        for i in range(depth)
    ]
    return ViT(
        patch_embed=Linear(
            jnp.asarray(patch.transpose(2, 3, 1, 0).reshape(-1, dim)),
            jnp.asarray(state["patch_embed.proj.bias"]),
        ),
        cls_token=jnp.asarray(state["cls_token"][0, 0]),
        register_tokens=jnp.asarray(state.get("register_tokens", np.zeros((1, 0, dim), "f"))[0]),
        pos_embed_cls=jnp.asarray(positions[0]),
        pos_embed=jnp.asarray(positions[1:].reshape(side, side, dim)),
        blocks=jax.tree.map(lambda *leaves: jnp.stack(leaves), *blocks),
        norm=_layer_norm(state, "norm"),
    )


def salad_from_torch(state: State) -> Salad:
    """The aggregator under serizba/salad's names."""
    return Salad(
        token_features=TwoLayer(
            _linear(state, "token_features.0"), _linear(state, "token_features.2")
        ),
        cluster_features=TwoLayer(
            _linear(state, "cluster_features.0"), _linear(state, "cluster_features.3")
        ),
        score=TwoLayer(_linear(state, "score.0"), _linear(state, "score.3")),
        dust_bin=jnp.asarray(state["dust_bin"]),
    )


def encoder_from_torch(state: State, layers: int) -> CrossImageEncoder:
    """The encoder under torch.nn.TransformerEncoder's names."""

    def layer(name: str) -> EncoderLayer:
        in_proj = Linear(
            jnp.asarray(state[f"{name}.self_attn.in_proj_weight"].T),
            jnp.asarray(state[f"{name}.self_attn.in_proj_bias"]),
        )
        return EncoderLayer(
            attn=Attention(in_proj, _linear(state, f"{name}.self_attn.out_proj")),
            linear1=_linear(state, f"{name}.linear1"),
            linear2=_linear(state, f"{name}.linear2"),
            norm1=_layer_norm(state, f"{name}.norm1"),
            norm2=_layer_norm(state, f"{name}.norm2"),
        )

    return CrossImageEncoder(tuple(layer(f"layers.{i}") for i in range(layers)))
