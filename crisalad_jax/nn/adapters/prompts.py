"""Visual prompts: learnt tokens in addition to those of an image (Jia et al., ECCV 2022)."""

import math

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.adapters.base import ADAPTERS, Adapter, BlockShape
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class Prompts:
    """The parameters: the prompts of a block, as they enter it."""

    tokens: Float[Array, "*stack prompt dim"]


@ADAPTERS.register("prompts")
class PromptsConfig(Adapter):
    """Prompts in every block (VPT-deep: Jia et al., ECCV 2022), without dropout.

    The tokens of an image attend to a block's prompts, whose outputs are dropped. Each prompt adds
    a token to the attention. Unlike most adapters, untrained prompts change the descriptors.
    """

    count: PositiveInt = 10
    """Number of prompts per block."""

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> Prompts:
        """Draw prompts uniformly within sqrt(3 / dim), as the authors' code does for ViT-B/16."""
        bound = math.sqrt(3 / shape.dim)
        tokens = random_init.uniform(key, (self.count, shape.dim), minval=-bound, maxval=bound)
        return Prompts(tokens)

    def prompts(self, params: Prompts) -> Float[Array, "prompt dim"]:
        """Return the prompts of a block."""
        return params.tokens
