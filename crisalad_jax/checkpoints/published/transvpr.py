"""TransVPR (Wang et al., CVPR 2022), whose files are in its repository itself."""

from crisalad_jax.checkpoints.published.base import (
    NO_LICENCE,
    Published,
    github,
    register_published,
)

_REPOSITORY = github("RuotongWANG/TransVPR-model-implementation")

for _name, _file in (("msls", "TransVPR_MSLS.pth"), ("pitts30k", "TransVPR_Pitts30k.pth")):
    register_published(
        Published(
            name=f"transvpr-{_name}",
            layout="transvpr",
            descriptor=256,
            parameters=5_404_544,
            images="480 x 640, bilinear, not antialiased",
            licence=NO_LICENCE,
            repository=_REPOSITORY,
            file=_file,
            url=f"{_REPOSITORY}/raw/main/{_file}",
            paper="Wang et al., CVPR 2022",
        )
    )
