"""Losses on the descriptors of a batch, and the miner that chooses which pairs enter them.

On unit descriptors, losses that are also in pytorch-metric-learning have the same values there.
"""

import importlib
import pkgutil

from crisalad_jax.training.losses.base import LOSSES as LOSSES
from crisalad_jax.training.losses.base import Loss as Loss
from crisalad_jax.training.losses.base import LossBatch as LossBatch
from crisalad_jax.training.losses.base import LossValue as LossValue
from crisalad_jax.training.losses.base import Pairs as Pairs
from crisalad_jax.training.losses.metric import LossConfig as LossConfig
from crisalad_jax.training.losses.metric import LossResult as LossResult
from crisalad_jax.training.losses.metric import metric_loss as metric_loss
from crisalad_jax.training.losses.pairs import Role as Role
from crisalad_jax.training.losses.pairs import all_pairs as all_pairs
from crisalad_jax.training.losses.pairs import mine as mine
from crisalad_jax.training.losses.pairs import tuple_labels as tuple_labels
from crisalad_jax.training.losses.pairs import tuple_pairs as tuple_pairs

register_loss = LOSSES.register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
