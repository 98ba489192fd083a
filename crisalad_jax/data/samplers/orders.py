"""Random places, from all cities or from one per batch."""

import numpy as np

from crisalad_jax.data.places import Places
from crisalad_jax.data.samplers.base import SAMPLERS, Draw, Sampler
from crisalad_jax.utils.shapes import Int


@SAMPLERS.register("shuffled")
class Shuffled(Sampler):
    """Places of all cities in random order."""

    def apply(self, places: Places, draw: Draw) -> Int[np.ndarray, " order"]:
        """Return every place once."""
        return np.argsort(draw.generator.random(len(places.names)))


@SAMPLERS.register("within-city")
class WithinCity(Sampler):
    """Places city after city, in random order, as in the public loaders.

    A batch is then nearly always of one city, whose places are hard to tell apart.
    """

    def apply(self, places: Places, draw: Draw) -> Int[np.ndarray, " order"]:
        """Return every place once, with the places of a city together."""
        city_rank = draw.generator.permutation(len(places.cities))[places.place_city]
        return np.lexsort((draw.generator.random(len(places.names)), city_rank))
