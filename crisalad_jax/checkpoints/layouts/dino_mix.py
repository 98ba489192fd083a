"""The layout of GaoShuang98/DINO-Mix: MixVPR over DINOv2 without its last layer norm."""

import functools

from crisalad_jax.checkpoints.layouts.mixvpr import infer_mixvpr
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig

register_over_dinov2(
    "dino-mix",
    "DINO-Mix .ckpt",
    "mixvpr",
    functools.partial(infer_mixvpr, last_norm=False),
    prefix="backbone.dino_model.",
    norm=False,
    # Tensors at torchvision 0.14.1, which does not antialias them unasked: the chain of its
    # evaluation. Its training validates on Pillow's images.
    preprocessing=PreprocessingConfig(antialias=False, pixels="floats"),
    under="state_dict",
)
