"""Interface and registry of adapters for the blocks of a vision transformer."""

import abc
from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.layers import Grid, Linear, Valid

AnyTokens = Float[Array, "*batch token dim"]
"""Tokens of an image or of a batch: the class token and registers first, the patches last."""


@brief
class BlockShape(NamedTuple):
    """The sizes of the transformer block that an adapter is built for."""

    dim: int
    """Width of a token."""
    linears: Mapping[str, tuple[int, int]]
    """Input and output widths of each linear layer: qkv and proj of the attention, and fc1 and fc2
    of the MLP (or w12 and w3 of SwiGLU)."""


@brief
class TokenInfo(NamedTuple):
    """Information about the tokens that a hook of an `Adapter` receives."""

    grid: Grid
    """Rows and columns of patches, which are the last `grid[0] * grid[1]` tokens before padding."""
    length: int | None = None
    """Number of tokens before the padding; None means that there is no padding."""
    valid: Valid = None
    """Mask of the training images whose statistics batch norms use (`layers.train_batch_norm`);
    None, outside training, uses the stored statistics."""


class Adapter(Part, abc.ABC):
    """Small layers added to every block: a frozen dataclass whose fields are its settings.

    Implement `init` and at least one of the hooks (`HOOKS`). Most return an update that is added to
    the result of one part of the block, with the shape and dtype of that result; None adds nothing.
    All blocks have the same shape and run in one loop (`jax.lax.scan`). A hook therefore gets the
    parameters of a single block, and does the same in every block that has an adapter.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from crisalad_jax import ViTConfig, register_adapter
        >>> @register_adapter("shift")
        ... class Shift(Adapter):
        ...     def init(self, key, shape):
        ...         return {"shift": jnp.zeros(shape.dim)}
        ...
        ...     def mlp_update(self, params, tokens, info):
        ...         return params["shift"].astype(tokens.dtype), params
        >>> jax.eval_shape(ViTConfig(adapter="shift").init, jax.random.key(0)).blocks.adapter
        {'shift': ShapeDtypeStruct(shape=(12, 768), dtype=float32)}
    """

    last = None  # not annotated, so that a subclass can make it a field
    """Number of final blocks that have the adapter; None means all."""
    paths = 1  # not annotated either
    """Number of side paths of an adapter with a `side_path`. Above 1, `init` returns a tuple with
    the parameters of each path, and `FeatureSpec.path` selects the path that runs."""

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray, shape: BlockShape) -> Any:
        """Draw the parameters of one block's adapter, a pytree of float32 arrays.

        To leave a pretrained model unchanged at first, return parameters that make updates 0.
        """

    def check(self, shape: BlockShape) -> None:
        """Raise InputError if the settings do not fit this block; by default, accept any block."""

    def prompts(self, params: Any) -> Float[Array, "prompt dim"] | None:
        """Return the prompts that a block prepends to the tokens, replacing the previous block's.

        Args:
            params: from `init`.
        """
        return None

    def linear_update(
        self, params: Any, name: str, x: Float[Array, "*batch d_in"]
    ) -> Float[Array, "*batch d_out"] | None:
        """Return the update to add to the output of one of the block's linear layers.

        Args:
            params: from `init`.
            name: name of the layer, one of `BlockShape.linears`.
            x: input of the layer.
        """
        return None

    def merge(self, params: Any, name: str, layer: Linear) -> Linear:
        """Return a linear layer with `linear_update` folded into its weights, for `merge_adapters`.

        An adapter with this method must not affect the block in any other way.

        Args:
            params: from `init`.
            name: name of the layer, one of `BlockShape.linears`.
            layer: the linear layer.
        """
        raise NotImplementedError

    def attention_update(
        self, params: Any, attended: AnyTokens, info: TokenInfo
    ) -> AnyTokens | None:
        """Return the update to add to the attention output, before LayerScale and the residual.

        Args:
            params: from `init`.
            attended: output of the attention.
            info: describes these tokens.
        """
        return None

    def mlp_update(
        self, params: Any, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens | None, Any]:
        """Return the update to add to the MLP output, before LayerScale, and the parameters.

        Args:
            params: from `init`.
            tokens: input of the MLP, after the layer norm.
            info: describes these tokens.

        Returns:
            (update, updated): the second is `params` with any running statistics updated.
        """
        return None, params

    def output_update(self, params: Any, tokens: AnyTokens, info: TokenInfo) -> AnyTokens | None:
        """Return the update to add to the output of the block.

        Args:
            params: from `init`.
            tokens: output of the block.
            info: describes these tokens.
        """
        return None

    def side_path(
        self, params: Any, side: AnyTokens, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, Any]:
        """Return a path's tokens after a block; after the last one, they are the backbone's output.

        The path starts from the tokens that enter the first block with an adapter.

        Args:
            params: parameters of this path, from `init`.
            side: tokens of the path before the block.
            tokens: output of the block.
            info: describes the tokens.

        Returns:
            (side, updated): the path's tokens after the block, and `params` as in `mlp_update`.
        """
        raise NotImplementedError

    def has(self, *hooks: str) -> bool:
        """Return whether the class overrides at least one of the methods with these names."""
        return any(getattr(type(self), hook) is not getattr(Adapter, hook) for hook in hooks)


HOOKS = ("prompts", "linear_update", "attention_update", "mlp_update", "output_update", "side_path")
"""Names of the `Adapter` methods that change the computation of a block."""
ADAPTERS = Registry("adapter", Adapter)
