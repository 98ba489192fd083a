"""Cross-image encoders, which relate the images of a batch: the paper's (section 3.4), and others.

The paper's layers are torch's `nn.TransformerEncoderLayer` as CricaVPR uses it: post-norm, exact
GELU.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.config.checks import Fraction, PositiveInt, require_field
from crisalad_jax.config.part import Part, non_semantic_field
from crisalad_jax.config.registry import Registry
from crisalad_jax.nn import random_init
from crisalad_jax.nn.attention import Attention, attention_weights, dot_product_attention
from crisalad_jax.nn.layers import Keys, at_least_float32, dropout, gelu, linear, split_key
from crisalad_jax.nn.torch_layers import EncoderLayer, encoder_layer, init_encoder_layer
from crisalad_jax.utils.devices import IMAGE, image_mesh
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import pytree_dataclass

Sequences = Float[Array, "image token dim"]
"""The tokens of each image of a batch."""
Mask = Bool[Array, "image image"] | None
"""`mask[i, j]` allows image i to attend to image j; None allows all."""


class CrossImage(Part, abc.ABC):
    """A network that relates the images of a batch: a frozen dataclass with its settings as fields.

    `init` and `apply` are required.

    Example:
        >>> import jax
        >>> from crisalad_jax import ModelConfig, register_cross_image
        >>> @register_cross_image("mean")
        ... class Mean(CrossImage):
        ...     share: float = 0.5
        ...
        ...     def init(self, key, dim):
        ...         return None
        ...
        ...     def apply(self, params, tokens, *, mask, key):
        ...         weights = jnp.ones(2 * tokens.shape[:1]) if mask is None else mask * 1.0
        ...         weights = weights / weights.sum(axis=1, keepdims=True)
        ...         mean = jnp.einsum("ij,jtd->itd", weights.astype(tokens.dtype), tokens)
        ...         return (1 - self.share) * tokens + self.share * mean
        >>> ModelConfig(cross_image=Mean(share=0.1)).descriptor_dim
        8448
    """

    attends: ClassVar[bool] = True
    """Whether a descriptor depends on the other images of its batch."""
    global_token = True  # untyped, so that a subclass may make it a field
    """Whether the global token takes part, cut into tokens as wide as the local ones."""
    width = None  # untyped too
    """Width of the tokens that the unit descriptor is cut into; the encoder's output is then the
    descriptor, not normalised. If None, the encoder's input is the aggregator's tokens."""

    def check(self, dim: int) -> None:
        """Raise InputError if tokens of this width are not supported; by default never."""

    def numbers(self, params: Any) -> Mapping[str, Any]:
        """Return values of the parameters to log by name at each validation; by default none."""
        return {}

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray, dim: int) -> Any:
        """Draw random parameters, a pytree of arrays in float32, for tokens of width `dim`."""

    @abc.abstractmethod
    def apply(self, params: Any, tokens: Sequences, *, mask: Mask, key: Keys) -> Sequences:
        """Return the images' updated tokens, in the shape and type of the given ones.

        Args:
            params: from `init`.
            tokens: tokens of every image, in the type to compute in.
            mask: which images attend to which, every image to at least one; None allows all.
            key: random key for dropout; None means inference.
        """

    def attention(
        self, params: Any, tokens: Sequences, *, mask: Mask
    ) -> Float[Array, "layer token head image image"]:
        """Return the attention weights between images, for `cross_image_attention`.

        Args:
            params: from `init`.
            tokens: see `apply`.
            mask: see `apply`.

        Raises:
            InputError: the encoder has no attention; by default it has none.
        """
        raise InputError(f"cross_image: found {self.part_name}, expected one that has attention")


CROSS_IMAGE = Registry("cross_image", CrossImage)
register_cross_image = CROSS_IMAGE.register


@CROSS_IMAGE.register("none")
class NoCrossImage(CrossImage):
    """No encoder: a descriptor depends only on its own image."""

    attends: ClassVar[bool] = False

    def init(self, key: PRNGKeyArray, dim: int) -> None:
        """Return None: there are no parameters."""

    def apply(self, params: None, tokens: Sequences, *, mask: Mask, key: Keys) -> Sequences:
        """Return the tokens unchanged."""
        return tokens


@pytree_dataclass
class CrossImageEncoder:
    """Parameters of the encoder: its layers, in order."""

    layers: tuple[EncoderLayer, ...]


@dataclasses.dataclass(frozen=True)
class TransformerEncoder(CrossImage):
    """Torch's encoder layers, which attend from each token to the same token of all images."""

    layers: PositiveInt = 2
    """Number of layers."""
    heads: PositiveInt = 16
    feedforward: PositiveInt = 2048
    dropout: Fraction = non_semantic_field(0.1)

    def check(self, dim: int) -> None:
        """Require a number of heads that divides the width of a token."""
        words = f"a divisor of the {dim} dimensions of a token"
        require_field(self, "heads", dim % self.heads == 0, words)

    def init(self, key: PRNGKeyArray, dim: int) -> Any:
        """Draw parameters as torch does: Glorot-uniform attention, zero biases, default linears.

        All layers start identical: torch's `nn.TransformerEncoder` copies the layer it gets.
        """
        # Drawn separately: a training step that donates its buffers must not get one twice.
        layers = (init_encoder_layer(key, dim, self.feedforward) for _ in range(self.layers))
        return CrossImageEncoder(tuple(layers))

    def apply(self, params: Any, tokens: Sequences, *, mask: Mask, key: Keys) -> Sequences:
        """Attend from each token to the same token of all images."""
        for layer, layer_key in zip(params.layers, split_key(key, self.layers), strict=True):
            tokens = self._run_layer(layer, tokens, mask, layer_key)
        return tokens

    def attention(
        self, params: Any, tokens: Sequences, *, mask: Mask
    ) -> Float[Array, "layer token head image image"]:
        """Return the softmax weights of every layer."""
        weights = []
        for layer in params.layers:
            by_token = tokens.swapaxes(0, 1)
            weights.append(attention_weights(layer.attn, by_token, self.heads, mask=mask))
            tokens = self._run_layer(layer, tokens, mask, None)
        return jnp.stack(weights)

    def _run_layer(
        self, params: EncoderLayer, tokens: Sequences, mask: Mask, key: Keys
    ) -> Sequences:
        weights_key, *keys = split_key(key, 4)
        attended = self._attend_across(params.attn, tokens, mask, weights_key)
        return encoder_layer(params, tokens, attended, gelu, rate=self.dropout, keys=keys)

    def _attend_across(self, params: Attention, x: Sequences, mask: Mask, key: Keys) -> Sequences:
        """Attend from each token to the same token of all images.

        If images are sharded, a device attends from its own images to those of all devices: keys
        and values are gathered once, and their gradient is scattered once. By itself, XLA splits
        the keys and adds up scores, totals and results, with twelve collectives per layer. Dropout
        draws the same bits as on one device.
        """
        images, tokens, dim = x.shape
        mesh, heads = image_mesh(), self.heads
        dropout_mask = None
        if key is not None and self.dropout > 0:
            every = jnp.ones((tokens, heads, images, images), at_least_float32(x[:0]).dtype)
            dropout_mask = dropout(every, self.dropout, key=key)

        def by_token(x: Array) -> Float[Array, "token image head _"]:
            return x.reshape(x.shape[0], tokens, heads, -1).swapaxes(0, 1)

        def attend(qkv: Array, mask: Array | None, dropout_mask: Array | None) -> Array:
            queries, others = jnp.split(qkv, [dim], axis=-1)
            keys, values = jnp.split(others if mesh is None else _gathered(others), 2, axis=-1)
            parts = map(by_token, (queries, keys, values))
            mixed = dot_product_attention(*parts, mask=mask, dropout_mask=dropout_mask)
            return mixed.swapaxes(0, 1).reshape(queries.shape)

        if mesh is not None:
            own, by_query = PartitionSpec(IMAGE), PartitionSpec(None, None, None, IMAGE)
            specs: Any = {"in_specs": (own, own, by_query), "out_specs": own, "check_vma": False}
            attend = jax.shard_map(attend, mesh=mesh, **specs)
        return linear(params.proj, attend(linear(params.qkv, x), mask, dropout_mask))


