"""A procedural city: street canyons of planar polygons, drawn through a pinhole camera.

It is written in two real layouts: GSV-Cities (Ali-bey et al. 2022) to train on, and that of
VPR-datasets-downloader to evaluate on. The modules in the order of their imports: `view` (how a
picture is taken); `materials`, `mesh`, `buildings`, `street` and `traffic` (the contents of a
place); `light`, `camera` and `picture` (drawing); `city` (the files).
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
    SEASONS,
    TIMES,
    WEATHERS,
    Season,
    Time,
    View,
    Weather,
)

__all__ = [
    "CITY_NAMES",
    "PLACE_SPACING",
    "RENDERER",
    "SEASONS",
    "TIMES",
    "WEATHERS",
    "Season",
    "SyntheticCityConfig",
    "Time",
    "View",
    "Weather",
    "render",
    "write_synthetic_city",
]
