"""Adapters of a vision transformer's blocks: their interface and registry."""

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
    """The sizes of a block that an adapter is made for."""

    dim: int
    """Width of a token."""
    linears: Mapping[str, tuple[int, int]]
    """Widths of the input and the output of each linear layer: qkv and proj of the attention, and
    fc1 and fc2 of the MLP (or w12 and w3 of SwiGLU)."""


@brief
class TokenInfo(NamedTuple):
    """What a hook knows of the tokens."""

    grid: Grid
    """Rows and columns of patches, the last `grid[0] * grid[1]` tokens."""
    length: int | None = None
    """Number of first tokens that are not padding; None is all."""
    valid: Valid = None
    """Images of a training batch, whose statistics batch norms normalise by
    (`layers.train_batch_norm`); None takes the stored ones."""


class Adapter(Part, abc.ABC):
    """Small layers that are added to every block: a frozen dataclass whose fields are its settings.

    `init` is required, and at least one of the hooks below it does the work. A hook returns what is
    added to the result of a part of the block, in the shape and type of that result; None adds
    nothing. All blocks have one shape and run in one loop (`jax.lax.scan`). A hook therefore gets
    the parameters of one block, and does the same in every block that has an adapter.

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

    last = None  # without a type, so that a class may make it a field
    """Number of the last blocks that have an adapter, with parameters; None is all blocks."""
    paths = 1  # the same
    """Number of side paths, of an adapter with a `side_path`. Where it is above 1, `init` returns a
    tuple: the parameters of each path. `FeatureSpec.path` says which one runs."""

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray, shape: BlockShape) -> Any:
        """Draw the parameters of one block's adapter, a pytree of arrays in float32.

        An adapter that should not change a pretrained model at first returns such that it adds 0.
        """

    def check(self, shape: BlockShape) -> None:
        """Raise InputError where the settings do not fit such a block; by default never."""

    def prompts(self, params: Any) -> Float[Array, "prompt dim"] | None:
        """Return tokens that a block puts in front of an image's, in place of the last block's.

        Args:
            params: of `init`.
        """
        return None

    def linear_update(
        self, params: Any, name: str, x: Float[Array, "*batch d_in"]
    ) -> Float[Array, "*batch d_out"] | None:
        """Return what is added to the output of a linear layer of the block.

        Args:
            params: of `init`.
            name: the layer, one of `BlockShape.linears`.
            x: the input of the layer.
        """
        return None

    def merge(self, params: Any, name: str, layer: Linear) -> Linear:
        """Return a linear layer whose output has the `linear_update` added (`merge_adapters`).

        An adapter with this method has no other effect on a block.

        Args:
            params: of `init`.
            name: see `linear_update`.
            layer: the layer.
        """
        raise NotImplementedError

    def attention_update(
        self, params: Any, attended: AnyTokens, info: TokenInfo
    ) -> AnyTokens | None:
        """Return what is added to the attention's output, before LayerScale and the residual.

        Args:
            params: of `init`.
            attended: the output of the attention.
            info: of these tokens.
        """
        return None

    def mlp_update(
        self, params: Any, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens | None, Any]:
        """Return what is added to the MLP's output, before LayerScale, and the parameters.

        Args:
            params: of `init`.
            tokens: the MLP's input, normalised.
            info: of these tokens.

        Returns:
            (update, updated): the parameters with updated running statistics, if there are any.
        """
        return None, params

    def output_update(self, params: Any, tokens: AnyTokens, info: TokenInfo) -> AnyTokens | None:
        """Return what is added to the block's output.

        Args:
            params: of `init`.
            tokens: the output.
            info: of these tokens.
        """
        return None

    def side_path(
        self, params: Any, side: AnyTokens, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, Any]:
        """Return the tokens of a path beside the blocks, whose last ones are the backbone's.

        The path starts from the tokens before the first block that has an adapter.

        Args:
            params: of `init`, those of the path.
            side: the path's tokens.
            tokens: the output of the block.
            info: of these tokens.

        Returns:
            (side, updated): as `mlp_update` returns them.
        """
        raise NotImplementedError

    def has(self, *hooks: str) -> bool:
        """Return whether it has one of these methods of its own."""
        return any(getattr(type(self), hook) is not getattr(Adapter, hook) for hook in hooks)


HOOKS = ("prompts", "linear_update", "attention_update", "mlp_update", "output_update", "side_path")
"""Methods of adapters that change what a block does."""
ADAPTERS = Registry("adapter", Adapter)