_TINY = {"heads": 4, "feedforward": 128, "dropout": 0.0}


@CROSS_IMAGE.register("transformer", tiny=_TINY)
class CrossImageConfig(TransformerEncoder):
    """The transformer encoder that attends across the images of a batch (paper section 3.4).

    Example:
        >>> CrossImageConfig(layers=1).layers
        1
    """

    global_token: bool = True
    """Whether the global token takes part too, cut into tokens of the clusters' width."""


@CROSS_IMAGE.register("sage-encoder", tiny={**_TINY, "width": 96})
class SageCrossImageConfig(TransformerEncoder):
    """SAGE's transformer encoder (ICLR 2026), over a finished descriptor cut into tokens.

    Its descriptors are not unit vectors, and are compared by Euclidean distance. Only for losses
    are they normalised.
    """

    feedforward: PositiveInt = 1024
    width: PositiveInt = 768
    """Width of the tokens that the descriptor is cut into, a divisor of the descriptor's width."""


@pytree_dataclass
class GatedEncoder:
    """Parameters of a gate, and of the encoder behind it."""

    gate: Float[Array, ""]
    encoder: CrossImageEncoder


@CROSS_IMAGE.register("gated", tiny=_TINY)
class GatedCrossImageConfig(CrossImageConfig):
    """The paper's encoder behind a learnt gate: y = x + tanh(g) (f(x) - x).

    x are an image's tokens, f is the encoder of "transformer", and the scalar g starts at 0. An
    untrained encoder therefore leaves descriptors unchanged (in bfloat16 up to rounding). The gate
    is that of Flamingo's layers (Alayrac et al. 2022), here applied to what the encoder adds.
    """

    def init(self, key: PRNGKeyArray, dim: int) -> GatedEncoder:
        """Draw the encoder, and a gate of 0."""
        return GatedEncoder(random_init.zeros(), super().init(key, dim))

    def apply(self, params: GatedEncoder, tokens: Sequences, *, mask: Mask, key: Keys) -> Sequences:
        """Add the encoder's update, times the hyperbolic tangent of the gate."""
        attended = super().apply(params.encoder, tokens, mask=mask, key=key)
        before, after = at_least_float32(tokens), at_least_float32(attended)
        return (before + jnp.tanh(params.gate) * (after - before)).astype(tokens.dtype)

    def numbers(self, params: GatedEncoder) -> Mapping[str, Any]:
        """Return tanh(g) as "gate", to log: 0 is a closed gate."""
        return {"gate": jnp.tanh(params.gate)}

    def attention(
        self, params: GatedEncoder, tokens: Sequences, *, mask: Mask
    ) -> Float[Array, "layer token head image image"]:
        """Return the attention weights of the encoder behind the gate."""
        return super().attention(params.encoder, tokens, mask=mask)


@jax.custom_vjp
def _gathered(own: Array) -> Array:
    """Gather the images of all devices; their gradients are summed in float32 at least.

    JAX's own rule sums them in the type of `own`: in bfloat16, with eight bits.
    """
    return jax.lax.all_gather(own, IMAGE, tiled=True)


def _gathered_backward(_: None, change: Array) -> tuple[Array]:
    total = jax.lax.psum_scatter(at_least_float32(change), IMAGE, tiled=True)
    return (total.astype(change.dtype),)


_gathered.defvjp(lambda own: (_gathered(own), None), _gathered_backward)
