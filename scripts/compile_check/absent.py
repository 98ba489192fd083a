"""Answer the questions that JAX's fused attention asks about the GPU while it is traced."""

import contextlib
from collections.abc import Iterator
from unittest import mock

from jax._src.cudnn import fused_attention_stablehlo as fused

from crisalad_jax.utils.target import machine

_CUDNN = 91000
"""The cuDNN version assumed for an absent GPU: 9.10."""


@contextlib.contextmanager
def assuming_cudnn() -> Iterator[None]:
    """Assume an H100 while the block runs, unless a GPU is present.

    There is no public API for this: JAX reads the version of the loaded cuDNN and the compute
    capability of the devices.
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
