"""SelaVPR++: a generalised mean between linear layers, and a second, shorter head for bits.

Written from facts about the public model (Lu et al. 2025, "SelaVPR++: Towards Seamless Adaptation
of Foundation Models for Efficient Place Recognition").
"""

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.gem import START, gem
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid, Patches
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, linear
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class SelaVprPp:
    """Parameters of a head: the linear layers before and after the mean, and its exponent `p`."""

    p: Float[Array, ""]
    before: Linear
    after: Linear


@AGGREGATORS.register("selavprpp", tiny={"dim": 256})
class SelaVprPpConfig(Aggregator):
    """SelaVPR++'s head (Lu et al. 2025).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator="selavprpp", cross_image="none").descriptor_dim
        2048
    """

    dim: PositiveInt = 2048
    """Width of the real-valued descriptor; the public model on ViT-L has 4,096."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token of width `self.dim`, without local tokens."""
        return TokenShape(self.dim, 0, self.dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> SelaVprPp:
        """Draw the linear layers as torch does, and set the exponent to 3."""
        return init_head(key, backbone.dim, self.dim)

    def apply(self, params: SelaVprPp, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the output of the head as the global token, not yet scaled to unit length."""
        return Tokens.of_global(head(params, features.patches))


@pytree_dataclass
class SelaVprPpHash:
    """Parameters of the heads on the adapter's two side paths."""

    real: SelaVprPp
    """Head of the first path: real-valued descriptors, which re-rank the first results."""
    hash: SelaVprPp
    """Head of the second path: the model's descriptor, whose signs are the bits for search."""


@AGGREGATORS.register("selavprpp-hash", tiny={"dim": 256, "bits": 128})
class SelaVprPpHashConfig(SelaVprPpConfig):
    """SelaVPR++ with both side paths: a short descriptor to search by bits, a long one to re-rank.

    Example:
        >>> from crisalad_jax import ModelConfig, ViTConfig, make_part
        >>> adapter = make_part("adapter", "side-multi-resolution", paths=2)
        >>> backbone = ViTConfig(adapter=adapter)
        >>> part = SelaVprPpHashConfig()
        >>> ModelConfig(backbone=backbone, aggregator=part, cross_image="none").descriptor_dim
        512
    """

    bits: PositiveInt = 512
    """Width of the descriptor, whose signs are its bits."""

    def features(self, depth: int) -> FeatureSpec:
        """Request the patches of the adapter's second side path."""
        return FeatureSpec(path=1)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token of width `bits`, without local tokens."""
        return TokenShape(self.bits, 0, self.bits)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> SelaVprPpHash:
        """Draw both heads as `SelaVprPpConfig` does."""
        first, second = random_init.split(key)
        return SelaVprPpHash(
            init_head(first, backbone.dim, self.dim), init_head(second, backbone.dim, self.bits)
        )

    def apply(self, params: SelaVprPpHash, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the output of the second path's head as the global token, not yet normalised."""
        return Tokens.of_global(head(params.hash, features.patches))


def init_head(key: PRNGKeyArray, dim: int, width: int) -> SelaVprPp:
    """Draw a head that maps features of width `dim` to `width` outputs."""
    first, second = random_init.split(key)
    exponent = random_init.full((), START)
    return SelaVprPp(exponent, init_linear(first, dim, dim), init_linear(second, dim, width))


def head(params: SelaVprPp, patches: Patches) -> Float[Array, "*batch width"]:
    """Apply a linear layer, the generalised mean of its unit-length outputs, and a linear layer.

    The result is in at least float32, and not normalised.
    """
    mean = gem(linear(params.before, patches), params.p).astype(patches.dtype)
    return at_least_float32(linear(params.after, mean))
