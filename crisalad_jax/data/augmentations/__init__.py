"""Random changes of training images, one module each."""

import importlib
import pkgutil

from crisalad_jax.data.augmentations.base import AUGMENTATIONS as AUGMENTATIONS
from crisalad_jax.data.augmentations.base import Augmentation as Augmentation
from crisalad_jax.data.augmentations.base import NoAugmentation as NoAugmentation

register_augmentation = AUGMENTATIONS.register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
