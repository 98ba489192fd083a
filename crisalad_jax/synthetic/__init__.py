"""Procedural places of planar polygons, drawn through a pinhole camera: a city, and a world.

Both are written in two real layouts: GSV-Cities (Ali-bey et al. 2022) to train on, and that of
VPR-datasets-downloader to evaluate on. The modules in the order of their imports: `view` (how a
picture is taken); `mesh` (materials, polygons and what a place is); `things` and `buildings` (the
contents of a place); `street`, `corridor` and `country` (its kinds); `light` and `picture`
(drawing); `layouts`, `city` and `world` (the files).
"""

from crisalad_jax.synthetic.city import SyntheticCityConfig, write_synthetic_city
from crisalad_jax.synthetic.picture import render
from crisalad_jax.synthetic.view import SCENERIES, SEASONS, Scenery, View
from crisalad_jax.synthetic.world import VARIATIONS, Variation, WorldConfig, has_world, write_world

__all__ = [
    "SCENERIES",
    "SEASONS",
    "VARIATIONS",
    "Scenery",
    "SyntheticCityConfig",
    "Variation",
    "View",
    "WorldConfig",
    "has_world",
    "render",
    "write_synthetic_city",
    "write_world",
]
