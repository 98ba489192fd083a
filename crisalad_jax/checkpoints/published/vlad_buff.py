"""VLAD-BuFF (Khaliq et al., ECCV 2024), with features of 192 numbers or of all 768."""

from crisalad_jax.checkpoints.published.base import (
    GPL,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "Ahmedest61/VLAD-BuFF"

for _descriptor, _file, _parameters in (
    (4096, "dnv2_NV_192PCA_AB_wpca4096_last.ckpt", 137_088_259),
    (8192, "dnv2_NV_AB_wpca8192_last.ckpt", 489_339_395),
):
    register_published(
        Published(
            name=f"vlad-buff-{_descriptor}",
            layout="vlad-buff",
            descriptor=_descriptor,
            parameters=_parameters,
            images="322 x 322, bilinear (Pillow)",
            licence=GPL,
            repository=github(_REPOSITORY),
            file=_file,
            url=release(_REPOSITORY, "v1.0.0", _file),
            paper="Khaliq et al., ECCV 2024",
        )
    )
