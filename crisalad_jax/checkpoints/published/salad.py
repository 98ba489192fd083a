"""DINO-SALAD, and SALAD trained with CliqueMining (Izquierdo and Civera, CVPR and ECCV 2024)."""

from crisalad_jax.checkpoints.published.base import (
    GPL,
    Published,
    drive,
    github,
    register_published,
    release,
)

for _name, _repository, _file, _url, _paper in (
    (
        "salad",
        "serizba/salad",
        "dino_salad.ckpt",
        release("serizba/salad", "v1.0.0", "dino_salad.ckpt"),
        "Izquierdo and Civera, CVPR 2024",
    ),
    (
        "salad-cm",
        "serizba/cliquemining",
        "cliquemining.ckpt",
        drive("1B06ysb-Wjb4KDcNrl-7pyj1mJve1jqdk"),
        "Izquierdo and Civera, ECCV 2024",
    ),
):
    register_published(
        Published(
            name=_name,
            layout="dino-salad",
            descriptor=8448,
            parameters=87_990_721,
            images="322 x 322, bilinear (Pillow)",
            licence=GPL,
            repository=github(_repository),
            file=_file,
            url=_url,
            paper=_paper,
        )
    )
