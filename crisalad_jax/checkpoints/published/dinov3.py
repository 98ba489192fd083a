"""DINOv3's backbones (Siméoni et al. 2025), each described by its class token."""

from crisalad_jax.checkpoints.published.base import Licence, Published, github, register_published

DINOV3_LICENCE = Licence(
    "DINOv3 License",
    commercial=True,
    terms="Meta's own terms, which forbid some uses and go with what is made of the model",
)

for _size, _width, _parameters, _digest in (
    ("s16", 384, 21_600_768, "08c60483"),
    ("s16plus", 384, 28_697_088, "4057cbaa"),
    ("b16", 768, 85_668_864, "73cec8be"),
    ("l16", 1024, 303_153_152, "8aa4cbdd"),
    ("h16plus", 1280, 840_632_320, "7c1da9a5"),
):
    _name = f"dinov3-vit{_size}"
    register_published(
        Published(
            name=_name,
            layout="dinov3",
            descriptor=_width,
            parameters=_parameters,
            images="224 x 224, bilinear (Pillow)",
            licence=DINOV3_LICENCE,
            repository=github("facebookresearch/dinov3"),
            file=f"dinov3_vit{_size}_pretrain_lvd1689m-{_digest}.pth",
            url=None,
            paper="Siméoni et al., 2025",
            note="gated: Meta sends an address on request; or --backbone model.safetensors, of "
            f"facebook/{_name}-pretrain-lvd1689m on Hugging Face, which is gated too",
        )
    )
