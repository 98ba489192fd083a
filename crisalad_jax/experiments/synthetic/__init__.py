"""Procedural places of planar polygons, drawn through a pinhole camera: a city, and a world.

Both are written in two real layouts: GSV-Cities (Ali-bey et al. 2022) to train on, and that of
VPR-datasets-downloader to evaluate on. The modules in the order of their imports: `view` (how a
picture is taken); `materials`, `mesh`, `things`, `buildings` and `place` (the contents of a place);
`street`, `corridor`, `country`, `scenes` and `traffic` (its kinds); `light`, `camera` and `picture`
(drawing); `city` and `world` (the files).
"""

from crisalad_jax.experiments.synthetic.city import (
    CITY_NAMES,
    PLACE_SPACING,
    RENDERER,
    SyntheticCityConfig,
    write_synthetic_city,
)
from crisalad_jax.experiments.synthetic.picture import render
from crisalad_jax.experiments.synthetic.view import (
    SCENERIES,
    SEASONS,
    TIMES,
    WEATHERS,
    Scenery,
    Season,
    Time,
    View,
    Weather,
)
from crisalad_jax.experiments.synthetic.world import WorldConfig, write_world

__all__ = [
    "CITY_NAMES",
    "PLACE_SPACING",
    "RENDERER",
    "SCENERIES",
    "SEASONS",
    "TIMES",
    "WEATHERS",
    "Scenery",
    "Season",
    "SyntheticCityConfig",
    "Time",
    "View",
    "Weather",
    "WorldConfig",
    "render",
    "write_synthetic_city",
    "write_world",
]
