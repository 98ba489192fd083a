"""CricaVPR (Lu et al., CVPR 2024)."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "Lu-Feng/CricaVPR"

register_published(
    Published(
        name="cricavpr",
        layout="cricavpr",
        descriptor=10752,
        parameters=106_771_265,
        images="224 x 224, bilinear, not antialiased",
        licence=MIT,
        repository=github(_REPOSITORY),
        file="CricaVPR.pth",
        url=release(_REPOSITORY, "v1.0", "CricaVPR.pth"),
        paper="Lu et al., CVPR 2024",
    )
)
