"""Render procedural places, made of planar polygons, with a pinhole camera: a city and a world.

Both are written in the layouts of real data sets: GSV-Cities (Ali-bey et al. 2022) for training,
and VPR-datasets-downloader for evaluation. The modules in import order: `view` (how a picture is
taken); `mesh` (materials, polygons and what a place is); `things` and `buildings` (the contents of
a place); `street`, `corridor` and `country` (kinds of places); `light` and `picture` (drawing);
`layouts`, `city` and `world` (the files).
"""

from crisalad_jax.synthetic.city import SyntheticCityConfig as SyntheticCityConfig
from crisalad_jax.synthetic.city import write_synthetic_city as write_synthetic_city
from crisalad_jax.synthetic.picture import render as render
from crisalad_jax.synthetic.view import SCENERIES as SCENERIES
from crisalad_jax.synthetic.view import SEASONS as SEASONS
from crisalad_jax.synthetic.view import Scenery as Scenery
from crisalad_jax.synthetic.view import View as View
from crisalad_jax.synthetic.world import VARIATIONS as VARIATIONS
from crisalad_jax.synthetic.world import Variation as Variation
from crisalad_jax.synthetic.world import WorldConfig as WorldConfig
from crisalad_jax.synthetic.world import write_world as write_world
