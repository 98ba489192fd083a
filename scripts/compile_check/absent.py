"""Answer for an absent GPU what JAX's fused attention asks of it while it is traced."""

import contextlib
from collections.abc import Iterator
from unittest import mock

from jax._src.cudnn import fused_attention_stablehlo as fused

from crisalad_jax.utils.target import machine

_CUDNN = 91000
"""The cuDNN that an absent GPU is assumed to have: 9.10."""


@contextlib.contextmanager
def assuming_cudnn() -> Iterator[None]:
    """Assume an H100 while the block runs, unless a GPU is here.

    These questions have no public answer: JAX reads the version of the loaded cuDNN, and the
    devices' compute capability.
    """

    def has(capability: str) -> bool:
        return tuple(map(int, capability.split("."))) <= (9, 0)

    if machine().platform == "gpu":
        yield
        return
    with (
        mock.patch.object(fused, "check_cudnn_version", return_value=_CUDNN),
        mock.patch.object(fused, "check_compute_capability", has),
    ):
        yield
