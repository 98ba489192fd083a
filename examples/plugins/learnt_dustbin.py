"""A dustbin that scores each patch with a small network of its features.

crisalad train ... --plugin examples/plugins/learnt_dustbin.py
    --model.aggregator.dustbin network
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

import crisalad_jax as cj


@cj.register_dustbin("network")
@dataclasses.dataclass(frozen=True)
class NetworkDustbin(cj.sinkhorn.Dustbin):
    """One hidden layer of ReLUs; its output starts at the published constant, 1."""

    takes_difference: ClassVar[bool] = True
    hidden: int = 32

    def init(self, key, dim):
        """Draw the hidden layer; the output layer starts at 0, its bias at 1."""
        weights = jax.random.normal(key, (dim, self.hidden)) / dim**0.5
        return {"hidden": weights, "out": jnp.zeros(self.hidden), "bias": jnp.ones(())}

    def marginals(self, params, scores, patches):
        """Append a column of the network's scores."""
        hidden = jax.nn.relu(patches @ params["hidden"])
        column = hidden @ params["out"] + params["bias"]
        masses = cj.sinkhorn.log_marginals(*scores.shape[-2:], dtype=scores.dtype)
        return cj.sinkhorn.Marginals(cj.sinkhorn.append_dustbin(scores, column), *masses)
