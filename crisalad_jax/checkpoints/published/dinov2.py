"""DINOv2's backbones (Oquab et al., TMLR 2024), each described by its class token."""

from crisalad_jax.checkpoints.published.base import APACHE, Published, github, register_published

_HOST = "https://dl.fbaipublicfiles.com/dinov2"

for _size, _width, _parameters in (
    ("s", 384, 22_056_192),
    ("b", 768, 86_579_712),
    ("l", 1024, 304_367_616),
    ("g", 1536, 1_136_479_232),
):
    for _registers in (0, 4):
        _name = f"dinov2_vit{_size}14"
        _full = f"{_name}_reg4" if _registers else _name
        register_published(
            Published(
                name=_full.replace("_", "-"),
                layout="dinov2",
                descriptor=_width,
                parameters=_parameters + _registers * _width,
                images="224 x 224, bilinear (Pillow)",
                licence=APACHE,
                repository=github("facebookresearch/dinov2"),
                file=f"{_full}_pretrain.pth",
                url=f"{_HOST}/{_name}/{_full}_pretrain.pth",
                paper="Oquab et al., TMLR 2024",
                note="a backbone, which takes any sides that are multiples of 14",
            )
        )
