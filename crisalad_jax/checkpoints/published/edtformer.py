"""EDTformer (Jin et al., 2025)."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "Tong-Jin01/EDTformer"

register_published(
    Published(
        name="edtformer",
        layout="edtformer",
        descriptor=4096,
        parameters=96_955_968,
        images="322 x 322, bilinear",
        licence=MIT,
        repository=github(_REPOSITORY),
        file="EDTformer.pth",
        url=release(_REPOSITORY, "v1.0.0", "EDTformer.pth"),
        paper="Jin et al., TCSVT 2025",
    )
)
