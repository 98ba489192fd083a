"""BoQ (Ali-bey et al., CVPR 2024)."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "amaralibey/Bag-of-Queries"

register_published(
    Published(
        name="boq-dinov2",
        layout="boq-dinov2",
        descriptor=12288,
        parameters=95_205_792,
        images="322 x 322, bicubic",
        licence=MIT,
        repository=github(_REPOSITORY),
        file="dinov2_12288.pth",
        url=release(_REPOSITORY, "v1.0", "dinov2_12288.pth"),
        paper="Ali-bey et al., CVPR 2024",
    )
)
