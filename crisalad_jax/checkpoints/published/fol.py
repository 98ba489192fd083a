"""FoL (Wang et al., AAAI 2025), on ViT-L/14 and ViT-B/14."""

from crisalad_jax.checkpoints.published.base import APACHE, Published, github, register_published

_HOST = "https://huggingface.co/shunpeng/FoL/resolve/main"

for _size, _parameters in (("large", 308_826_432), ("base", 90_055_488)):
    register_published(
        Published(
            name=f"fol-{_size}",
            layout="fol",
            descriptor=8448,
            parameters=_parameters,
            images="504 x 504, bilinear, not antialiased",
            licence=APACHE,
            repository=github("chenshunpeng/FoL"),
            file=f"FoL_{_size}.pth",
            url=f"{_HOST}/FoL_{_size}.pth",
            paper="Wang et al., AAAI 2025",
            note="its authors also report 322 x 322",
        )
    )
