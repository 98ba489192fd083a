"""DINO-Mix (Huang et al., Scientific Reports 2024)."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "GaoShuang98/DINO-Mix"

register_published(
    Published(
        name="dino-mix",
        layout="dino-mix",
        descriptor=4096,
        parameters=87_632_388,
        images="224 x 224, bilinear, not antialiased",
        licence=MIT,
        repository=github(_REPOSITORY),
        file="dinov2_vitb14_mix.ckpt",
        url=release(_REPOSITORY, "v1.0.0", "dinov2_vitb14_mix.ckpt"),
        paper="Huang et al., Scientific Reports 2024",
    )
)
