"""SelaVPR (Lu et al., ICLR 2024), trained on MSLS, and then on Pitts30k."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    drive,
    github,
    register_published,
)

for _name, _identifier in (
    ("msls", "1vy05l0JTEgr6n8iSoz_P_yjWfEzFPAkV"),
    ("pitts30k", "1LKTZZRHfMH3dY3UPagCt2TIlMN5LguGO"),
):
    register_published(
        Published(
            name=f"selavpr-{_name}",
            layout="selavpr",
            descriptor=1024,
            parameters=357_427_585,
            images="224 x 224, bilinear, not antialiased",
            licence=MIT,
            repository=github("Lu-Feng/SelaVPR"),
            file=f"SelaVPR_{_name}.pth",
            url=drive(_identifier),
            paper="Lu et al., ICLR 2024",
        )
    )
