"""Training recipes of published methods, one module for each family."""

from crisalad_jax.training.recipes import (  # noqa: F401, they register theirs
    adapt,
    classical,
    classification,
    convolutional,
    dinov2,
    distil,
    netvlad,
    paper,
)
from crisalad_jax.training.recipes.base import RECIPES as RECIPES
from crisalad_jax.training.recipes.base import find_part as find_part
from crisalad_jax.training.recipes.base import from_scratch as from_scratch
from crisalad_jax.training.recipes.base import mines_tuples as mines_tuples
from crisalad_jax.training.recipes.base import mixes_sets as mixes_sets
from crisalad_jax.training.recipes.base import recipe as recipe
from crisalad_jax.training.recipes.base import register_recipe as register_recipe
from crisalad_jax.training.recipes.base import split_name as split_name
from crisalad_jax.training.recipes.base import with_part as with_part
