"""BoQ (Ali-bey et al., CVPR 2024), on DINOv2 and on ResNet-50."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "amaralibey/Bag-of-Queries"

for _name, _file, _descriptor, _parameters, _images in (
    ("boq-dinov2", "dinov2_12288.pth", 12288, 95_205_792, "322 x 322, bicubic"),
    ("boq-resnet50", "resnet50_16384.pth", 16384, 23_875_040, "384 x 384, bicubic"),
):
    register_published(
        Published(
            name=_name,
            layout=_name,
            descriptor=_descriptor,
            parameters=_parameters,
            images=_images,
            licence=MIT,
            repository=github(_REPOSITORY),
            file=_file,
            url=release(_REPOSITORY, "v1.0", _file),
            paper="Ali-bey et al., CVPR 2024",
        )
    )
