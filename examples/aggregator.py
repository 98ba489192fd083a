"""An aggregator with parameters: a learnt attention averages the patches.

A frozen dataclass holds the settings, and a pytree of arrays holds the parameters.

    python examples/aggregator.py
    crisalad train --plugin examples/aggregator.py --recipe crisalad+attention-pool ...
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import crisalad_jax as cj


@cj.register_aggregator("attention-pool", tiny={"heads": 2})
@dataclasses.dataclass(frozen=True)
class AttentionPool(cj.Aggregator):
    """A softmax over patches for each head; the descriptor concatenates the means of all heads."""

    heads: int = 4

    def token_shape(self, dim):
        """Return the shape: one global token, no local tokens."""
        return cj.TokenShape(global_dim=self.heads * dim, tokens=0, token_dim=self.heads * dim)

    def init(self, key, backbone, grid):
        """Draw a query for each head."""
        queries = jax.random.normal(key, (backbone.dim, self.heads)) / backbone.dim**0.5
        return {"queries": queries}

    def apply(self, params, features, grid, *, key):
        """Average the patches of a batch, or of one image, with the weights of each head."""
        patches = features.patches.astype(jnp.float32)
        shares = jax.nn.softmax(patches @ params["queries"], axis=-2)
        means = jnp.einsum("...ph,...pd->...hd", shares, patches)
        return cj.Tokens.of_global(means.reshape(*means.shape[:-2], -1))


def main():
    """Describe two noise images with an untrained model that uses this aggregator."""
    config = cj.recipe("tiny", "crisalad+attention-pool").model
    params = cj.init_crisalad(jax.random.key(0), config)
    pictures = np.random.default_rng(0).integers(0, 256, (2, *config.image_size, 3), np.uint8)
    descriptors = cj.describe(params, pictures, config)
    norms = jnp.linalg.norm(descriptors, axis=1)
    print(f"descriptors of shape {descriptors.shape}, the shortest of length {norms.min():.3f}")
    return params, config, descriptors


if __name__ == "__main__":
    main()
