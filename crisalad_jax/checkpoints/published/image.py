"""ImAge (Lu et al., NeurIPS 2025), trained on GSV-Cities or on several sets."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "Lu-Feng/ImAge"

for _name, _file in (("image", "ImAge_Merged.pth"), ("image-gsv", "ImAge_GSV.pth")):
    register_published(
        Published(
            name=_name,
            layout="image",
            descriptor=6144,
            parameters=86_588_928,
            images="322 x 322, bilinear",
            licence=MIT,
            repository=github(_REPOSITORY),
            file=_file,
            url=release(_REPOSITORY, "v1.0.0", _file),
            paper="Lu et al., NeurIPS 2025",
        )
    )
