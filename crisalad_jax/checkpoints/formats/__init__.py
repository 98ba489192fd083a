"""Formats of public checkpoints: how the files of each model family name the arrays."""

from crisalad_jax.checkpoints.formats.families import FORMATS as FORMATS
from crisalad_jax.checkpoints.formats.families import REFERENCE as REFERENCE
from crisalad_jax.checkpoints.formats.families import VOCABULARY as VOCABULARY
from crisalad_jax.checkpoints.formats.format import Format as Format
from crisalad_jax.checkpoints.formats.identify import identify as identify
from crisalad_jax.checkpoints.formats.identify import infer as infer
from crisalad_jax.checkpoints.formats.identify import renamed_to as renamed_to
from crisalad_jax.checkpoints.formats.sizes import State as State
from crisalad_jax.checkpoints.formats.table import check_holds as check_holds
from crisalad_jax.checkpoints.formats.table import public_shapes as public_shapes
from crisalad_jax.checkpoints.formats.table import table as table
from crisalad_jax.checkpoints.formats.table import to_params as to_params
from crisalad_jax.checkpoints.formats.table import to_state as to_state
