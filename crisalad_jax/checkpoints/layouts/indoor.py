"""The layouts of Enrico-Chiavassa/Indoor-VPR: SALAD and EigenPlaces within a module `model`."""

import functools

from crisalad_jax.checkpoints.layouts.cnn import Names
from crisalad_jax.checkpoints.layouts.cosplace import cosplace_lines, infer_cosplace
from crisalad_jax.checkpoints.layouts.dino_salad import infer_salad, salad_lines
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig

_MODEL = "model."
_HEAD = f"{_MODEL}aggregator."

register_over_dinov2(
    "salad-indoor",
    "SALAD-indoor .pth",
    "salad",
    functools.partial(infer_salad, prefix=_HEAD),
    prefix=f"{_MODEL}backbone.model.",
    head=functools.partial(salad_lines, prefix=_HEAD),
    image_size=(322, 322),
    preprocessing=PreprocessingConfig(pixels="floats", round_to_patch=True),
)
register_over_cnn(
    "eigenplaces-indoor",
    "EigenPlaces-indoor .pth",
    "cosplace",
    functools.partial(infer_cosplace, prefix=_MODEL),
    backbones=(ResNetConfig,),
    names=Names(f"{_MODEL}backbone.", numbered=True),
    mark=f"{_MODEL}aggregation.3.weight",
    image_size=lambda state: (512, 512),
    head=functools.partial(cosplace_lines, prefix=_MODEL),
    preprocessing=lambda head: PreprocessingConfig(size_rule="native"),
)
