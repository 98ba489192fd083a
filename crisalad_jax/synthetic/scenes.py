"""Places by seed: what builds each kind."""

import functools
from collections.abc import Callable, Mapping

import numpy as np

from crisalad_jax.synthetic.corridor import corridor
from crisalad_jax.synthetic.country import country
from crisalad_jax.synthetic.mesh import Place
from crisalad_jax.synthetic.street import street
from crisalad_jax.synthetic.view import Scenery

_BUILDERS: Mapping[Scenery, Callable[[np.random.Generator], Place]] = {
    "street": street,
    "corridor": corridor,
    "country": country,
}


@functools.lru_cache(maxsize=32)
def build_place(seed: int, scenery: Scenery = "street") -> Place:
    """Build the place of a seed; the latest places are cached."""
    return _BUILDERS[scenery](np.random.default_rng((seed, 0)))
