"""MegaLoc (Berton and Masone, 2025), of Hugging Face and of its first release."""

from crisalad_jax.checkpoints.published.base import (
    MIT,
    Published,
    github,
    register_published,
    release,
)

_REPOSITORY = "gmberton/MegaLoc"

for _name, _layout, _file, _url in (
    (
        "megaloc",
        "megaloc",
        "model.safetensors",
        "https://huggingface.co/gberton/MegaLoc/resolve/main/model.safetensors",
    ),
    ("megaloc-v1", "megaloc-v1", "megaloc.torch", release(_REPOSITORY, "v1.0", "megaloc.torch")),
):
    register_published(
        Published(
            name=_name,
            layout=_layout,
            descriptor=8448,
            parameters=228_639_553,
            images="322 x 322, bilinear",
            licence=MIT,
            repository=github(_REPOSITORY),
            file=_file,
            url=_url,
            paper="Berton and Masone, CVPR Workshops 2025",
            note="its authors evaluate at 322 x 322; their model takes any size, and resizes to "
            "multiples of 14, as --resize native does",
        )
    )
