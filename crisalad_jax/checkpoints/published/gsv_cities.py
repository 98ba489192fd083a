"""MixVPR and Conv-AP (Ali-bey et al., WACV 2023 and Neurocomputing 2022), on ResNet-50."""

from crisalad_jax.checkpoints.published.base import (
    NO_LICENCE,
    Published,
    drive,
    github,
    register_published,
)

for _descriptor, _channels, _rows, _parameters, _identifier in (
    (128, 64, 2, 9_926_690, "1DQnefjk1hVICOEYPwE4-CZAZOvi1NSJz"),
    (512, 256, 2, 10_123_490, "1khiTUNzZhfV2UUupZoIsPIbsMRBYVDqj"),
    (4096, 1024, 4, 10_911_492, "1vuz3PvnR7vxnDDLQrdHJaOA04SQrtk5L"),
):
    register_published(
        Published(
            name=f"mixvpr-{_descriptor}",
            layout="mixvpr",
            descriptor=_descriptor,
            parameters=_parameters,
            images="320 x 320, bilinear (Pillow)",
            licence=NO_LICENCE,
            repository=github("amaralibey/MixVPR"),
            file=f"resnet50_MixVPR_{_descriptor}_channels({_channels})_rows({_rows}).ckpt",
            url=drive(_identifier),
            paper="Ali-bey et al., WACV 2023",
        )
    )

for _descriptor, _channels, _parameters, _filter in (
    (512, 128, 23_823_424, "bilinear"),
    (2048, 512, 24_610_240, "bilinear"),
    (4096, 1024, 25_659_328, "bicubic"),
    (8192, 2048, 27_757_504, "bilinear"),
):
    register_published(
        Published(
            name=f"conv-ap-{_descriptor}",
            layout="conv-ap",
            descriptor=_descriptor,
            parameters=_parameters,
            images=f"320 x 320, {_filter} (Pillow)",
            licence=NO_LICENCE,
            repository=github("amaralibey/gsv-cities"),
            file=f"resnet50_ConvAP_{_channels}_2x2.ckpt",
            url=None,
            paper="Ali-bey et al., Neurocomputing 2022",
            note="one of a folder on Google Drive, 1VYPw9uGD11NgiGFgfWueLt3noJYOIuhL",
        )
    )
