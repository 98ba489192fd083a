"""NetVLAD (Arandjelovic et al., CVPR 2016) of torch and MATLAB, and Patch-NetVLAD (CVPR 2021)."""

from crisalad_jax.checkpoints.published.base import (
    APACHE,
    MIT,
    NO_LICENCE,
    Published,
    github,
    register_published,
)

register_published(
    Published(
        name="netvlad-nanne",
        layout="netvlad",
        descriptor=32768,
        parameters=14_780_224,
        images="any, not resized",
        licence=NO_LICENCE,
        repository=github("Nanne/pytorch-NetVlad"),
        file="checkpoint.pth.tar",
        url=None,
        paper="Arandjelovic et al., CVPR 2016",
        note="in vgg16_netvlad_checkpoint/checkpoints of 17luTjZFCX639guSVy00OUtzfTQo4AMF2 on "
        "Google Drive",
    )
)

for _name, _file in (
    ("netvlad-hloc", "Pitts30K_struct.mat"),
    ("netvlad-hloc-tokyo", "TokyoTM_struct.mat"),
):
    register_published(
        Published(
            name=_name,
            layout="netvlad-matlab",
            descriptor=4096,
            parameters=149_002_048,
            images="longer side at most 1024, area",
            licence=APACHE,
            repository=github("cvg/Hierarchical-Localization"),
            file=_file,
            url=f"https://cvg-data.inf.ethz.ch/hloc/netvlad/{_file}",
            paper="Arandjelovic et al., CVPR 2016",
            note="the licence is of hloc's code, which reads the file",
        )
    )

_HOST = "https://huggingface.co/TobiasRobotics/Patch-NetVLAD/resolve/main"

for _set, _file, _size, _parameters in (
    ("mapillary", "mapillary", 128, 15_779_776),
    ("mapillary", "mapillary", 512, 18_925_888),
    ("mapillary", "mapillary", 4096, 48_289_600),
    ("pittsburgh", "pitts", 128, 18_974_656),
    ("pittsburgh", "pitts", 512, 31_557_952),
    ("pittsburgh", "pitts", 4096, 149_002_048),
):
    register_published(
        Published(
            name=f"patch-netvlad-{_set}-{_size}",
            layout="patch-netvlad",
            descriptor=_size,
            parameters=_parameters,
            images="480 x 640, bilinear (Pillow)",
            licence=MIT,
            repository=github("QVPR/Patch-NetVLAD"),
            file=f"{_file}_WPCA{_size}.pth.tar",
            url=f"{_HOST}/{_file}_WPCA{_size}.pth.tar",
            paper="Hausler et al., CVPR 2021",
        )
    )
