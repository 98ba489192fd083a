"""Torch's files where the disk refuses them."""

import os
import resource

import numpy as np
import pytest

from crisalad_jax.checkpoints.torch_io import write_torch
from crisalad_jax.utils.errors import InputError


def test_what_the_disk_says_is_told(tmp_path):
    """Torch's own error has lines of C++ and none of the reason."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, limits[1]))
    try:
        with pytest.raises(InputError, match=r"w\.pth: cannot be written: .*File too large"):
            write_torch(
                tmp_path / "w.pth",
                {"w": np.ones(2**16, np.float32)},
                under="",
                bare=False,
                declared=None,
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert os.listdir(tmp_path) == []
