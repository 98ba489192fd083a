"""The layout of Nanne/pytorch-NetVlad (Arandjelovic et al., CVPR 2016), and its head for others."""

import functools
from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.cnn import Names
from crisalad_jax.checkpoints.layouts.forms import POINTWISE, SAME, Entry, affine
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.backbones.vgg import VggConfig


@register_head("netvlad")
def netvlad_lines(config: NetVladConfig, prefix: str = "aggregator.") -> Iterator[Entry]:
    """Yield the centroids and the shares' convolution, under Nanne's names after their prefix."""
    yield Entry(("aggregator.centroids",), (f"{prefix}centroids",), SAME)
    yield from affine("aggregator.conv", f"{prefix}conv", POINTWISE, bias=False)


def infer_netvlad(state: State, prefix: str) -> NetVladConfig:
    """Infer the number of clusters."""
    return NetVladConfig(clusters=Reader(state).size(f"{prefix}centroids", 0))


for _name, _holds, _inner in (
    ("netvlad", "pytorch-NetVlad .pth.tar", ""),
    ("netvlad-parallel", "pytorch-NetVlad .pth.tar of several GPUs", "module."),
):
    _pool = f"pool.{_inner}"
    register_over_cnn(
        _name,
        _holds,
        "netvlad",
        functools.partial(infer_netvlad, prefix=_pool),
        backbones=(VggConfig,),
        names=Names(f"encoder.{_inner}", numbered=True),
        mark=f"{_pool}centroids",
        head=functools.partial(netvlad_lines, prefix=_pool),
        image_size=lambda state: (480, 640),
        preprocessing=lambda head: PreprocessingConfig(size_rule="native"),
        under="state_dict",
    )
