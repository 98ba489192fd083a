"""Layouts of public torch checkpoints, a module for each family, to name and infer models.

Key names and shapes are those of facebookresearch/dinov2 and dinov3, Hugging Face's Dinov2Model
(with and without registers) and DINOv3ViTModel, serizba/salad, Lu-Feng/CricaVPR and others, and of
the torch reference in `parity/`, which can hold any model of this package over DINOv2 or a CNN.
"""

import importlib
import pkgutil

from crisalad_jax.checkpoints.layouts.base import HEADS as HEADS
from crisalad_jax.checkpoints.layouts.base import LAYOUTS as LAYOUTS
from crisalad_jax.checkpoints.layouts.base import Layout as Layout
from crisalad_jax.checkpoints.layouts.base import State as State
from crisalad_jax.checkpoints.layouts.table import check_holds as check_holds
from crisalad_jax.checkpoints.layouts.table import identify as identify
from crisalad_jax.checkpoints.layouts.table import infer as infer
from crisalad_jax.checkpoints.layouts.table import public_shapes as public_shapes
from crisalad_jax.checkpoints.layouts.table import renamed_to as renamed_to
from crisalad_jax.checkpoints.layouts.table import table as table
from crisalad_jax.checkpoints.layouts.table import to_params as to_params
from crisalad_jax.checkpoints.layouts.table import to_state as to_state

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
