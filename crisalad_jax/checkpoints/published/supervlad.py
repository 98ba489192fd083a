"""SuperVLAD (Lu et al., NeurIPS 2024), with and without its cross-image encoder."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    drive,
    github,
    register_published,
)

for _name, _file, _identifier, _descriptor, _parameters in (
    ("supervlad", "SuperVLAD.pth", "1wRkUO4E8s5hNRNNIWcuA8RUvlGob3Tbf", 3072, 86_583_552),
    (
        "supervlad-crossimage",
        "SuperVLAD_crossimage.pth",
        "1yomnWGTJko6nf3F2Ju6RWsLhP2EG82tL",
        3072,
        97_611_520,
    ),
    (
        "supervlad-1-cluster",
        "1-clusterVLAD.pth",
        "1pQcJx9n2-keAh9TttssZkz6D0vjpFWU6",
        768,
        86_582_016,
    ),
):
    register_published(
        Published(
            name=_name,
            layout="supervlad",
            descriptor=_descriptor,
            parameters=_parameters,
            images="322 x 322, bilinear",
            licence=MIT,
            repository=github("Lu-Feng/SuperVLAD"),
            file=_file,
            url=drive(_identifier),
            paper="Lu et al., NeurIPS 2024",
            note="the name of the file on Google Drive is not stated",
        )
    )
