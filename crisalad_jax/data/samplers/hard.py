"""Batches of places that the model confuses."""

from typing import ClassVar

import numpy as np

from crisalad_jax.data.places import Places
from crisalad_jax.data.samplers.base import SAMPLERS, Draw, Sampler
from crisalad_jax.utils.shapes import Int


@SAMPLERS.register("hard-negatives")
class HardNegatives(Sampler):
    """Batches of a random place and the places that look most like it to the model.

    The model describes one image of each place when an epoch begins. GPM (Ali-bey et al., BMVC
    2022) draws such batches by proxies that are trained with the model.
    """

    describes: ClassVar[bool] = True

    def apply(self, places: Places, draw: Draw) -> Int[np.ndarray, " order"]:
        """Return every place once: each batch is a random place and those most similar to it."""
        left = draw.generator.permutation(len(places.names))
        order = []
        while len(left):
            # For all places: indexing the remaining ones would copy their descriptors each time.
            similarity = (draw.descriptors @ draw.descriptors[left[0]])[left]
            # A place whose image cannot be read is not similar to any other.
            similarity = np.nan_to_num(similarity, nan=-np.inf)
            similarity[0] = np.inf
            nearest = np.argsort(-similarity, kind="stable")[: draw.places_per_batch]
            order.append(left[nearest])
            left = np.delete(left, nearest)
        return np.concatenate(order)
