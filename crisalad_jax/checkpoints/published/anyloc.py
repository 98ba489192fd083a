"""AnyLoc's vocabularies (Keetha et al., RA-L 2023), each of 32 words over DINOv2's ViT-g/14."""

from crisalad_jax.checkpoints.layouts.anyloc import VOCABULARY
from crisalad_jax.checkpoints.published.base import (
    BSD,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "AnyLoc/DINO"

for _domain in ("indoor", "urban", "aerial", "structured", "unstructured", "global"):
    _file = f"dinov2_vitg14_l31_value_c32_{_domain}_c_centers.pt"
    register_published(
        Published(
            name=f"anyloc-{_domain}",
            layout=VOCABULARY,
            descriptor=49_152,
            parameters=1_136_528_384,
            images="any, to multiples of 14, bilinear",
            licence=BSD,
            repository=github(_REPOSITORY),
            file=_file,
            url=release(_REPOSITORY, "v1", _file),
            paper="Keetha et al., RA-L 2023",
            backbone="dinov2-vitg14",
        )
    )
