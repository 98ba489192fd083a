"""SALAD and EigenPlaces of Indoor-VPR, trained on for indoor places, each in two variations.

A variation's name has its data sets and the distances in metres of near and far positives.
"""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "Enrico-Chiavassa/Indoor-VPR"

for _method, _network, _descriptor, _parameters, _images, _variations, _note in (
    (
        "salad",
        "Dinov2",
        8448,
        87_990_721,
        "322 x 322, bilinear",
        ("GB1_10_25", "HB1_GB1_2_5"),
        "trained on from SALAD's weights, whose repository is under the GPL-3.0",
    ),
    (
        "eigenplaces",
        "ResNet50",
        2048,
        27_757_505,
        "any, not resized",
        ("GB1_BAI_5_10", "GB1_BAI_10_25_S"),
        "",
    ),
):
    for _variation in _variations:
        _file = f"{_method}_{_network}_{_descriptor}_{_variation}.pth"
        register_published(
            Published(
                name=f"{_method}-indoor-{_variation}".lower().replace("_", "-"),
                layout=f"{_method}-indoor",
                descriptor=_descriptor,
                parameters=_parameters,
                images=_images,
                licence=MIT,
                repository=github(_REPOSITORY),
                file=_file,
                url=release(_REPOSITORY, "v0.1.0", _file),
                paper="Chiavassa, 2024 (code alone)",
                note=_note,
            )
        )
