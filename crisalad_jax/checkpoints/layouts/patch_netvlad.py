"""The layout of QVPR/Patch-NetVLAD (Hausler et al., CVPR 2021): NetVLAD with its whitening."""

import functools

from crisalad_jax.checkpoints.layouts.cnn import Names
from crisalad_jax.checkpoints.layouts.forms import POINTWISE
from crisalad_jax.checkpoints.layouts.netvlad import infer_netvlad, netvlad_lines
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.nn.backbones.vgg import VggConfig

register_over_cnn(
    "patch-netvlad",
    "Patch-NetVLAD WPCA .pth.tar",
    "netvlad",
    functools.partial(infer_netvlad, prefix="pool."),
    backbones=(VggConfig,),
    names=Names("encoder.", numbered=True),
    mark="WPCA.0.weight",
    head=functools.partial(netvlad_lines, prefix="pool."),
    projection="WPCA.0",
    projection_form=POINTWISE,
    image_size=lambda state: (480, 640),
    under="state_dict",
)
