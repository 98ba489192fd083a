"""The layout of lu-feng/SuperVLAD, with and without its cross-image encoder."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import POINTWISE, Entry, affine
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.supervlad import SuperVladConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_CONV = "aggregation.conv"
_GHOSTS = {5: 1, 3: 2}
"""Number of ghosts by that of all clusters, in the published files; no shape tells them apart."""


@register_head("supervlad")
def supervlad_lines(config: SuperVladConfig) -> Iterator[Entry]:
    """Yield the scores' convolution."""
    yield from affine("aggregator.conv", _CONV, POINTWISE, bias=False)


def infer_supervlad(state: State) -> SuperVladConfig:
    """Infer the number of clusters.

    Raises:
        InputError: another number than in the published files.
    """
    count = Reader(state).size(f"{_CONV}.weight", 0)
    if count not in _GHOSTS:
        raise InputError(
            f"{_CONV}.weight found of {count} clusters, expected 5 (1 ghost) or 3 (2 ghosts)"
        )
    ghosts = _GHOSTS[count]
    if ghosts == 2:
        warn(
            f"{_CONV}.weight: found 3 clusters, read as 1 and 2 ghosts, as in 1-clusterVLAD.pth; "
            "one of 2 and a ghost (--supervlad_clusters=2) has the same shape, and cannot be read"
        )
    return SuperVladConfig(count - ghosts, ghosts)


register_over_dinov2(
    "supervlad",
    "SuperVLAD .pth",
    "supervlad",
    infer_supervlad,
    prefix="backbone.",
    mark=f"{_CONV}.weight",
    image_size=(322, 322),
    preprocessing=PreprocessingConfig(pixels="floats", round_to_patch=True),
    encoder=None,
    module="module.",
    under="model_state_dict",
)
