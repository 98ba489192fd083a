"""LoRA: low-rank updates of linear layers (Hu et al. 2021)."""

import dataclasses
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveFloat, PositiveInt, require_field
from crisalad_jax.nn import random_init
from crisalad_jax.nn.adapters.base import ADAPTERS, Adapter, BlockShape
from crisalad_jax.nn.layers import Linear, init_linear, linear
from crisalad_jax.nn.products import keep
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class LowRank:
    """The factors of an update: the paper's A transposed (`down`), and its B transposed (`up`)."""

    down: Linear
    up: Linear


@ADAPTERS.register("lora")
class LoraConfig(Adapter):
    """Low-rank updates of linear layers, W x + (alpha / rank) B A x (LoRA: Hu et al. 2021).

    There is no dropout. `merge_adapters` adds (alpha / rank) B A to W for inference.
    """

    rank: PositiveInt = 8
    """Rank of the updates."""
    alpha: PositiveFloat = 8.0
    """Updates are scaled by alpha divided by the rank."""
    layers: tuple[Literal["qkv", "proj", "fc1", "fc2", "w12", "w3"], ...] = ("qkv", "proj")
    """Layers with an update: qkv and proj of the attention, fc1 and fc2 of the MLP, or w12 and w3
    of a SwiGLU."""

    def check(self, shape: BlockShape) -> None:
        """Require that the block has these layers and that each is named once."""
        layers = ", ".join(shape.linears)
        fits = 0 < len(self.layers) == len({*self.layers} & {*shape.linears})
        require_field(self, "layers", fits, f"some of {layers}, each once")

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> dict[str, LowRank]:
        """Draw A as torch draws linear layers (as in the authors' code), and set B to 0."""
        keys = zip(self.layers, random_init.split(key, len(self.layers)), strict=True)
        return {name: self._init_layer(each, *shape.linears[name]) for name, each in keys}

    def _init_layer(self, key: PRNGKeyArray, d_in: int, d_out: int) -> LowRank:
        up = Linear(random_init.zeros(self.rank, d_out), None)
        return LowRank(init_linear(key, d_in, self.rank, bias=False), up)

    def linear_update(
        self, params: dict[str, LowRank], name: str, x: Float[Array, "*batch d_in"]
    ) -> Float[Array, "*batch d_out"] | None:
        """Return (alpha / rank) B A x without forming B A; None for a layer without an update."""
        if name not in params:
            return None
        hidden = keep(linear(params[name].down, x), "down")
        return self.alpha / self.rank * linear(params[name].up, hidden)

    def merge(self, params: dict[str, LowRank], name: str, layer: Linear) -> Linear:
        """Return the layer with (alpha / rank) B A added to its weight."""
        if name not in params:
            return layer
        product = jnp.matmul(params[name].down.weight, params[name].up.weight, precision="highest")
        return dataclasses.replace(layer, weight=layer.weight + self.alpha / self.rank * product)
