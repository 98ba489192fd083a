"""CosPlace and EigenPlaces (Berton et al., CVPR 2022 and ICCV 2023): of one form, in many sizes.

The sizes of EigenPlaces are those that both its README and its hub code name.
"""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_BACKBONES = {
    "VGG16": (512, 14_714_688),
    "ResNet18": (512, 11_186_112),
    "ResNet50": (2048, 23_561_152),
    "ResNet101": (2048, 42_605_504),
    "ResNet152": (2048, 58_295_232),
}
"""Widths of the features, and numbers of parameters."""
_SIZES = {
    "CosPlace": {
        "VGG16": (64, 128, 256, 512),
        "ResNet18": (32, 64, 128, 256, 512),
        "ResNet50": (32, 64, 128, 256, 512, 1024, 2048),
        "ResNet101": (32, 64, 128, 256, 512, 1024, 2048),
        "ResNet152": (32, 64, 128, 256, 512, 1024, 2048),
    },
    "EigenPlaces": {
        "VGG16": (512,),
        "ResNet18": (256, 512),
        "ResNet50": (128, 256, 512, 2048),
        "ResNet101": (128, 256, 512, 2048),
    },
}
_PAPERS = {
    "CosPlace": "Berton et al., CVPR 2022",
    "EigenPlaces": "Berton et al., ICCV 2023",
}


def _register(method: str, backbone: str, size: int) -> None:
    width, parameters = _BACKBONES[backbone]
    file = f"{backbone}_{size}_{method.lower()}.pth"
    register_published(
        Published(
            name=f"{method}-{backbone}-{size}".lower(),
            layout="cosplace",
            descriptor=size,
            # The exponent, and the linear layer with its bias.
            parameters=parameters + 1 + size * (width + 1),
            images="any, not resized",
            licence=MIT,
            repository=github(f"gmberton/{method}"),
            file=file,
            url=release(f"gmberton/{method}", "v1.0", file),
            paper=_PAPERS[method],
        )
    )


for _method, _backbones in _SIZES.items():
    for _backbone, _sizes in _backbones.items():
        for _size in _sizes:
            _register(_method, _backbone, _size)
