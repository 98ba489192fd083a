"""SAGE's dynamic power (ICLR 2026): a block's output, plus its elements raised to one power.

Written from facts about the public model; the training code is not published.
"""

from jaxtyping import PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn.adapters.base import ADAPTERS, Adapter, AnyTokens, BlockShape, TokenInfo
from crisalad_jax.nn.layers import TwoLayer, init_two_layer, powers


@ADAPTERS.register("dynamic-power")
class DynamicPowerConfig(Adapter):
    """SAGE's dynamic power, which turns the output x of a block into x + sign(x) (|x| + 1e-6)^p.

    A small network computes an image's exponent p, between 0 and 1, from the mean of all tokens.
    The power is discontinuous at 0, so values near 0 are sensitive to rounding.
    """

    last: PositiveInt | None = 4
    """Number of final blocks that have the power; None means all."""
    hidden: PositiveInt = 16
    """Width of the hidden layer of the network that computes the exponent."""

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> TwoLayer:
        """Draw the network of the exponent as torch draws linear layers."""
        return init_two_layer(key, shape.dim, self.hidden, 1)

    def output_update(self, params: TwoLayer, tokens: AnyTokens, info: TokenInfo) -> AnyTokens:
        """Return sign(x) (|x| + 1e-6)^p for the tokens x, with one exponent p per image."""
        mean = tokens[..., : info.length, :].mean(axis=-2, keepdims=True)
        return powers(params, tokens, mean)
